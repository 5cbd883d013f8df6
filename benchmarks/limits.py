"""What the machine can do at most: bytes per second to and from memory, multiply-adds in vectors per second.

Bytes: torch scales an array larger than the caches in place, a slice for each thread; bytes read and bytes written both
count. (A copy moves a quarter less: it reads what it is about to overwrite, uncounted.)
Operations: a Warp kernel built as the blends are, 12 independent chains of multiply-adds in lanes. One on LANES
numbers counts as one operation; where the processor's registers are narrower than LANES, it takes several there, and
here. On AVX-512 the machine code is 512 bits wide throughout (``python benchmarks/limits.py --code`` counts it).

    python benchmarks/limits.py [--code]
"""

import re
import subprocess
import tempfile
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import torch
import warp as wp
from common import interleaved, option, parse

from warp_splat.kernels.compiler import FORWARD_ONLY
from warp_splat.kernels.simd import LANES, vec16
from warp_splat.runtime import launch, pool
from warp_splat.runtime.launch import view

SCALED = 2**28  # bytes, many times any cache
CHAINS, UNROLLED, ROUNDS = 12, 16, 2**14  # 7 ms: less, and a helper that wakes late counts
REPEATS = 7  # the best counts: a limit is what was reached once

mat_chains = wp.types.matrix(shape=(CHAINS, LANES), dtype=float)


@wp.kernel(module="unique", module_options=dict(FORWARD_ONLY))
def multiply_add(first: int, rounds: int, factor: float, values_out: wp.array2d[vec16]):
    i = first + wp.tid()
    x = mat_chains()
    for chain in range(CHAINS):
        x[chain] = values_out[i, chain]
    scale = vec16(factor)
    for _round in range(rounds):
        for chain in range(CHAINS):
            a = x[chain]
            for _k in range(UNROLLED):
                a = wp.cw_mul(a, scale) + scale
            x[chain] = a
    for chain in range(CHAINS):
        values_out[i, chain] = x[chain]


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
    count = 16 * threads
    values = torch.zeros(count, CHAINS, LANES)
    run = lambda: launch.launch(  # noqa: E731
        multiply_add, count, [ROUNDS, 0.5], [view(values, vec16)], bounds=pool.even_slices(count, 1)
    )
    return count * CHAINS * UNROLLED * ROUNDS / _least(run)


def _least(run) -> float:
    """Seconds of the fastest of some runs, after one that does not count."""
    return interleaved({"": run}, REPEATS, of=min)[""]


def machine_code() -> Counter:
    """Multiply-adds in the kernel's machine code, by width of their registers (needs objdump)."""
    with tempfile.TemporaryDirectory() as folder:
        wp.compile_aot_module(multiply_add.module, device="cpu", module_dir=folder, strip_hash=True)
        (built,) = Path(folder).rglob("*.o")
        code = subprocess.run(["objdump", "-d", built], check=True, capture_output=True, text=True).stdout
    found = re.findall(r"\t(vfmadd\d+[ps]s|fmla|fmadd)\s.*?(zmm|ymm|xmm|v\d|s\d)", code)
    return Counter(f"{name} {register}" for name, register in found)


def main() -> None:
    arguments = parse(__doc__, option("--code", action="store_true", help="count the machine code's instructions, too"))
    launch.prepare("cpu", 0)
    for threads in (1, 2):
        limits = measure_limits(threads)
        print(f"{threads}: {limits.bandwidth / 1e9:.1f} GB/s, {limits.rate / 1e9:.2f} G vector operations/s")
    if arguments.code:
        print(dict(machine_code()))


if __name__ == "__main__":
    main()
