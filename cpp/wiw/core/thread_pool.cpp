// SPDX-License-Identifier: Apache-2.0
#include "wiw/core/thread_pool.hpp"

#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cstdlib>
#include <exception>
#include <string>

#include "wiw/core/error.hpp"

namespace wiw {

namespace {
thread_local bool inside_job = false;

int shared_size() {
  const char* wanted = std::getenv("WIW_NUM_THREADS");
  if (wanted == nullptr || *wanted == '\0') {
    return static_cast<int>(std::max(1u, std::thread::hardware_concurrency()));
  }
  char* end = nullptr;
  const long threads = std::strtol(wanted, &end, 10);
  if (*end != '\0' || threads < 1 || threads > 1024) {
    throw ArgumentError(std::string("WIW_NUM_THREADS=") + wanted + ": expected a number from 1 to 1024");
  }
  return static_cast<int>(threads);
}
}  // namespace

struct ThreadPool::Job {
  Job(std::size_t job_count, const std::function<void(std::size_t)>& job_body) : count(job_count), body(job_body) {}

  std::size_t count;
  const std::function<void(std::size_t)>& body;
  std::atomic<std::size_t> next{0};
  int helpers = 0;  // guarded by the pool's mutex
  std::exception_ptr error;
  std::mutex error_mutex;

  void run() {
    inside_job = true;
    for (std::size_t i = next++; i < count; i = next++) {
      try {
        body(i);
      } catch (...) {
        const std::scoped_lock lock(error_mutex);
        if (!error) error = std::current_exception();
      }
    }
    inside_job = false;
  }
};

ThreadPool::ThreadPool(int threads) : owner_(getpid()) {
  if (threads < 1) throw ArgumentError("ThreadPool: expected at least 1 thread, got " + std::to_string(threads));
  workers_.reserve(static_cast<std::size_t>(threads) - 1);
  try {
    for (int i = 1; i < threads; ++i) workers_.emplace_back([this] { work(); });
  } catch (const std::exception&) {  // NOLINT(bugprone-empty-catch): see below
    // std::system_error or std::bad_alloc: the machine refuses more (a limit on processes or memory), and those threads
    // that started share the work.
  }
}

ThreadPool::~ThreadPool() {
  {
    const std::scoped_lock lock(mutex_);
    stop_ = true;
  }
  wake_.notify_all();
  for (auto& worker : workers_) worker.join();
}

void ThreadPool::work() {
  std::size_t seen = 0;
  std::unique_lock lock(mutex_);
  while (true) {
    wake_.wait(lock, [&] { return stop_ || (job_ != nullptr && generation_ != seen); });
    if (stop_) return;
    seen = generation_;
    Job& job = *job_;
    ++job.helpers;
    lock.unlock();
    job.run();
    lock.lock();
    if (--job.helpers == 0) finished_.notify_all();
  }
}

void ThreadPool::parallel_for(std::size_t count, const std::function<void(std::size_t)>& body) {
  // A forked child has no workers, and its mutexes may be locked for ever.
  if (workers_.empty() || count < 2 || inside_job || getpid() != owner_) {
    for (std::size_t i = 0; i < count; ++i) body(i);
    return;
  }
  const std::scoped_lock submit(submit_);  // one job at a time; callers from other threads queue here
  Job job(count, body);
  {
    const std::scoped_lock lock(mutex_);
    job_ = &job;
    ++generation_;
  }
  wake_.notify_all();
  job.run();
  std::unique_lock lock(mutex_);
  job_ = nullptr;  // a worker that wakes late must not enter a finished job
  finished_.wait(lock, [&] { return job.helpers == 0; });
  if (job.error) std::rethrow_exception(job.error);
}

ThreadPool& ThreadPool::shared() {
  // Never destroyed: a forked child that ends would wait for threads that it does not have.
  static ThreadPool& pool = *new ThreadPool(shared_size());
  return pool;
}

void run_inline() { inside_job = true; }

void parallel_for(std::size_t count, const std::function<void(std::size_t)>& body) {
  ThreadPool::shared().parallel_for(count, body);
}

}  // namespace wiw
