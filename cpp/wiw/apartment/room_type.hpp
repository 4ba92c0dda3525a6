// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>

namespace wiw::apartment {

enum class RoomType { kLiving, kDining, kKitchen, kBedroom, kKids, kStudy, kBathroom, kLaundry, kCorridor, kHall };

constexpr std::array<const char*, 10> kRoomNames{"living room", "dining room", "kitchen", "bedroom",  "kids room",
                                                 "study",       "bathroom",    "laundry", "corridor", "hall"};
constexpr const char* room_name(RoomType type) { return kRoomNames[static_cast<std::size_t>(type)]; }

constexpr bool is_passage(RoomType type) { return type == RoomType::kCorridor || type == RoomType::kHall; }
constexpr bool is_wet(RoomType type) { return type == RoomType::kBathroom || type == RoomType::kLaundry; }

}  // namespace wiw::apartment
