"""Numbers in 16 bits: the upper half of float32 (bfloat16), rounded at random, so that small changes are not lost.

A number lies between two of 16 bits. It becomes the one or the other with probabilities that keep its mean. The random
bits are a hash (C. Wellons' lowbias32) of where the number stands and of the step: the same on any device, and for any
number of threads.
"""

import warp as wp

from warp_splat.kernels.simd import LANES, vec16, vec16i

vec16h = wp.types.vector(length=LANES, dtype=wp.uint16)
#: The type of a number in 16 bits for a number of lanes.
HALF = {1: wp.uint16, LANES: vec16h}

_HASH = "x ^= x >> 16; x *= 0x7feb352du; x ^= x >> 15; x *= 0x846ca68bu; x ^= x >> 16; "
_LANES = "".join(
    f"typedef {kind} {name} __attribute__((vector_size({size * LANES}), aligned({size}), may_alias)); "
    for name, kind, size in (("V", "float", 4), ("U", "unsigned", 4), ("H", "unsigned short", 2))
)


@wp.func_native(f"unsigned x = (unsigned)place ^ (unsigned)key; {_HASH} return (int)x;")
def noise(place: int, key: int, like: float) -> int:
    """32 random bits for the number at ``place``; for lanes, for those from there on."""


@wp.func_native(
    f"{_LANES} U x; for (int lane = 0; lane < {LANES}; ++lane) x[lane] = (unsigned)place + lane; "
    f"x ^= (unsigned)key; {_HASH} wp::vec_t<{LANES}, int> r; (U&)r = x; return r;"
)
def noise(place: int, key: int, like: vec16) -> vec16i: ...


@wp.func_native("unsigned x = (unsigned)half << 16; float r; memcpy(&r, &x, 4); return r;")
def widened(half: wp.uint16) -> float:
    """In 32 bits."""


@wp.func_native(
    f"{_LANES} wp::vec_t<{LANES}, float> r; (V&)r = (V)(__builtin_convertvector((H&)half, U) << 16); return r;"
)
def widened(half: vec16h) -> vec16: ...


for number in (float, vec16):

    @wp.func
    def widened(whole: number):
        return whole  # it is


@wp.func_native(
    "unsigned x; memcpy(&x, &value, 4); return (unsigned short)((x + (((unsigned)bits >> shift) & 65535u)) >> 16);"
)
def rounded(value: float, bits: int, shift: int) -> wp.uint16:
    """In 16 bits, by 16 random ``bits`` from ``shift`` on; what they hold exactly stays."""


@wp.func_native(
    f"{_LANES} wp::vec_t<{LANES}, wp::uint16> r; "
    "(H&)r = __builtin_convertvector(((U)(V&)value + (((U&)bits >> (unsigned)shift) & 65535u)) >> 16, H); return r;"
)
def rounded(value: vec16, bits: vec16i, shift: int) -> vec16h: ...
