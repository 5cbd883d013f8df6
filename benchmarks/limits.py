"""What the machine can do at most: bytes per second to and from memory, multiply-adds in vectors per second.

Bytes: torch scales an array larger than the caches in place, a slice for each thread; bytes read and bytes written both
count. (A copy moves a quarter less: it reads what it is about to overwrite, uncounted.)
Operations: Warp kernels built as the blends are, independent chains of fused multiply-adds in lanes, as many as one
or another kind of processor has registers for; the faster counts. One on LANES numbers counts as one operation; where
the processor's registers are narrower than LANES, it takes several there, and here. ``--code`` counts what is in the
machine code of these kernels, of the blend and of its adjoint: the width of multiply-adds, and stores by mask, which
AVX2 of AMD does slowly. ``WARP_SPLAT_TARGET="-target-cpu x86-64-v3"`` shows it for AVX2 on any processor.

    python benchmarks/limits.py [--code]
"""

import re
import subprocess
import tempfile
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
import warp as wp
from common import interleaved, option, parse

from warp_splat.config import RasterOptions
from warp_splat.kernels.compiler import FORWARD_ONLY, once
from warp_splat.kernels.cpu.adjoint import make_reverse
from warp_splat.kernels.cpu.blend import make_blend
from warp_splat.kernels.simd import LANES, fma, vec16
from warp_splat.raster.data import variant_of
from warp_splat.runtime import launch, pool
from warp_splat.runtime.launch import view

SCALED = 2**28  # bytes, many times any cache
CHAINS = (7, 12)  # registers for either: sixteen of half of LANES, thirty-two
UNROLLED, ROUNDS = 16, 2**14  # milliseconds: less, and a helper that wakes late counts
REPEATS = 7  # the best counts: a limit is what was reached once


@once
def make_multiply_add(chains: int) -> wp.Kernel:
    """So many chains at once."""
    mat_chains = wp.types.matrix(shape=(chains, LANES), dtype=float)

    @wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
    def multiply_add(first: int, rounds: int, factor: float, values_out: wp.array2d[vec16]):
        i = first + wp.tid()
        x = mat_chains()
        for chain in range(chains):
            x[chain] = values_out[i, chain]
        scale = vec16(factor)
        for _round in range(rounds):
            for _k in range(UNROLLED):
                for chain in range(chains):
                    x[chain] = fma(x[chain], scale, scale)
        for chain in range(chains):
            values_out[i, chain] = x[chain]

    return multiply_add


class Limits(NamedTuple):
    """Of the threads that were asked for, together."""

    bandwidth: float  # bytes per second
    rate: float  # vector operations of LANES numbers per second

    def floor(self, size: float, operations: float) -> float:
        """The least seconds for ``size`` bytes and as many operations on single numbers."""
        return max(size / self.bandwidth, operations / LANES / self.rate)


def measure_limits(threads: int) -> Limits:
    """With ``threads`` threads, which stay set."""
    pool.set_threads(threads)
    return Limits(_bandwidth(threads), _rate(threads))


def _bandwidth(threads: int) -> float:
    values = torch.ones(SCALED // 4)
    with ThreadPoolExecutor(threads) as pool:
        return 2 * SCALED / _least(lambda: list(pool.map(lambda part: part.mul_(0.5), values.chunk(threads))))


def _rate(threads: int) -> float:
    count, found = 16 * threads, []
    for chains in CHAINS:
        given, bounds = [view(torch.zeros(count, chains, LANES), vec16)], pool.even_slices(count, 1)
        run = partial(launch.launch, make_multiply_add(chains), count, [ROUNDS, 0.5], given, bounds=bounds)
        found.append(count * chains * UNROLLED * ROUNDS / _least(run))
    return max(found)


def _least(run) -> float:
    """Seconds of the fastest of some runs, after one that does not count."""
    return interleaved({"": run}, REPEATS, of=min)[""]


def machine_code(kernel: wp.Kernel) -> Counter:
    """Multiply-adds and stores by mask in a kernel's machine code, by width of their registers (needs objdump)."""
    with tempfile.TemporaryDirectory() as folder:
        wp.compile_aot_module(kernel.module, device="cpu", module_dir=folder, strip_hash=True)
        (built,) = Path(folder).rglob("*.o")
        code = subprocess.run(["objdump", "-d", built], check=True, capture_output=True, text=True).stdout
    found = re.findall(r"\t(vfn?m(?:add|sub)\d+[ps]s|fmla|fmadd)\s.*?(zmm|ymm|xmm|v\d|s\d)", code)
    found += re.findall(r"\t(vp?maskmov\w+)\s+%(ymm|xmm)\d+,%[xy]mm\d+,", code)
    return Counter(f"{name} {register}" for name, register in found)


def main() -> None:
    arguments = parse(__doc__, option("--code", action="store_true", help="count the machine code's instructions, too"))
    launch.prepare("cpu", 0)
    for threads in (1, 2):
        limits = measure_limits(threads)
        print(f"{threads}: {limits.bandwidth / 1e9:.1f} GB/s, {limits.rate / 1e9:.2f} G vector operations/s")
    if arguments.code:
        variant = variant_of(RasterOptions())
        for kernel in (*map(make_multiply_add, CHAINS), make_blend(variant), make_reverse("manual", variant)):
            print(kernel.key, dict(machine_code(kernel)))


if __name__ == "__main__":
    main()
