// SPDX-License-Identifier: Apache-2.0
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <memory>

#include "arrays.hpp"
#include "gil.hpp"
#include "wiw/core/thread_pool.hpp"
#include "wiw/panorama/cubemap.hpp"
#include "wiw/panorama/perspective.hpp"
#include "wiw/panorama/resize.hpp"
#include "wiw/panorama/roll.hpp"

namespace py = pybind11;
using namespace wiw;
using namespace wiw::panorama;

namespace {

using Pair = std::pair<int, int>;
Size to_size(const Pair& pair) { return {pair.first, pair.second}; }

Interpolation to_interpolation(const std::string& name) {
  if (name == "bilinear") return Interpolation::kBilinear;
  if (name == "nearest") return Interpolation::kNearest;
  throw ArgumentError("interpolation: expected 'bilinear' or 'nearest', got '" + name + "'");
}

/// Calls body(T{}) with the element type of `images`.
template <class Body>
py::array by_type(const py::array& images, const Body& body) {
  if (py::isinstance<py::array_t<std::uint8_t>>(images)) return body(std::uint8_t{});
  if (py::isinstance<py::array_t<float>>(images)) return body(float{});
  if (py::isinstance<py::array_t<std::uint32_t>>(images)) return body(std::uint32_t{});
  throw ArgumentError("images: expected uint8, float32 or uint32, got " + bindings::shape_text(images) +
                      "; convert with .astype");
}

/// A batch [B, H, W, C] as the kernels want it.
template <class T>
struct ImageBatch {
  explicit ImageBatch(const py::array& images) : array(images) {
    bindings::expect_shape(array, {-1, -1, -1, -1}, "images [B, H, W, C]");
    size = {static_cast<int>(array.shape(1)), static_cast<int>(array.shape(2))};
    count = static_cast<std::size_t>(array.shape(0));
    channels = static_cast<int>(array.shape(3));
  }
  [[nodiscard]] ImageView<const T> operator[](std::size_t b) const {
    return {array.data() + b * size.pixels() * static_cast<std::size_t>(channels), size, channels};
  }
  bindings::Array<T> array;
  Size size;
  std::size_t count = 0;
  int channels = 1;
};

/// `given` if it fits (right type, shape and layout, writeable), a new array for None.
template <class T>
py::array_t<T> output(const std::vector<py::ssize_t>& shape, const py::object& given) {
  if (given.is_none()) return py::array_t<T>(shape);
  const bool fits = py::isinstance<py::array_t<T, py::array::c_style>>(given);
  const auto array = fits ? given.cast<py::array_t<T>>() : py::array_t<T>();
  if (!fits || !array.writeable() || std::vector<py::ssize_t>(array.shape(), array.shape() + array.ndim()) != shape) {
    throw ArgumentError("out: expected a writeable C-contiguous array of the images' type and shape " +
                        std::string(py::str(py::cast(shape))));
  }
  return array;
}

py::array apply_plan(const PerspectivePlan& plan, const py::array& panoramas, const std::vector<double>& yaws_deg,
                     const std::string& interpolation_name, const py::object& given) {
  const Interpolation interpolation = to_interpolation(interpolation_name);
  return by_type(panoramas, [&]<class T>(T) -> py::array {
    const ImageBatch<T> batch(panoramas);
    const Size& size = plan.panorama_size();
    bindings::expect_shape(batch.array, {-1, size.height, size.width, -1},
                           ("panoramas [B, " + std::to_string(size.height) + ", " + std::to_string(size.width) +
                            ", C], the size the plan was made for")
                               .c_str());
    std::vector<double> yaws;
    for (const double yaw : yaws_deg) yaws.push_back(radians(yaw));
    const Size& view = plan.view().size;
    auto out = output<T>({static_cast<py::ssize_t>(batch.count), static_cast<py::ssize_t>(yaws.size()), view.height,
                          view.width, batch.channels},
                         given);
    const T* from = batch.array.data();
    T* to = out.mutable_data();
    const wiw::bindings::GilRelease release;
    plan.apply(from, batch.count, batch.channels, yaws, interpolation, to);
    return out;
  });
}

/// Resamples a batch by one table without moving columns; `shape` follows the batch axis of the result.
template <class T, class Table>
void remap_batch(const Table& table, const ImageBatch<T>& batch, const Size& source, T* out) {
  parallel_for(batch.count, [&](std::size_t b) {
    const ImageView<const T> image{batch[b].data, source, batch.channels};
    const RemapTarget<T> target{0, out + b * table.size() * static_cast<std::size_t>(batch.channels)};
    remap(table, image, std::span<const RemapTarget<T>>(&target, 1));
  });
}

/// Look-up between panorama and cube of one pair of sizes, either way.
struct CubePlan {
  CubePlan(const Pair& panorama_size, int side, bool to)
      : panorama(to_size(panorama_size)), face_size(side), to_cube(to) {
    bilinear = to_cube ? bilinear_to_cube(panorama, face_size) : bilinear_from_cube(face_size, panorama);
    nearest = to_cube ? nearest_to_cube(panorama, face_size) : nearest_from_cube(face_size, panorama);
  }

  py::array apply(const py::array& images, const std::string& name) const {
    const Interpolation interpolation = to_interpolation(name);
    const Size source = to_cube ? panorama : cube_stack(face_size);
    const Size target = to_cube ? cube_stack(face_size) : panorama;
    return by_type(images, [&]<class T>(T) -> py::array {
      const ImageBatch<T> batch(images);
      bindings::expect_shape(batch.array, {-1, source.height, source.width, -1}, "images of the plan's size");
      py::array_t<T> out({static_cast<py::ssize_t>(batch.count), static_cast<py::ssize_t>(target.height),
                          static_cast<py::ssize_t>(target.width), static_cast<py::ssize_t>(batch.channels)});
      T* to = out.mutable_data();
      const wiw::bindings::GilRelease release;
      if (interpolation == Interpolation::kNearest) {
        remap_batch(nearest, batch, source, to);
      } else if constexpr (std::is_same_v<T, std::uint32_t>) {
        throw ArgumentError("uint32 images hold ids, which cannot be blended: pass interpolation=\"nearest\"");
      } else {
        remap_batch(bilinear, batch, source, to);
      }
      return out;
    });
  }

  Size panorama;
  int face_size;
  bool to_cube;
  BilinearTable bilinear;
  NearestTable nearest;
};

py::array rotate_batch(const py::array& panoramas, double yaw_deg, const std::string& interpolation_name) {
  const Interpolation interpolation = to_interpolation(interpolation_name);
  return by_type(panoramas, [&]<class T>(T) -> py::array {
    const ImageBatch<T> batch(panoramas);
    py::array_t<T> out(std::vector<py::ssize_t>(panoramas.shape(), panoramas.shape() + 4));
    T* to = out.mutable_data();
    const wiw::bindings::GilRelease release;
    parallel_for(batch.count, [&](std::size_t b) {
      rotate(batch[b], radians(yaw_deg), interpolation,
             to + b * batch.size.pixels() * static_cast<std::size_t>(batch.channels));
    });
    return out;
  });
}

py::array resize_batch(const py::array& images, const Pair& size_pair) {
  const Size size = to_size(size_pair);
  return by_type(images, [&]<class T>(T) -> py::array {
    if constexpr (std::is_same_v<T, std::uint32_t>) {
      throw ArgumentError("resize: uint32 images hold ids, which have no mean; expected uint8 or float32");
    } else {
      const ImageBatch<T> batch(images);
      check_resize(batch.size, size);  // before memory is taken
      py::array_t<T> out({static_cast<py::ssize_t>(batch.count), static_cast<py::ssize_t>(size.height),
                          static_cast<py::ssize_t>(size.width), static_cast<py::ssize_t>(batch.channels)});
      T* to = out.mutable_data();
      const wiw::bindings::GilRelease release;
      parallel_for(batch.count, [&](std::size_t b) {
        resize_area(batch[b], size, to + b * size.pixels() * static_cast<std::size_t>(batch.channels));
      });
      return out;
    }
  });
}

py::array_t<float> direction_map(const Pair& size_pair) {
  const Size size = to_size(size_pair);
  check_panorama_size(size);
  py::array_t<float> out({size.height, size.width, 3});
  float* to = out.mutable_data();
  const wiw::bindings::GilRelease release;
  directions(size, to);
  return out;
}

}  // namespace

void bind_panorama(py::module_& module) {
  py::class_<PerspectivePlan, std::shared_ptr<PerspectivePlan>>(
      module, "PerspectivePlan", "Cached look-up of perspective views in panoramas of one size.")
      .def(py::init([](const Pair& panorama, const Pair& size, double hfov_deg, double pitch_deg, bool pixel_centers) {
             const auto convention = pixel_centers ? FovConvention::kPixelCenters : FovConvention::kPixelEdges;
             const PerspectiveView view{to_size(size), radians(hfov_deg), radians(pitch_deg), convention};
             const wiw::bindings::GilRelease release;
             return std::make_shared<PerspectivePlan>(to_size(panorama), view);
           }),
           py::arg("pano_size"), py::arg("size"), py::arg("hfov_deg"), py::arg("pitch_deg") = 0.0,
           py::arg("pixel_centers") = false)
      .def("__call__", &apply_plan, py::arg("panoramas"), py::arg("yaws_deg"), py::arg("interpolation") = "bilinear",
           py::arg("out") = py::none(), "[B, H, W, C] -> [B, yaws, h, w, C]; yaw positive to the left.");
  py::class_<CubePlan>(module, "CubePlan", "Cached look-up between panoramas and cube maps of fixed sizes.")
      .def(py::init<const Pair&, int, bool>(), py::arg("pano_size"), py::arg("face_size"), py::arg("to_cube"),
           py::call_guard<wiw::bindings::GilRelease>())
      .def("__call__", &CubePlan::apply, py::arg("images"), py::arg("interpolation") = "bilinear",
           "[B, H, W, C] -> [B, 6 S, S, C] (to_cube), or the other way.");
  module.def("rotate", &rotate_batch, py::arg("panoramas"), py::arg("yaw_deg"), py::arg("interpolation") = "bilinear",
             "[B, H, W, C] turned to the left by yaw_deg.");
  module.def("resize", &resize_batch, py::arg("images"), py::arg("size"), "Exact area average, [B, H, W, C].");
  module.def("directions", &direction_map, py::arg("size"), "float32 [H, W, 3] unit vectors of a panorama's pixels.");
}
