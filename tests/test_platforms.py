"""Other systems and processors: what pip installs there, the same bytes for each, and what trains without pycolmap."""

import os
import platform
import shutil
import subprocess
from functools import partial

import numpy as np
import pytest
from commands import ROOT, python
from hostile import refusal
from numpy._core._multiarray_umath import __cpu_dispatch__ as dispatched
from scene_files import write_colmap, write_transforms
from test_scene_input import plain_photos

from warp_splat.config import SfmConfig
from warp_splat.inspect.subject import read_subject
from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene
from warp_splat.sfm.command import sfm

UV = os.environ.get("UV") or shutil.which("uv")  # `uv run` names itself
#: By uv's names, those for which there is a wheel of pycolmap.
WITH_PYCOLMAP = ("x86_64-manylinux_2_28", "aarch64-apple-darwin", "x86_64-pc-windows-msvc")

ELSEWHERE = """
import ctypes, os, pathlib, sys
import psutil, torch, warp  # they choose by the name of the system
load, exists = ctypes.CDLL, pathlib.Path.exists
def load_unless_glibc(name, *rest, **options):
    if name == "libc.so.6":
        raise OSError(name)
    return load(name, *rest, **options)
ctypes.CDLL = load_unless_glibc
pathlib.Path.exists = lambda path: "/proc/" not in str(path) and exists(path)
del os.sched_getaffinity
sys.modules["resource"] = None
from warp_splat.config import CORES
from warp_splat.evaluation.report import machine
from warp_splat.runtime.devices import peak_memory
from warp_splat.runtime.launch import prepare
prepare("cpu", 1)
assert CORES == os.cpu_count() and peak_memory() is None and f"{CORES} cores" in machine()
"""


@pytest.mark.slow
@pytest.mark.skipif(UV is None, reason="uv resolves for other platforms")
@pytest.mark.parametrize("platform", [*WITH_PYCOLMAP, "aarch64-manylinux_2_34"])
def test_every_dependency_has_a_wheel(platform):
    command = [UV, "pip", "compile", "-q", "--no-header", "--no-annotate", "--only-binary", ":all:", "pyproject.toml"]
    chosen = ["--python-version", "3.11", "--python-platform", platform]
    system = {**os.environ, "MACOSX_DEPLOYMENT_TARGET": "14.0"}  # the oldest that wheels of pycolmap run on
    done = subprocess.run([*command, *chosen], cwd=ROOT, env=system, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    names = {line.split("==")[0] for line in done.stdout.splitlines()}
    assert {"warp-lang", "torch", "openimageio", "av"} <= names
    assert ("pycolmap" in names) == (platform in WITH_PYCOLMAP)


@pytest.mark.slow
def test_nothing_needs_glibc_or_proc():
    python("-c", ELSEWHERE)


@pytest.mark.long
@pytest.mark.skipif(not all(map(shutil.which, ("apt-get", "llvm-objdump"))), reason="needs Debian and LLVM's objdump")
def test_emulated_arm_computes_the_same_bytes_in_vectors():
    import arm  # noqa: PLC0415 - in the folder of the benchmarks
    import vectors  # noqa: PLC0415

    arm.make_root(arm.DEFAULT_ROOT)
    arrays = arm.run_both(arm.DEFAULT_ROOT)
    found = dict(arm.compare(arrays["here"], arrays["ARM"]))
    assert {name: agreement for name, agreement in found.items() if agreement != "equal"} == {}
    for processor, folder in arm.kernel_folders(arm.DEFAULT_ROOT).items():
        hot = [row for row in vectors.vectors(folder) if row[0] in vectors.HOT]
        # the last kernel of a name is the widest: Adam's other one takes the rows left over, one at a time
        widest = {kernel: (packed, scalar) for kernel, packed, scalar, *_ in sorted(hot, key=lambda row: row[1])}
        assert set(widest) == set(vectors.HOT)
        for kernel, (packed, scalar) in widest.items():
            assert packed > scalar, (processor, kernel)


#: What torch, NumPy, BLAS, MKL and the C library do on an old processor.
OLD = {"ATEN_CPU_CAPABILITY": "default", "OPENBLAS_CORETYPE": "Nehalem"}
OLD |= {"MKL_CBWR": "COMPATIBLE"}  # another maker's processor, too: the roots of torch are MKL's
OLD |= {"NPY_DISABLE_CPU_FEATURES": " ".join(dispatched), "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-AVX512F"}
AVX2 = {"WARP_SPLAT_TARGET": "-target-cpu x86-64-v3", **OLD}
PORTABLE = {"WARP_SPLAT_PORTABLE": "1"}
SSE2 = {"WARP_SPLAT_TARGET": "-target-cpu x86-64", **PORTABLE, **OLD}


def hashes(changes: dict[str, str], *arguments: str) -> list[str]:
    """A line for each array, with its hash, in a process of this environment."""
    said = python("benchmarks/processor_hashes.py", *arguments, **changes).stdout
    return [line for line in said.splitlines() if line.endswith(")")]


@pytest.mark.parametrize(
    ("switch", "value", "said"),
    [
        ("WARP_SPLAT_PORTABLE", "yes", "expected 1, 0 or nothing in this environment variable, got 'yes'; set it to"),
        (
            "WARP_SPLAT_TARGET",
            "x86-64",
            "expected flags such as '-target-cpu x86-64-v3', got 'x86-64'; mend or unset it.",
        ),
    ],
)
def test_a_misspelled_switch_is_refused(switch, value, said):
    done = python("-m", "warp_splat", "export-html", "a.ply", "a.html", check=False, **{switch: value})
    assert done.returncode == 1
    assert done.stderr.startswith(f"warp-splat: error: {switch}: {said}") and done.stderr.count("\n") == 1


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="names processors of the x86-64 family")
@pytest.mark.parametrize(
    ("here", "there", "arguments"),
    [
        pytest.param({}, AVX2, "--adjoints manual --steps 50", marks=pytest.mark.slow, id="AVX2"),
        pytest.param({}, AVX2, "--steps 300", marks=pytest.mark.long, id="AVX2, all of it"),
        pytest.param(PORTABLE, SSE2, "--steps 300", marks=pytest.mark.long, id="SSE2"),
        *(
            pytest.param({}, AVX2, f"--steps 60 --options exposure={kind} vignetting", marks=pytest.mark.long, id=kind)
            for kind in ("gain", "affine", "bilateral")
        ),
    ],
)
def test_same_bytes(here, there, arguments):
    expected = hashes(here, *arguments.split())
    assert len(expected) > 15
    assert hashes(there, *arguments.split()) == expected


HIDE = "import sys; sys.modules['pycolmap'] = None\n"  # then importing it raises ImportError
TRAIN = "import sys; from warp_splat.cli import main; sys.exit(main(['train', '-m', *sys.argv[1:]]))"


@pytest.fixture
def missing(monkeypatch):
    monkeypatch.setattr("warp_splat.scene.colmap_library.pycolmap", None)


def test_the_embedded_scene_is_the_same_from_both_of_its_files(monkeypatch):
    expected = load_scene(embedded_scene(), resolution=8, eval=True, report=str)
    monkeypatch.setattr("warp_splat.scene.colmap_library.pycolmap", None)
    found = load_scene(embedded_scene(), resolution=8, eval=True, report=str)
    np.testing.assert_array_equal(found.points, expected.points)
    np.testing.assert_array_equal(found.colors, expected.colors)
    for ours, theirs in zip(found.train + found.test, expected.train + expected.test, strict=True):
        assert ours.name == f"images/{theirs.name}"
        np.testing.assert_array_equal(ours.image, theirs.image)
        a, b = ours.camera, theirs.camera
        assert (a.width, a.height, a.fx, a.fy, a.cx, a.cy) == (b.width, b.height, b.fx, b.fy, b.cx, b.cy)
        for name in ("rotation", "translation", "center"):  # of what kernels see, not a bit differs
            np.testing.assert_array_equal(getattr(a, name).astype(np.float32), getattr(b, name).astype(np.float32))


@pytest.mark.slow
def test_the_embedded_scene_trains_to_the_same_bytes(tmp_path):
    models = []
    for name, code in (("with", TRAIN), ("without", HIDE + TRAIN)):
        python("-c", code, tmp_path / name, *"--iterations 3 -r 8 --seed 1 --quiet".split())
        models.append((tmp_path / name / "point_cloud" / "iteration_3" / "point_cloud.ply").read_bytes())
    assert models[0] == models[1]


@pytest.mark.slow
def test_every_room_can_be_imported():
    python("-c", f"{HIDE}import warp_splat.sfm.command, warp_splat.inspect.command, warp_splat.training.command")


@pytest.mark.parametrize(
    ("make", "run", "words"),
    [
        (write_colmap, partial(load_scene, report=str), ("COLMAP model", "sparse")),
        (partial(write_transforms, k1=0.1), partial(load_scene, report=str), ("lens OPENCV", "frame 0")),
        (plain_photos, lambda root: sfm(SfmConfig(str(root), str(root / "scene"))), ("warp-splat sfm",)),
    ],
    ids=["COLMAP", "distortion", "sfm"],
)
def test_what_needs_it_is_refused_by_name(make, run, words, tmp_path, missing):
    make(tmp_path)
    refusal(lambda: run(tmp_path), "pycolmap", "Linux on ARM", *words)
    assert not (tmp_path / "scene").exists()


def test_inspect_tells_it(tmp_path, missing):
    _, findings = read_subject(write_colmap(tmp_path), "images")
    assert ["pycolmap" in finding.text for finding in findings if finding.level == "error"] == [True]
