// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Python.h>
#include <unistd.h>

namespace wiw::bindings {

/// Lets other Python threads run for as long as it lives.
///
/// Python before 3.14 ends a thread that wants the lock back while the interpreter shuts down by unwinding its stack.
/// That aborts the process in a destructor, as in pybind11's own guard, and would free Python's objects without the
/// lock in the frames above. Such a thread sleeps here until the process has ended, as from 3.14 on.
class GilRelease {
 public:
  GilRelease() : thread_(PyEval_SaveThread()) {}
  GilRelease(const GilRelease&) = delete;
  GilRelease& operator=(const GilRelease&) = delete;
  ~GilRelease() {
    try {
      PyEval_RestoreThread(thread_);
    } catch (...) {  // pthread_exit; asking beforehand would be too early, as the shutdown may begin during the wait
      while (true) pause();
    }
  }

 private:
  PyThreadState* thread_;
};

}  // namespace wiw::bindings
