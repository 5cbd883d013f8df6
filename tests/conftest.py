"""Fixtures that several test modules share."""

import functools
import os
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
import warp as wp
from common import using
from fake_viser import FakeServer
from filelock import FileLock

from warp_splat import get_threads, set_threads
from warp_splat.cli import main
from warp_splat.config import RasterOptions
from warp_splat.evaluation import report
from warp_splat.export_html import command, pack
from warp_splat.inspect import page
from warp_splat.kernels import ssim
from warp_splat.kernels.cpu.adjoint import make_reverse
from warp_splat.kernels.cpu.blend import make_blend
from warp_splat.kernels.project.shared import make_project
from warp_splat.kernels.sh_colors import make_adj_shade
from warp_splat.kernels.simd import LANES
from warp_splat.raster.data import falloff_of, variant_of
from warp_splat.raster.drivers import CPU, CUDA
from warp_splat.raster.project import projection_of
from warp_splat.runtime import pool
from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene

pool.SMALLEST_SLICE = 256  # so that threads share small scenes, too
report.DPI = page.PAGE_DPI = 50  # so that pictures take a third of the time
new_figure = report.new_figure
#: Without a search for room, which takes the most of it.
report.new_figure = lambda width, height, layout=None: new_figure(
    width, height, layout if layout != "constrained" else None
)
# Tests start dozens of processes: what one has compiled of torch serves the next.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
torch.set_num_threads(1)  # idle threads of torch would spin beside the kernels'


def compiled_by_one(compile_module):
    """Workers that want the same kernels at a time compile them once: the second waits, and finds them in the cache."""

    @functools.wraps(compile_module)
    def wait_and_compile(module, *arguments, **options):
        with FileLock(Path(wp.config.kernel_cache_dir) / f"{module.name}.lock"):
            return compile_module(module, *arguments, **options)

    return wait_and_compile


wp.Module._compile = compiled_by_one(wp.Module._compile)


def pytest_sessionstart():
    """Two workers begin at either end of what takes long to compile, instead of one that waits for the other."""
    if worker := os.environ.get("PYTEST_XDIST_WORKER"):
        options, variant = RasterOptions(), variant_of(RasterOptions())
        projections = [
            make_project(projection_of(RasterOptions(projection=name)), falloff_of(options).reach_of, LANES, None)
            for name in ("affine", "ellipsoid")
        ]
        blends = [make_blend(variant), make_adj_shade(LANES), make_reverse("manual", variant)]
        modules = [kernel.module for kernel in (projections[0], *blends)] + [wp.get_module(ssim.__name__)]
        modules += [projections[1].module]
        for module in modules if worker == "gw0" else modules[::-1]:
            wp.load_module(module, device="cpu")


@pytest.fixture
def laid_out(monkeypatch):
    """Pictures as users get them."""
    monkeypatch.setattr(report, "new_figure", new_figure)


@pytest.fixture(params=["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"])
def device(request) -> str:
    """Every device that the renderer supports."""
    return request.param


@pytest.fixture(params=[CPU, CUDA], ids=["lanes", "fibers"])
def driver(request):
    """That of the CPU, then that of a GPU, whose kernels run in fibers: what renders meanwhile."""
    with using(request.param):
        yield request.param


@pytest.fixture
def threads():
    """Sets the number of threads; afterwards it is as before."""
    before = get_threads()
    yield set_threads
    set_threads(before)


@pytest.fixture
def same_by_threads(threads):
    """Checks that a function returns the same bits on one, two and three threads; and what that is."""

    def check(run):
        found = []
        for count in (1, 2, 3):
            threads(count)
            found.append([torch.as_tensor(array) for array in run()])
        assert all(map(torch.equal, found[0], found[1])) and all(map(torch.equal, found[0], found[2]))
        return found[0]

    return check


@pytest.fixture
def fails(capsys):
    """Runs a command that fails, and returns its one sentence."""

    def run(*arguments):
        assert main([*map(str, arguments)]) == 1
        message = capsys.readouterr().err.strip()
        assert message.startswith("warp-splat: error: ") and "Traceback" not in message and "\n" not in message
        return message

    return run


@pytest.fixture
def ran(capsys):
    """Runs a command that ends well, and returns what it printed."""

    def run(*arguments):
        capsys.readouterr()
        assert main([*map(str, arguments)]) == 0
        return capsys.readouterr().out

    return run


@pytest.fixture
def spoil(monkeypatch):
    """Lets a function change the list of gradients that an autograd function's backward returns."""

    def run(function, change):
        backward = function.backward

        def spoiled(ctx, *upstream):
            gradients = list(backward(ctx, *upstream))
            change(gradients)
            return tuple(gradients)

        monkeypatch.setattr(function, "backward", staticmethod(spoiled))

    return run


@pytest.fixture(scope="session")
def scene():
    """The embedded one, an eighth of its size; some modules have another of their own."""
    return load_scene(embedded_scene(), resolution=8, report=str)


@pytest.fixture
def fake_viser(monkeypatch):
    """A server without sockets in viser's place."""
    module = ModuleType("viser")
    module.ViserServer = FakeServer
    monkeypatch.setitem(sys.modules, "viser", module)


@pytest.fixture
def small_chunks(monkeypatch):
    """10,000 Gaussians are three parts, after one of 4,096 that stand for them."""
    monkeypatch.setattr(pack, "CHUNK", 4096)
    monkeypatch.setattr(command, "MOST_MOVING", 4096)
