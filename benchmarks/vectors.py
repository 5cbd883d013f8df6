"""Whether the kernels compute in vectors: arithmetic instructions of what ``benchmarks/arm.py`` had Warp compile.

    python benchmarks/vectors.py [--root FOLDER] [--out docs/benchmarks]

Needs llvm-objdump.
"""

import re
import subprocess
from collections.abc import Iterable, Iterator
from pathlib import Path

from arm import DEFAULT_ROOT, kernel_folders
from common import option, parse, write_table

#: Kernels whose loops take the time of a step.
HOT = ("project", "shade", "adj_shade", "blend", "upstream", "adj_blend", "walk", "ssim", "adam")
#: Floating-point arithmetic. On x86-64 the name says whether it is packed, on ARM the operands do.
X86 = re.compile(r"v?(?:add|sub|mul|div|sqrt|min|max|fn?m(?:add|sub)\d+)([ps])[sd]")
ARM = re.compile(r"f(?:add|sub|mul|div|sqrt|min|max|minnm|maxnm|mla|mls|madd|msub|nmadd|nmsub|nmul|neg|abs)")
BYTES = {"x": 16, "y": 32, "z": 64}  # of xmm, ymm, zmm
DECORATION = r"^wp_(?:warp_splat\.kernels\.)?(?:make_\w+__locals__)?|(?:_[0-9a-f]{7,8})+$"  # around a kernel's name


def vectors(objects: Path) -> Iterator[tuple[str, int, int, int, int]]:
    """Kernel; operations in vectors and scalar ones, of all of it and of its inner loop with the most in vectors."""
    for path in sorted(objects.glob("*/wp_*/*.o")):
        if re.search(r"_p\d+_t\d+$", path.parent.name):  # of a run that was stopped
            continue
        command = ["llvm-objdump", "-d", "--no-show-raw-insn", path]
        text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        code = [
            (int(address, 16), name, operands)
            for address, name, operands in re.findall(r"^ *([0-9a-f]+):\s+(\S+)[ \t]*(.*)$", text, re.MULTILINE)
        ]
        widths = [(address, _width(name, operands)) for address, name, operands in code]
        loops = [(to, at) for at, name, operands in code if (to := _target(name, operands)) is not None and to <= at]
        inner = [(lo, hi) for lo, hi in loops if not any(lo <= a and b <= hi and (a, b) != (lo, hi) for a, b in loops)]
        counts = [_count(width for at, width in widths if lo <= at <= hi) for lo, hi in inner]
        kernel = re.sub(DECORATION, "", path.parent.name)
        yield kernel, *_count(width for _, width in widths), *max(counts, default=(0, 0))


def _width(name: str, operands: str) -> int:
    """How many numbers an arithmetic instruction takes at once; 0 of other instructions."""
    if match := X86.fullmatch(name):
        wide = "xyz"[max("xyz".index(register) for register in re.findall("([xyz])mm", operands))]
        return BYTES[wide] // (4 if name.endswith("s") else 8) if match[1] == "p" else 1
    if ARM.fullmatch(name):
        match = re.search(r"v\d+\.(\d+)", operands)
        return int(match[1]) if match else 1
    return 0


def _target(name: str, operands: str) -> int | None:
    """The address where a jump goes; None of calls and other instructions."""
    match = re.search(r"0x([0-9a-f]+) <", operands)
    return int(match[1], 16) if match and name != "bl" and not name.startswith("call") else None


def _count(widths: Iterable[int]) -> tuple[int, int]:
    """Operations in vectors, scalar operations."""
    found = list(widths)
    return sum(width for width in found if width > 1), found.count(1)


def main() -> None:
    """Print the table."""
    arguments = parse(__doc__, option("--root", type=Path, default=DEFAULT_ROOT, help="folder of the emulated machine"))
    folders = kernel_folders(arguments.root)
    rows = sorted((kernel, name, *found) for name, at in folders.items() for kernel, *found in vectors(at))
    headers = ["kernel", "processor", "in vectors", "scalar", "inner loop: in vectors", "scalar"]
    note = (
        "Floating-point operations in the code of each kernel, and in its inner loop with the most of them in vectors. "
        "An instruction on eight numbers counts eight."
    )
    write_table("vectors", arguments.out, headers, rows, note, {"rows": rows})


if __name__ == "__main__":
    main()
