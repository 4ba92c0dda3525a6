// SPDX-License-Identifier: Apache-2.0
#include "wiw/metrics/scores.hpp"

#include <algorithm>
#include <cmath>
#include <string>

#include "wiw/core/error.hpp"

namespace wiw::metrics {

namespace {

double efficiency(double credit, double shortest, double travelled, std::size_t episode) {
  const std::string where = " in episode " + std::to_string(episode);
  if (!(credit >= 0 && credit <= 1)) {
    throw ArgumentError("expected success between 0 and 1" + where + ", got " + std::to_string(credit));
  }
  if (!(shortest >= 0) || !(travelled >= 0) || std::isinf(travelled)) {
    throw ArgumentError("expected lengths of at least 0 m" + where + ", got shortest " + std::to_string(shortest) +
                        " and travelled " + std::to_string(travelled));
  }
  if (credit == 0) return 0;
  if (std::isinf(shortest))
    throw ArgumentError("success on a goal that cannot be reached (shortest is infinite)" + where);
  const double longest = std::max(travelled, shortest);
  return longest == 0 ? credit : credit * shortest / longest;
}

}  // namespace

std::vector<double> path_efficiency(std::span<const double> credit, std::span<const double> shortest,
                                    std::span<const double> travelled) {
  if (credit.size() != shortest.size() || credit.size() != travelled.size()) {
    throw ArgumentError("expected one success, shortest and travelled length an episode, got " +
                        std::to_string(credit.size()) + ", " + std::to_string(shortest.size()) + " and " +
                        std::to_string(travelled.size()));
  }
  std::vector<double> terms(credit.size());
  for (std::size_t i = 0; i < terms.size(); ++i) terms[i] = efficiency(credit[i], shortest[i], travelled[i], i);
  return terms;
}

std::vector<double> answer_credit(std::span<const double> raw) {
  std::vector<double> credit(raw.size());
  for (std::size_t i = 0; i < raw.size(); ++i) {
    if (std::isnan(raw[i])) throw ArgumentError("the answer score of episode " + std::to_string(i) + " is NaN");
    credit[i] = (std::clamp(raw[i], 1.0, 5.0) - 1) / 4;
  }
  return credit;
}

double mean(std::span<const double> values) {
  if (values.empty()) throw ArgumentError("expected at least one episode, got none");
  double sum = 0;
  for (const double value : values) {
    if (!std::isfinite(value)) throw ArgumentError("expected finite values, got " + std::to_string(value));
    sum += value;
  }
  return sum / static_cast<double>(values.size());
}

}  // namespace wiw::metrics
