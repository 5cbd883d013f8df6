"""How Warp builds kernels: once in a process, and for the CPU so that every processor computes the same bytes.

The compiler fuses no multiplication with an addition and regroups no sum: where it would, depends on the processor's
instructions and width. What pays is fused by hand (:func:`.simd.fma`), and lanes are vectors. No flag lets it assume
that NaN or infinity never occur. The width is an upper bound, which AVX2 or NEON cut down.
"""

import functools
import os
from collections.abc import Callable
from typing import TypeVar

import warp as wp

from warp_splat.errors import InputError

#: Warp's way to say "this machine", or another processor for tests: "-target-cpu x86-64-v3".
TARGET = os.environ.get("WARP_SPLAT_TARGET") or "-march=native"
if not TARGET.startswith("-"):  # which ends Warp's compiler, and the process with it
    expected = "expected flags such as '-target-cpu x86-64-v3'"
    raise InputError(f"WARP_SPLAT_TARGET: {expected}, got {TARGET!r:.50}; mend or unset it.")

#: Multiplications and additions apart, where :func:`.simd.fma` fuses them: x86-64 without AVX2 has no such instruction.
_portable = os.environ.get("WARP_SPLAT_PORTABLE", "")
if _portable not in ("", "0", "1"):
    expected = "expected 1, 0 or nothing in this environment variable"
    raise InputError(f"WARP_SPLAT_PORTABLE: {expected}, got {_portable!r:.50}; set it to one of them.")
PORTABLE = _portable == "1"

#: The stack is aligned for lanes that do not fit into registers: what crosses two lines of the cache holds up its
#: readers. Without, the same kernel takes up to a fifth longer, as the frames of its callers happen to lie. Loops over
#: blocks in lanes are short: vectorized across blocks they take three times as long. All kernels have the same flags,
#: since for each set of them, in each process, Warp compiles its headers first, which takes about 2 s.
_FLAGS = f"{TARGET} -ffp-contract=off -fno-signed-zeros -mstackrealign -mprefer-vector-width=512 -fno-vectorize"

DIFFERENTIABLE = {"optimization_level": 3, "cpu_compiler_flags": _FLAGS, "enable_backward": True}

FORWARD_ONLY = {**DIFFERENTIABLE, "enable_backward": False}

_MADE = TypeVar("_MADE")
#: Warp's own, under which it writes kernels down; what makes a kernel makes its functions, too.
_making = wp._src.codegen._codegen_lock  # pyright: ignore[reportAttributeAccessIssue]


def once(make: Callable[..., _MADE]) -> Callable[..., _MADE]:
    """As ``functools.cache``, but a thread that needs a kernel waits while another makes or loads one.

    Warp and the parser of CPython 3.11 cannot do so in several threads at once: kernels of threads that rendered first
    together were mixed up, or failed.
    """
    known = functools.cache(make)

    @functools.wraps(make)
    def made(*given, **named) -> _MADE:
        with _making:
            return known(*given, **named)

    return made
