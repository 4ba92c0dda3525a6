// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <sys/types.h>

#include <condition_variable>
#include <cstddef>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

namespace wiw {

/// Fixed set of threads that sleep between jobs. Waits block on a condition variable: on a machine whose cores are
/// shared, spinning at a barrier costs more than the work. The caller takes part in the work.
class ThreadPool {
 public:
  /// `threads` counts the caller; 1 runs everything inline. The pool is smaller where the machine refuses that many.
  explicit ThreadPool(int threads);
  ~ThreadPool();
  ThreadPool(const ThreadPool&) = delete;
  ThreadPool& operator=(const ThreadPool&) = delete;

  [[nodiscard]] int size() const { return static_cast<int>(workers_.size()) + 1; }

  /// Calls body(i) for every i in [0, count), in any order, and returns when all are done. The first exception is
  /// rethrown here: after all other calls where threads share the work, at once where it runs inline, which leaves the
  /// calls behind it out. A call from inside a body runs inline, and so does one in a forked child, where only the
  /// thread that forked exists.
  void parallel_for(std::size_t count, const std::function<void(std::size_t)>& body);

  /// The pool all rooms share; its size is the machine's cores, or WIW_NUM_THREADS.
  static ThreadPool& shared();

 private:
  struct Job;
  void work();

  std::mutex mutex_;
  std::mutex submit_;
  std::condition_variable wake_;
  std::condition_variable finished_;
  Job* job_ = nullptr;
  std::size_t generation_ = 0;
  bool stop_ = false;
  const pid_t owner_;  // process that the workers run in
  std::vector<std::thread> workers_;
};

/// Runs all later jobs of the calling thread inline, on any pool. For threads that already use every core between them,
/// each with work of its own.
void run_inline();

/// Shorthand for ThreadPool::shared().parallel_for.
void parallel_for(std::size_t count, const std::function<void(std::size_t)>& body);

}  // namespace wiw
