// SPDX-License-Identifier: Apache-2.0
#include "wiw/annotate/draw.hpp"

#include <algorithm>
#include <cmath>
#include <opencv2/imgproc.hpp>

#include "wiw/core/error.hpp"

namespace wiw::annotate {

namespace {

constexpr int kFont = cv::FONT_HERSHEY_SIMPLEX;
constexpr double kSmallestScale = 0.3;  // below this the font's strokes run together
constexpr double kFullHeight = 30.0;    // pixels of ascent and descent at scale 1
const Color kDark{24, 24, 24};
const Color kLight{245, 245, 245};

cv::Mat as_mat(const Image& image) { return {image.size.height, image.size.width, CV_8UC3, image.data}; }

cv::Scalar as_scalar(const Color& color) { return {double(color[0]), double(color[1]), double(color[2])}; }

/// Black or white, whichever reads better on a plate of this colour (ITU-R BT.601 luma).
Color contrast(const Color& plate) {
  const double luma = 0.299 * plate[0] + 0.587 * plate[1] + 0.114 * plate[2];
  return luma > 140.0 ? kDark : kLight;
}

std::string printable(const std::string& text) {
  std::string shown;
  for (const char c : text) {
    const auto byte = static_cast<unsigned char>(c);
    if (byte >= 0x80 && byte < 0xC0) continue;  // the rest of a UTF-8 character
    shown += byte >= 0x20 && byte < 0x7F ? c : '?';
  }
  return shown;
}

cv::Size extent(const std::string& text, double scale) {
  int below = 0;
  const cv::Size size = cv::getTextSize(text, kFont, scale, 1, &below);
  return {size.width, size.height + below};
}

/// Index of the pixel that holds a coordinate, for drawing into `limit` pixels.
int pixel(double coordinate, int limit) {
  return static_cast<int>(std::clamp(std::floor(coordinate), -1.0e6, 1.0e6 + limit));
}

void fill(const Image& image, const ImageBox& box, const Color& color) {
  const int left = pixel(box.left, image.size.width);
  const int top = pixel(box.top, image.size.height);
  const int right = pixel(box.right - 1e-9, image.size.width);
  const int bottom = pixel(box.bottom - 1e-9, image.size.height);
  if (right < left || bottom < top) return;
  cv::Mat mat = as_mat(image);
  cv::rectangle(mat, {left, top}, {right, bottom}, as_scalar(color), cv::FILLED);
}

int plate_height(const Image& image) { return std::clamp(image.size.height / 24, 12, 22); }

int plate_width(const Image& image, const std::string& label) {
  const double scale = std::max(kSmallestScale, (plate_height(image) - 4) / kFullHeight);
  return std::min(extent(printable(label), scale).width + 8, image.size.width);
}

/// A label on a plate whose upper left corner is at `corner`, moved into the image.
void draw_label(const Image& image, const Point& corner, const std::string& label, const Color& plate) {
  const int height = plate_height(image);
  const double width = plate_width(image, label);
  const double left = std::clamp(corner.x, 0.0, std::max(0.0, image.size.width - width));
  const double top = std::clamp(corner.y, 0.0, std::max(0.0, double(image.size.height) - height));
  const ImageBox area{left, top, left + width, top + height};
  fill(image, area, plate);
  draw_text(image, area, label, contrast(plate), height - 4);
}

void outline(const Image& image, const ImageBox& box, const Color& color, int thickness) {
  const double inset = std::min<double>(thickness, std::min(box.right - box.left, box.bottom - box.top));
  fill(image, {box.left, box.top, box.right, box.top + inset}, color);
  fill(image, {box.left, box.bottom - inset, box.right, box.bottom}, color);
  fill(image, {box.left, box.top, box.left + inset, box.bottom}, color);
  fill(image, {box.right - inset, box.top, box.right, box.bottom}, color);
}

void check_thickness(int thickness) {
  if (thickness < 1) throw ArgumentError("thickness: expected at least 1 pixel, got " + std::to_string(thickness));
}

void check_finite(std::initializer_list<double> values) {
  for (const double value : values) {
    if (!std::isfinite(value)) throw ArgumentError("annotate: expected finite pixel coordinates");
  }
}

}  // namespace

void check_image(const Image& image) {
  if (image.channels != 3 || image.size.height < 1 || image.size.width < 1) {
    throw ArgumentError("annotate: expected an image [H, W, 3] of at least one pixel");
  }
}

void draw_box(Image image, const ImageBox& box, const Color& color, int thickness, const std::string& label) {
  check_image(image);
  check_thickness(thickness);
  check_finite({box.left, box.top, box.right, box.bottom});
  if (box.left <= box.right) {
    outline(image, box, color, thickness);
  } else {
    // Two open halves: their ends at the seam lie outside the image.
    const double beyond = image.size.width + 2.0 * thickness;
    outline(image, {box.left, box.top, beyond, box.bottom}, color, thickness);
    outline(image, {-2.0 * thickness, box.top, box.right, box.bottom}, color, thickness);
  }
  if (!label.empty()) draw_label(image, {box.left, box.top - plate_height(image)}, label, color);
}

void draw_mark(Image image, const Point& center, const Color& color, int radius, const std::string& label, int gap) {
  check_image(image);
  check_finite({center.x, center.y});
  if (radius < 1) throw ArgumentError("radius: expected at least 1 pixel, got " + std::to_string(radius));
  cv::Mat mat = as_mat(image);
  const cv::Point at{pixel(center.x, image.size.width), pixel(center.y, image.size.height)};
  const int beside = gap < 0 ? at.x - radius + gap : at.x + radius + gap;
  if (!label.empty()) cv::line(mat, at, {beside, at.y}, as_scalar(kDark), 1, cv::LINE_AA);
  cv::circle(mat, at, radius, as_scalar(kLight), cv::FILLED, cv::LINE_AA);
  cv::circle(mat, at, std::max(radius - 2, 1), as_scalar(color), cv::FILLED, cv::LINE_AA);
  if (label.empty()) return;
  const int left = gap < 0 ? beside - plate_width(image, label) : beside;
  draw_label(image, {double(left), at.y - plate_height(image) / 2.0}, label, kDark);
}

void draw_axes(Image image, const Point& origin, const std::array<Point, 3>& ends, int thickness) {
  check_image(image);
  check_thickness(thickness);
  static const std::array<Color, 3> colors{Color{220, 40, 40}, Color{40, 170, 60}, Color{50, 90, 230}};
  static const std::array<const char*, 3> letters{"x", "y", "z"};
  cv::Mat mat = as_mat(image);
  const auto at = [&](const Point& point) {
    check_finite({point.x, point.y});
    return cv::Point{pixel(point.x, image.size.width), pixel(point.y, image.size.height)};
  };
  for (std::size_t axis = 0; axis < 3; ++axis) {
    cv::arrowedLine(mat, at(origin), at(ends[axis]), as_scalar(colors[axis]), thickness, cv::LINE_AA);
    draw_label(image, {ends[axis].x + 3, ends[axis].y - 6}, letters[axis], colors[axis]);
  }
}

void draw_text(Image image, const ImageBox& area, const std::string& text, const Color& color, int height) {
  check_image(image);
  std::string shown = printable(text);
  if (shown.empty()) return;
  const double room = area.right - area.left - 4.0;
  double scale = std::max(kSmallestScale, height / kFullHeight);
  const int wanted = extent(shown, scale).width;
  if (wanted > room) scale = std::max(kSmallestScale, scale * room / wanted);
  while (shown.size() > 4 && extent(shown, scale).width > room) {
    shown = shown.substr(0, shown.size() - 4) + "...";
  }
  int below = 0;
  const cv::Size size = cv::getTextSize(shown, kFont, scale, 1, &below);
  const int x = static_cast<int>(std::lround((area.left + area.right - size.width) / 2.0));
  const int y = static_cast<int>(std::lround((area.top + area.bottom + size.height) / 2.0)) - (below > 4 ? 1 : 0);
  cv::Mat mat = as_mat(image);
  cv::putText(mat, shown, {x, y}, kFont, scale, as_scalar(color), 1, cv::LINE_AA);
}

}  // namespace wiw::annotate
