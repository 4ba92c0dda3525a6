// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <limits>
#include <numeric>

#include "wiw/core/thread_pool.hpp"
#include "wiw/nav/geodesics.hpp"

namespace wiw::nav {
namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();

/// One matrix in three passes, each a row at a time and shared between threads: what every site sees, the ways between
/// corners, and then for every pair the best corner by which to arrive. Sites are sorted by polygon, so that those a
/// cone of sight has to test lie together; only pairs i < j of that order are computed.
class MatrixJob {
 public:
  MatrixJob(const Geodesics& geodesics, std::span<const Site> sites)
      : geodesics_(geodesics), corners_(geodesics.corners().list.size()), original_(sites.size()), legs_(sites.size()) {
    std::iota(original_.begin(), original_.end(), std::size_t{0});
    std::stable_sort(original_.begin(), original_.end(),
                     [&](std::size_t a, std::size_t b) { return sites[a].polygon < sites[b].polygon; });
    first_.assign(geodesics.graph().polygons().size() + 1, 0);
    for (const std::size_t i : original_) {
      sites_.push_back(sites[i]);
      ++first_[sites[i].polygon + 1];
    }
    std::partial_sum(first_.begin(), first_.end(), first_.begin());
    upper_.assign(sites.size() * sites.size(), kInfinity);
  }

  void run(std::span<double> metres) {
    in_blocks(sites_.size(), [&](std::size_t begin, std::size_t end) { look(begin, end); });
    if (corners_ <= sites_.size()) {
      between_.resize(corners_ * corners_);
      in_blocks(corners_, [&](std::size_t begin, std::size_t end) { connect(begin, end); });
    }
    in_blocks(sites_.size(), [&](std::size_t begin, std::size_t end) { arrive(begin, end); });
    in_blocks(sites_.size(), [&](std::size_t begin, std::size_t end) { write(begin, end, metres); });
  }

 private:
  template <class Body>
  static void in_blocks(std::size_t count, Body&& body) {
    constexpr std::size_t kBlock = 32;  // enough rows to pay for a thread's scratch memory
    parallel_for((count + kBlock - 1) / kBlock,
                 [&](std::size_t block) { body(block * kBlock, std::min(count, (block + 1) * kBlock)); });
  }

  void look(std::size_t begin, std::size_t end) {
    Sight sight(geodesics_.graph(), geodesics_.corners());
    for (std::size_t i = begin; i < end; ++i) {
      const Site& site = sites_[i];
      double* row = upper_.data() + i * sites_.size();
      for (std::size_t j = i; j < first_[site.polygon + 1]; ++j) row[j] = geodesics_.metres(site.at, sites_[j].at);
      sight.from_site(
          site, [&](int c) { legs_[i].push_back(geodesics_.leg(c, site.at)); },
          [&](const Cone& cone) {
            for (std::size_t j = std::max(first_[cone.polygon], i); j < first_[cone.polygon + 1]; ++j) {
              if (cone.contains(sites_[j].eye - site.eye)) row[j] = geodesics_.metres(site.at, sites_[j].at);
            }
          });
    }
  }

  void connect(std::size_t begin, std::size_t end) {
    for (std::size_t c = begin; c < end; ++c) {
      const CornerDistance seed{static_cast<std::int32_t>(c), 0};
      geodesics_.corner_graph().find_distances({&seed, 1}, {between_.data() + c * corners_, corners_});
    }
  }

  // With fewer sites than corners one search a site is cheaper than all ways between corners.
  void reach_corners(std::size_t i, std::span<double> metres) const {
    if (between_.empty()) {
      geodesics_.corner_graph().find_distances(legs_[i], metres);
      return;
    }
    std::fill(metres.begin(), metres.end(), kInfinity);
    for (const CornerDistance& leg : legs_[i]) {
      const double* row = between_.data() + static_cast<std::size_t>(leg.corner) * corners_;
      for (std::size_t c = 0; c < corners_; ++c) metres[c] = std::min(metres[c], leg.metres + row[c]);
    }
  }

  void arrive(std::size_t begin, std::size_t end) {
    std::vector<double> metres(corners_);
    for (std::size_t i = begin; i < end; ++i) {
      reach_corners(i, metres);
      double* row = upper_.data() + i * sites_.size();
      for (std::size_t j = i + 1; j < sites_.size(); ++j) {
        if (row[j] < kInfinity) continue;
        for (const CornerDistance& leg : legs_[j]) row[j] = std::min(row[j], metres[leg.corner] + leg.metres);
      }
    }
  }

  void write(std::size_t begin, std::size_t end, std::span<double> metres) const {
    const std::size_t n = sites_.size();
    for (std::size_t i = begin; i < end; ++i) {
      double* row = metres.data() + original_[i] * n;
      for (std::size_t j = 0; j < i; ++j) row[original_[j]] = upper_[j * n + i];
      for (std::size_t j = i; j < n; ++j) row[original_[j]] = upper_[i * n + j];
    }
  }

  const Geodesics& geodesics_;
  std::size_t corners_;
  std::vector<Site> sites_;
  std::vector<std::size_t> original_;  // place of each sorted site among the caller's
  std::vector<std::size_t> first_;     // per polygon: its first site; one more at the end
  std::vector<std::vector<CornerDistance>> legs_;
  std::vector<double> between_;  // metres between corners; empty where that would cost more than it saves
  std::vector<double> upper_;    // metres between sites, by sorted place
};

}  // namespace

void Geodesics::matrix(std::span<const Site> sites, std::span<double> metres) const {
  MatrixJob(*this, sites).run(metres);
}

}  // namespace wiw::nav
