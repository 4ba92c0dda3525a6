// SPDX-License-Identifier: Apache-2.0
// glTF as text, its buffers in data URIs; values of the document are exchanged.
#include "mesh_reading.hpp"
#include "mutation.hpp"

wiw::fuzz::Container wiw::fuzz::container() {
  return {
      .split = [](const std::string& bytes) { return std::vector{bytes}; },
      .join = [](const std::vector<std::string>& parts) { return parts[0]; },
      .json = 0,
  };
}

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  wiw::fuzz::read_mesh("m.gltf", {data, size});
  return 0;
}
