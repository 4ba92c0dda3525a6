// SPDX-License-Identifier: Apache-2.0
#include "wiw/core/cpu.hpp"

#include <cstdlib>

#include "wiw/core/error.hpp"

namespace wiw {

Isa native_isa() {
#if defined(__x86_64__)
  __builtin_cpu_init();
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("f16c");
  const bool avx512 = __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
                      __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl");
  if (avx2 && avx512) return Isa::kAvx512;
  if (avx2) return Isa::kAvx2;
#endif
  return Isa::kScalar;
}

bool gathers_quickly() {
#if defined(__x86_64__)
  __builtin_cpu_init();
  return __builtin_cpu_is("intel") && __builtin_cpu_supports("avx512fp16");  // Sapphire Rapids was the first with it
#else
  return false;
#endif
}

std::string isa_name(Isa isa) {
  switch (isa) {
    case Isa::kAvx512: return "avx512";
    case Isa::kAvx2: return "avx2";
    case Isa::kScalar: break;
  }
  return "scalar";
}

namespace {

Isa chosen_isa() {
  const Isa native = native_isa();
  const char* wanted = std::getenv("WIW_ISA");
  if (wanted == nullptr || *wanted == '\0') return native;
  for (const Isa isa : {Isa::kScalar, Isa::kAvx2, Isa::kAvx512}) {
    if (isa_name(isa) != wanted) continue;
    if (isa <= native) return isa;
    throw BackendError("WIW_ISA=" + isa_name(isa) + ": this processor only has " + isa_name(native) +
                       "; unset WIW_ISA or choose that");
  }
  throw BackendError(std::string("WIW_ISA=") + wanted + ": expected scalar, avx2 or avx512");
}

}  // namespace

Isa active_isa() {
  static const Isa isa = chosen_isa();
  return isa;
}

}  // namespace wiw
