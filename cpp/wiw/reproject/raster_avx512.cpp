// SPDX-License-Identifier: Apache-2.0
#include "wiw/reproject/raster_kernel.hpp"

namespace wiw::reproject {

void raster_avx512(const RasterJob& job) { raster(job); }

}  // namespace wiw::reproject
