// SPDX-License-Identifier: Apache-2.0
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "wiw/core/cpu.hpp"
#include "wiw/core/rng.hpp"
#include "wiw/core/thread_pool.hpp"

namespace py = pybind11;

void bind_core(py::module_& module) {
  module.def(
      "active_isa", [] { return wiw::isa_name(wiw::active_isa()); },
      "Instruction set in use: 'scalar', 'avx2' or 'avx512' (override with WIW_ISA).");
  module.def("native_isa", [] { return wiw::isa_name(wiw::native_isa()); }, "Best instruction set of this processor.");
  module.def(
      "num_threads", [] { return wiw::ThreadPool::shared().size(); },
      "Threads of the shared pool (the machine's cores, or WIW_NUM_THREADS).");
  module.def(
      "run_inline", [] { wiw::run_inline(); },
      "From now on the calling thread does all its work itself: for one of as many threads as there are cores.");
  module.def(
      "fold_key", [](const std::vector<std::uint64_t>& parts) { return wiw::fold_key(std::span(parts)); },
      py::arg("parts"), "Mixes integers, e.g. (run seed, episode, decision, candidate), into one uint64 key.");
  module.def(
      "uniform",
      [](std::uint64_t key, std::size_t count) {
        py::array_t<double> values(static_cast<py::ssize_t>(count));
        wiw::Rng rng(key);
        for (std::size_t i = 0; i < count; ++i) values.mutable_at(static_cast<py::ssize_t>(i)) = rng.uniform();
        return values;
      },
      py::arg("key"), py::arg("count"), "float64 [count] in [0, 1), a function of the key alone.");
}
