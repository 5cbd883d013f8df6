"""Bad input to the renderer: an InputError that names the argument and says what was found, before any work."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import scenes
import torch

import warp_splat
from warp_splat import InputError, RasterOptions
from warp_splat.raster.drivers import CPU, DRIVERS

SCENE = scenes.cloud(0, 6, scenes.make_camera(20, 18), degree=1)


def call(device, **changed):
    """Rasterize a good scene with some arguments changed."""
    arguments = {name: getattr(SCENE, name).to(device) for name in scenes.PARAMETERS} | {"camera": SCENE.camera}
    for name, change in changed.items():
        arguments[name] = change(arguments.get(name)) if callable(change) else change
    return warp_splat.rasterize(**arguments)


def test_memory_that_runs_out_is_explained(monkeypatch):
    def failing(*arguments):
        raise RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate much")

    monkeypatch.setitem(DRIVERS, "cpu", replace(CPU, bin=failing))
    with pytest.raises(
        InputError, match=r"Out of memory on cpu in stage 'bin', with 6 Gaussians on 20 x 18 px; render"
    ):
        call("cpu")


def put(value, *index):
    """A change: one element of a tensor."""

    def change(tensor):
        tensor = tensor.clone()
        tensor[index] = value
        return tensor

    return change


@pytest.mark.parametrize(
    ("name", "change", "found"),
    [
        ("means", lambda t: t[:, :2], "6, 2"),
        ("means", lambda t: t[0], r"3,?[)\]]"),
        ("means", lambda t: t.T, "3, 6"),
        ("quats", lambda t: t[:, :3], "6, 3"),
        ("scales", lambda t: t[:, :1], "6, 1"),
        ("opacities", lambda t: t[:, None], "6, 1"),
        ("sh", lambda t: t[:, 0], "6, 3"),
        ("sh", lambda t: torch.zeros(6, 5, 3, device=t.device), "6, 5, 3|5"),
        ("sh", lambda t: t[:, :0], "6, 0, 3|0"),
        ("sh", lambda t: t[..., :2], "6, 4, 2"),
        ("sh", lambda t: (t[:, :2], t[:, 2:]), "6, 2, 3"),
        ("sh", lambda t: (t[:, :1], t[:, 1:3]), "6, 2, 3|3"),
        ("sh", lambda t: (t[:, :1], t[:5, 1:]), "5, 3, 3|5"),
        ("sh", lambda t: (t[:, :1], t[:, 1:2], t[:, 2:]), "3"),
        ("means", lambda t: t.to_sparse(), "dense"),
        ("sh", lambda t: t.to_sparse(), "dense"),
        ("background", lambda _: (0, 0), "2"),
        ("background", lambda _: torch.zeros(4), "4"),
        ("background", lambda _: torch.zeros(1, 3), "1, 3"),
    ],
)
def test_shape(name, change, found, device):
    with pytest.raises(InputError, match=rf"(?s){name}.*({found})"):
        call(device, **{name: change})


@pytest.mark.parametrize("name", scenes.PARAMETERS)
def test_number_of_gaussians(name, device):
    with pytest.raises(InputError, match=r"(?s)(means|quats|scales|opacities|sh).*5") as error:
        call(device, **{name: lambda t: t[:5]})
    assert "6" in str(error.value)
    assert name == "means" or name in str(error.value)


@pytest.mark.parametrize("name", scenes.PARAMETERS)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.int64])
def test_dtype(name, dtype, device):
    with pytest.raises(InputError, match=rf"(?s){name}.*{str(dtype).removeprefix('torch.')}"):
        call(device, **{name: lambda t: t.to(dtype)})


@pytest.mark.parametrize("name", scenes.PARAMETERS)
@pytest.mark.parametrize(
    ("change", "found"), [(lambda t: t.cpu().numpy(), "ndarray"), (lambda t: t.tolist(), "list"), (None, "None")]
)
def test_not_a_tensor(name, change, found, device):
    with pytest.raises(InputError, match=rf"(?s){name}.*{found}"):
        call(device, **{name: change})


@pytest.mark.parametrize("name", scenes.PARAMETERS)
def test_device(name, device):
    with pytest.raises(InputError, match=rf"(?s){name}.*meta") as error:
        call(device, **{name: lambda t: t.to("meta")})
    assert str(device).split(":", maxsplit=1)[0] in str(error.value)


@pytest.mark.parametrize("name", [*scenes.PARAMETERS, "background"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_not_finite(name, value, device):
    change = put(value, 2) if name == "opacities" else put(value, 2, 1)
    if name == "background":
        change = torch.tensor([0, value, 0], device=device)
    with pytest.raises(InputError, match=rf"(?s){name}.*(?i:nan|inf|finite)"):
        call(device, **{name: change})


@pytest.mark.parametrize(
    ("name", "change", "found"),
    [
        ("scales", put(0.0, 3, 1), "0"),
        ("scales", put(-0.25, 3, 1), "-0.25"),
        ("opacities", put(-0.25, 3), "-0.25"),
        ("opacities", put(1.25, 3), "1.25"),
        ("opacities", put(1.0001, 3), "to 1.0001"),
    ],
)
def test_range(name, change, found, device):
    with pytest.raises(InputError, match=rf"(?s){name}.*{found}"):
        call(device, **{name: change})


def test_ends_of_the_ranges_are_good(device):
    out = call(device, opacities=lambda t: t.clone().fill_(1), scales=put(1e-30, 0, 0))
    assert out.image.isfinite().all()
    assert not call(device, opacities=lambda t: t.clone().fill_(0)).alpha.any()
    rounded, exact = (call(device, opacities=lambda t, value=value: t.clone().fill_(value)) for value in (1.0000001, 1))
    assert torch.allclose(rounded.image, exact.image, atol=1e-5)


def test_camera_too_large(device):
    with pytest.raises(InputError, match=r"camera: expected at most .* pixels, got 1000000 x 1000000"):
        call(device, camera=SCENE.camera.resized(10**6, 10**6))


@pytest.mark.parametrize("camera", [None, {"width": 20}, np.eye(4)], ids=["None", "dict", "ndarray"])
def test_camera(camera, device):
    with pytest.raises(InputError, match=rf"(?s)camera.*{type(camera).__name__}"):
        call(device, camera=camera)


@pytest.mark.parametrize(
    "cameras", [SCENE.camera, None, iter(()), [SCENE.camera, None]], ids=["one", "None", "iterator", "list"]
)
def test_cameras(cameras, device):
    found = "NoneType" if isinstance(cameras, list) else type(cameras).__name__
    with pytest.raises(InputError, match=f"(?s)camera.*{found}"):
        warp_splat.rasterize_views(*SCENE.to(device).parameters(), cameras)


@pytest.mark.parametrize("name", ["magic", None])
def test_adjoint(name, device):
    with pytest.raises(InputError, match=rf"(?s)adjoint.*{name}"):
        call(device, adjoint=name)


def test_options(device):
    with pytest.raises(InputError, match=r"(?s)options.*dict"):
        call(device, options={"depth": True})


@pytest.mark.parametrize("degree", [-1, 4, np.zeros(2), torch.ones(2), [1]], ids=repr)
def test_sh_degree(degree, device):
    with pytest.raises(
        InputError, match=r"options.sh_degree: expected 0, 1, 2, 3 or None, got " + re.escape(repr(degree))
    ):
        call(device, options=RasterOptions(sh_degree=degree))


@pytest.mark.parametrize(
    ("name", "value", "wanted"),
    [("alpha_max", 1.0, "0 to 0.9999"), ("near", 0.0, "1e-06 to 1e+06"), ("blur", math.nan, "1e-06 to 1e+06")],
)
def test_constants(name, value, wanted, device):
    with pytest.raises(InputError, match=re.escape(f"options.{name}: expected a number from {wanted}, got {value}.")):
        call(device, options=RasterOptions(**{name: value}))


def test_bad_input_leaves_the_renderer_working(device):
    before = call(device).image
    with pytest.raises(InputError):
        call(device, means=put(float("nan"), 0, 0))
    assert torch.equal(before, call(device).image)
