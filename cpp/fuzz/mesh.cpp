// SPDX-License-Identifier: Apache-2.0
// A mesh file that is one text or table; OBJ may name itself as its material library.
#include "mesh_reading.hpp"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  wiw::fuzz::read_mesh(WIW_FUZZ_FILE, {data, size});
  return 0;
}
