"""Linux on ARM, emulated: whether the same bytes come out as here.

    python benchmarks/arm.py [--root FOLDER] [--steps 50] [--adjoints manual] [--out docs/benchmarks]

Makes a folder with Debian's arm64 Python, PyPI's aarch64 wheels and qemu, once: 2 GB. Nothing is installed on this
machine. It needs Debian's or Ubuntu's apt-get, and uv. Runs ``benchmarks/processor_hashes.py`` there and here, and
compares array by array. ``benchmarks/vectors.py`` reads the objects that Warp compiled for both.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
from common import option, parse, write_table

from warp_splat.config import ADJOINTS

REPOSITORY = Path(__file__).parents[1]
DEBIAN = ("python3-minimal", "libpython3-stdlib", "libgomp1", "libstdc++6")
PLATFORM = "aarch64-manylinux_2_34"  # of Warp's wheel
TORCH = "torch==2.10.0"  # the last one whose wheel for ARM brings no CUDA: 139 MiB
PROCESSOR = "neoverse-n1"  # NEON without SVE, as Apple's
DEFAULT_ROOT = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "warp-splat-arm"
APT = """APT::Architecture "arm64"; APT::Architectures {{ "arm64"; "{host}"; }};
Dir::State "{root}/apt"; Dir::State::status "{root}/apt/status"; Dir::Cache "{root}/apt"; APT::Sandbox::User "";
"""


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


def kernel_folders(root: Path) -> dict[str, Path]:
    """Where Warp keeps its objects for the two processors, anew for other sources."""
    sources = sorted((REPOSITORY / "warp_splat" / "kernels").rglob("*.py"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:8]
    return {name: root / f"kernels-{name}-{digest}" for name in ("ARM", "here")}


def run_both(root: Path, *options: object) -> dict[str, Path]:
    """Compute the arrays on both processors; returns the files of them, by processor."""
    arrays = {name: root / f"{name}.npz" for name in ("ARM", "here")}
    kernels = kernel_folders(root)
    program = [REPOSITORY / "benchmarks" / "processor_hashes.py", *options, "--out"]
    here = _output(sys.executable, *program, arrays["here"], WARP_CACHE_PATH=str(kernels["here"]))
    there = run_emulated(root, kernels["ARM"], *program, arrays["ARM"])
    for name, text in (("here", here), ("ARM", there)):
        (root / f"{name}.txt").write_text(text)
    return arrays


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


def _output(*command: object, **environment: str) -> str:
    words, variables = [str(word) for word in command], {**os.environ, **environment}
    return subprocess.run(words, env=variables, cwd=REPOSITORY, check=True, stdout=subprocess.PIPE, text=True).stdout


def main() -> None:
    """Print which arrays are equal; exit code 1 if one is not."""
    arguments = parse(
        __doc__,
        option("--root", type=Path, default=DEFAULT_ROOT, help="folder of the emulated machine"),
        option("--steps", type=int, default=50, help="of training"),
        option("--adjoints", nargs="*", default=list(ADJOINTS), help="of the blend"),
    )
    make_root(arguments.root)
    arrays = run_both(arguments.root, "--steps", arguments.steps, "--adjoints", *arguments.adjoints)
    rows = compare(arrays["here"], arrays["ARM"])
    note = f"Emulated {PROCESSOR} (qemu-user) against this processor."
    write_table("arm", arguments.out, ["array", "on both"], rows, note, dict(rows))
    sys.exit(any(agreement != "equal" for _, agreement in rows))


if __name__ == "__main__":
    main()
