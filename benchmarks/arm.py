"""Linux on ARM, emulated: whether the same bytes come out as here, and whether the hot loops are vectors.

    python benchmarks/arm.py [--root FOLDER] [--flags "-target-cpu x86-64-v3"] [--steps 50] [--out docs/benchmarks]

Makes a folder with Debian's arm64 Python, PyPI's aarch64 wheels and qemu, once: 2 GB. Nothing is installed on this
machine. It needs Debian's or Ubuntu's apt-get, uv, and llvm-objdump. Runs ``benchmarks/processor_hashes.py`` there and
here, compares array by array, and counts instructions in the objects that Warp compiled.
"""

import argparse
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from common import write_table

REPOSITORY = Path(__file__).parents[1]
DEBIAN = ("python3-minimal", "libpython3-stdlib", "libgomp1", "libstdc++6")
PLATFORM = "aarch64-manylinux_2_34"  # of Warp's wheel
TORCH = "torch==2.10.0"  # the last one whose wheel for ARM brings no CUDA: 139 MiB
PROCESSOR = "neoverse-n1"  # NEON without SVE, as Apple's
DEFAULT_ROOT = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "warp-splat-arm"
APT = """APT::Architecture "arm64"; APT::Architectures {{ "arm64"; "{host}"; }};
Dir::State "{root}/apt"; Dir::State::status "{root}/apt/status"; Dir::Cache "{root}/apt"; APT::Sandbox::User "";
"""

#: Kernels whose loops take the time of a step.
HOT = ("project", "shade", "adj_shade", "blend", "upstream", "adj_blend", "walk", "ssim", "adam")
#: Floating-point arithmetic; on x86-64 the name says whether it is packed, on ARM the operands do.
X86 = re.compile(r"v?(?:add|sub|mul|div|sqrt|min|max|fn?m(?:add|sub)\d+)([ps])[sd]")
ARM = re.compile(r"f(?:add|sub|mul|div|sqrt|min|max|minnm|maxnm|mla|mls|madd|msub|nmadd|nmsub|nmul|neg|abs)")


def make_root(root: Path) -> None:
    """Unpack Python, qemu and the wheels below ``root``, unless they are there."""
    if (root / "complete").exists():
        return
    for folder in ("apt/lists/partial", "apt/archives/partial", "debian", "host"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    host = _output("dpkg", "--print-architecture").strip()
    (root / "apt.conf").write_text(APT.format(root=root, host=host))
    (root / "apt/status").touch()
    apt = {**os.environ, "APT_CONFIG": str(root / "apt.conf")}
    install = ["apt-get", "install", "-y", "-qq", "--download-only", "--no-install-recommends"]
    for command in (
        ["apt-get", "update", "-qq"],
        [*install, *DEBIAN],
        ["apt-get", "download", f"qemu-user-static:{host}"],
    ):
        subprocess.run(command, env=apt, cwd=root, check=True)
    for package in (root / "apt/archives").glob("*.deb"):
        subprocess.run(["dpkg-deb", "-x", package, root / "debian"], check=True)
    subprocess.run(["dpkg-deb", "-x", next(root.glob("qemu-user-static*.deb")), root / "host"], check=True)

    pins = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["uv"]["constraint-dependencies"]
    (root / "constraints.txt").write_text("\n".join([*(pin for pin in pins if not pin.startswith("torch=")), TORCH]))
    uv = os.environ.get("UV") or shutil.which("uv") or "uv"
    where = ["--target", root / "wheels", "--python-version", python(root).name[6:], "--python-platform", PLATFORM]
    chosen = ["--only-binary", ":all:", "-c", root / "constraints.txt", "-r", REPOSITORY / "pyproject.toml"]
    subprocess.run([uv, "pip", "install", "-q", "--no-config", *where, *chosen], check=True)
    (root / "complete").touch()


def python(root: Path) -> Path:
    """Debian's interpreter, such as python3.11."""
    return next(path for path in (root / "debian/usr/bin").glob("python3.*") if path.name[8:].isdigit())


def run_emulated(root: Path, kernels: Path, *arguments: object) -> str:
    """Run the emulated Python in this repository; returns what it prints."""
    paths = {"PYTHONPATH": f"{root / 'wheels'}:{REPOSITORY}", "WARP_CACHE_PATH": str(kernels)}
    emulator = [root / "host/usr/bin/qemu-aarch64-static", "-cpu", PROCESSOR, "-L", root / "debian"]
    return _output(*emulator, python(root), *arguments, **paths, OPENBLAS_NUM_THREADS="1")


def run_both(root: Path, flags: str, steps: int) -> tuple[dict[str, Path], dict[str, Path]]:
    """Compute the arrays on both processors; returns files of them and folders of the kernels, by processor."""
    sources = sorted((REPOSITORY / "warp_splat" / "kernels").rglob("*.py"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources) + flags.encode()).hexdigest()[:8]
    arrays = {name: root / f"{name}.npz" for name in ("ARM", "here")}
    kernels = {name: root / f"kernels-{name}-{digest}" for name in arrays}
    program = [REPOSITORY / "benchmarks" / "processor_hashes.py", "--steps", steps, "--out"]
    here = _output(sys.executable, *program, arrays["here"], "--flags", flags, WARP_CACHE_PATH=str(kernels["here"]))
    there = run_emulated(root, kernels["ARM"], *program, arrays["ARM"])
    for name, text in (("here", here), ("ARM", there)):
        (root / f"{name}.txt").write_text(text)
    return arrays, kernels


def compare(ours: Path, theirs: Path) -> list[tuple[str, str]]:
    """Name of each array, and "equal" or by how much the two files disagree."""
    rows = []
    with np.load(ours) as here, np.load(theirs) as there:
        for name in here.files:
            a, b = here[name], there[name]
            if a.shape != b.shape:
                rows.append((name, f"shapes {a.shape}, {b.shape}"))
            elif a.tobytes() == b.tobytes():
                rows.append((name, "equal"))
            else:
                far = np.abs(a.astype(np.float64) - b).max() / max(np.abs(a.astype(np.float64)).max(), 1e-30)
                rows.append((name, f"{np.count_nonzero(a != b)} of {a.size} differ, by {far:.0e} of the largest"))
    return rows


def vectors(objects: Path) -> Iterator[tuple[str, int, int, int, int]]:
    """Kernel; packed and scalar arithmetic instructions of it, and of its inner loop with the most packed ones."""
    for path in sorted(objects.rglob("*.o")):
        kernel = re.sub(
            r"^wp_(?:warp_splat\.kernels\.)?(?:make_\w+__locals__)?|(_[0-9a-f]{7,8})+$", "", path.parent.name
        )
        text = _output("llvm-objdump", "-d", "--no-show-raw-insn", path)
        code = re.findall(r"^ *([0-9a-f]+):\s+(\S+)[ \t]*(.*)$", text, re.MULTILINE)
        kinds = [(int(address, 16), _kind(name, operands)) for address, name, operands in code]
        jumps = [(int(a, 16), int(to[1], 16)) for a, name, rest in code if (to := _target(name, rest))]
        loops = [(to, at) for at, to in jumps if to <= at]
        inner = [(lo, hi) for lo, hi in loops if not any(lo <= a and b <= hi and (a, b) != (lo, hi) for a, b in loops)]
        counts = [_count(kind for at, kind in kinds if lo <= at <= hi) for lo, hi in inner]
        yield kernel, *_count(kind for _, kind in kinds), *max(counts, default=(0, 0))


def _kind(name: str, operands: str) -> str:
    """The letter p of packed, s of scalar arithmetic, else nothing."""
    if match := X86.fullmatch(name):
        return match[1]
    return ("p" if re.search(r"v\d+\.\d", operands) else "s") if ARM.fullmatch(name) else ""


def _target(name: str, operands: str) -> re.Match | None:
    """Where a jump goes, unless it is a call."""
    return None if name == "bl" or name.startswith("call") else re.search(r"0x([0-9a-f]+) <", operands)


def _count(kinds: Iterator[str]) -> tuple[int, int]:
    found = "".join(kinds)
    return found.count("p"), found.count("s")


def _output(*command: object, **environment: str) -> str:
    words, variables = [str(word) for word in command], {**os.environ, **environment}
    return subprocess.run(words, env=variables, cwd=REPOSITORY, check=True, stdout=subprocess.PIPE, text=True).stdout


def main() -> None:
    """Print which arrays are equal, and the table of instructions; exit code 1 if an array is not equal."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, default=DEFAULT_ROOT, help="folder of the emulated machine")
    parser.add_argument("--flags", default="-march=native", help="of the compiler here, to choose a processor")
    parser.add_argument("--steps", type=int, default=50, help="of training")
    parser.add_argument("--out", type=Path, help="folder for the tables")
    arguments = parser.parse_args()
    make_root(arguments.root)
    arrays, kernels = run_both(arguments.root, arguments.flags, arguments.steps)
    rows = compare(arrays["here"], arrays["ARM"])
    note = f"Emulated {PROCESSOR} (qemu-user) against `{arguments.flags}` here."
    write_table("arm", arguments.out, ["array", "on both"], rows, note, dict(rows))
    counts = [(kernel, name, *found) for name, folder in kernels.items() for kernel, *found in vectors(folder)]
    headers = ["kernel", "processor", "packed", "scalar", "packed, inner loop", "scalar, inner loop"]
    note = (
        "Floating-point arithmetic instructions of all of the kernel, and of its inner loop with the most packed ones."
    )
    write_table("arm_vectors", arguments.out, headers, sorted(counts), note, {"rows": sorted(counts)})
    sys.exit(any(agreement != "equal" for _, agreement in rows))


if __name__ == "__main__":
    main()
