// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

namespace wiw {

/// Instruction set that the vectorised kernels dispatch on.
enum class Isa { kScalar = 0, kAvx2 = 1, kAvx512 = 2 };

/// Best set that both this processor and the environment variable WIW_ISA (scalar | avx2 | avx512) allow.
/// Read once; an unknown value or one the processor lacks throws BackendError.
Isa active_isa();

/// Best set of this processor alone. AVX2 implies FMA and F16C; AVX-512 implies F, DQ, BW and VL.
Isa native_isa();

/// Whether gather instructions beat separate loads: they are microcode on AMD's processors, and slowed down on Intel's
/// before Sapphire Rapids against leaks of data between processes.
bool gathers_quickly();

std::string isa_name(Isa isa);

}  // namespace wiw
