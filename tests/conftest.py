"""Fixtures that several test modules share."""

import sys
from types import ModuleType

import pytest
import torch
from fake_viser import FakeServer

from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene

torch.set_num_threads(1)  # idle threads of torch would spin beside the kernels'


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
