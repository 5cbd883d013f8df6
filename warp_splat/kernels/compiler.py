"""How Warp builds the kernels for the CPU.

The flags name what the compiler may do, not a processor. ``-march=native`` is Warp's way to say "this machine". The
width is an upper bound, which AVX2 or NEON cut down. No flag lets the compiler assume that NaN or infinity never occur.
"""

#: The stack is aligned for lanes that do not fit into registers: what crosses two lines of the cache holds up its
#: readers. Without, the same kernel takes up to a fifth longer, as the frames of its callers happen to lie.
_FLAGS = "-march=native -ffp-contract=off -fno-signed-zeros -mstackrealign"

#: Of most modules. Sums over lanes may be regrouped, or they would not vectorize.
FORWARD_ONLY = {
    "enable_backward": False,
    "optimization_level": 3,
    "cpu_compiler_flags": f"{_FLAGS} -mprefer-vector-width=512",
}

#: Of those whose sums keep their order: (mean - center) - center_low is nothing but that.
IN_ORDER = {"enable_backward": False, "optimization_level": 3, "cpu_compiler_flags": _FLAGS}

#: Of those in lanes: the loss, whose bits then do not depend on how a compiler regroups.
LANES_IN_ORDER = {**IN_ORDER, "cpu_compiler_flags": f"{_FLAGS} -mprefer-vector-width=512"}

#: Of the loops over blocks in lanes: they are short, and vectorized across blocks they take three times as long.
IN_LANES = {**FORWARD_ONLY, "cpu_compiler_flags": f"{FORWARD_ONLY['cpu_compiler_flags']} -fno-vectorize"}

#: Of lanes that Warp differentiates.
DIFFERENTIABLE_LANES = {"optimization_level": 3, "cpu_compiler_flags": f"{_FLAGS} -mprefer-vector-width=512"}
