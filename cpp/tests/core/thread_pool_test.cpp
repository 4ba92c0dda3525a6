// SPDX-License-Identifier: Apache-2.0
#include "wiw/core/thread_pool.hpp"

#include <doctest/doctest.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <atomic>
#include <chrono>
#include <fstream>
#include <stdexcept>
#include <thread>

using namespace wiw;

// The sanitisers' own memory for each thread does not stand a limit.
#if !defined(__SANITIZE_ADDRESS__) && !defined(__SANITIZE_THREAD__)
namespace {

/// Leaves this process room for a few more stacks of threads.
rlimit limit_memory() {
  std::size_t pages = 0;
  std::ifstream("/proc/self/statm") >> pages;
  rlimit before{};
  getrlimit(RLIMIT_AS, &before);
  rlimit stack{};
  getrlimit(RLIMIT_STACK, &stack);
  const rlim_t each = stack.rlim_cur == RLIM_INFINITY ? rlim_t{2} << 20 : stack.rlim_cur;
  const rlimit tight{pages * static_cast<rlim_t>(sysconf(_SC_PAGESIZE)) + 6 * each + each / 2, before.rlim_max};
  setrlimit(RLIMIT_AS, &tight);
  return before;
}

}  // namespace

TEST_CASE("where the machine refuses threads, those that started do the work") {
  const pid_t child = fork();
  if (child == 0) {
    const rlimit before = limit_memory();
    ThreadPool pool(400);
    setrlimit(RLIMIT_AS, &before);
    std::atomic<int> visits{0};
    pool.parallel_for(1000, [&](std::size_t) { ++visits; });
    _exit(pool.size() > 1 && pool.size() < 20 && visits == 1000 ? 0 : 1);
  }
  int status = 0;
  waitpid(child, &status, 0);
  CHECK(WIFEXITED(status));
  CHECK(WEXITSTATUS(status) == 0);
}
#endif

TEST_CASE("every index is visited exactly once, from any number of threads") {
  for (const int threads : {1, 2, 4}) {
    ThreadPool pool(threads);
    for (const std::size_t count : {0u, 1u, 2u, 1000u}) {
      std::vector<std::atomic<int>> visits(count);
      pool.parallel_for(count, [&](std::size_t i) { ++visits[i]; });
      for (const auto& n : visits) CHECK(n == 1);
    }
  }
}

TEST_CASE("nested calls run inline and errors reach the caller after all work is done") {
  ThreadPool pool(3);
  std::atomic<int> inner{0};
  pool.parallel_for(4, [&](std::size_t) { pool.parallel_for(5, [&](std::size_t) { ++inner; }); });
  CHECK(inner == 20);
  std::atomic<int> done{0};
  CHECK_THROWS_AS(pool.parallel_for(100,
                                    [&](std::size_t i) {
                                      ++done;
                                      if (i == 3) throw std::runtime_error("three");
                                    }),
                  std::runtime_error);
  CHECK(done == 100);
}

TEST_CASE("inline, an error leaves the calls behind it out") {
  ThreadPool pool(1);
  int done = 0;
  CHECK_THROWS_AS(pool.parallel_for(100,
                                    [&](std::size_t i) {
                                      ++done;
                                      if (i == 3) throw std::runtime_error("three");
                                    }),
                  std::runtime_error);
  CHECK(done == 4);
}

TEST_CASE("callers from several threads take turns") {
  ThreadPool pool(2);
  std::atomic<int> total{0};
  std::vector<std::thread> callers;
  for (int t = 0; t < 4; ++t) {
    callers.emplace_back([&] {
      for (int i = 0; i < 200; ++i) pool.parallel_for(8, [&](std::size_t) { ++total; });
    });
  }
  for (auto& caller : callers) caller.join();
  CHECK(total == 4 * 200 * 8);
}

TEST_CASE("a thread may do without the others") {
  ThreadPool pool(3);
  std::atomic<int> elsewhere{0};
  std::thread alone([&] {
    wiw::run_inline();
    const std::thread::id own = std::this_thread::get_id();
    pool.parallel_for(20, [&](std::size_t) {
      std::this_thread::sleep_for(std::chrono::milliseconds(1));
      if (std::this_thread::get_id() != own) ++elsewhere;
    });
  });
  alone.join();
  CHECK(elsewhere == 0);
}
