"""Fixtures that several test modules share."""

import functools
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
import warp as wp
from fake_viser import FakeServer
from filelock import FileLock

from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene

torch.set_num_threads(1)  # idle threads of torch would spin beside the kernels'


def compiled_by_one(compile_module):
    """Workers that want the same kernels at a time compile them once: the second waits, and finds them in the cache."""

    @functools.wraps(compile_module)
    def wait_and_compile(module, *arguments, **options):
        with FileLock(Path(wp.config.kernel_cache_dir) / f"{module.name}.lock"):
            return compile_module(module, *arguments, **options)

    return wait_and_compile


wp.Module._compile = compiled_by_one(wp.Module._compile)


@pytest.fixture(params=["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"])
def device(request) -> str:
    """Every device that the renderer supports."""
    return request.param


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
