// SPDX-License-Identifier: Apache-2.0
#include "wiw/reproject/raster_kernel.hpp"

namespace wiw::reproject {

void raster_scalar(const RasterJob& job) { raster(job); }

}  // namespace wiw::reproject
