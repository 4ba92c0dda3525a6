// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <vector>

namespace wiw::metrics {

/// Share of an episode's success kept for the way taken: S * L' / max(L, L') with shortest length L' and travelled
/// length L (Anderson et al. 2018, and the paper's ImageNav appendix). Credit S is in [0, 1]. Where L' is 0 the agent
/// began at the goal: the ratio is 1 if it did not move and 0 otherwise. Throws ArgumentError for sizes that differ,
/// negative lengths, NaN, or credit on a goal that cannot be reached (L' infinite).
std::vector<double> path_efficiency(std::span<const double> credit, std::span<const double> shortest,
                                    std::span<const double> travelled);

/// Answer score sigma in [1, 5] (values outside are clipped) mapped to [0, 1] as (sigma - 1) / 4.
std::vector<double> answer_credit(std::span<const double> raw);

/// Throws ArgumentError for an empty list, which has no mean, and for values that are not finite.
double mean(std::span<const double> values);

}  // namespace wiw::metrics
