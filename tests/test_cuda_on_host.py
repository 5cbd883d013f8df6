"""The kernels' code for a GPU, on the host: no races, no access outside of arrays, one result in any order of threads.

Beside the fibers, which share the kernels' text and nothing of what it becomes for a GPU.
"""

from dataclasses import replace

import cuda_on_host
import numpy as np
import pytest
import torch
from audit_targets.own import matrices_of
from common import using
from cuda_on_host import build, recorded, run
from scenes import PARAMETERS, cloud, dense_tile, make_camera
from test_binning import crowded

from warp_splat import RasterOptions, rasterize
from warp_splat.config import ADJOINTS
from warp_splat.gsplat import rasterization
from warp_splat.raster.drivers import CUDA
from warp_splat.training.loss import image_loss

pytestmark = [
    pytest.mark.skipif(cuda_on_host.COMPILER is None, reason="g++ is missing: it compiles the kernels for the host."),
    pytest.mark.slow,
]
SUMS = 1e-6  # relative: fibers add in another order


def small(count=16):
    """Tiles at both borders, an empty one, pixels that stop early: 40 x 24 px, 6 tiles."""
    return cloud(50, count, make_camera(40, 24), sigma=(1.0, 5.0), opacity=(0.5, 0.99), frame=-0.25)


def differentiate(scene, mode, options, features=None):
    leaves = [getattr(scene, name).detach().clone().requires_grad_() for name in PARAMETERS]
    if features:
        features = torch.rand(len(leaves[0]), features, generator=torch.Generator().manual_seed(0)).requires_grad_()
    out = rasterize(*leaves, scene.camera, scene.background, mode, options, features=features)
    shown = (out.image, out.alpha, out.depth, out.features, out.strongest_weights)
    generator = torch.Generator().manual_seed(1)
    sum((x * torch.randn(x.shape, generator=generator)).sum() for x in shown if x is not None).backward()


def sum_magnitudes():
    """Of gradients, which gsplat's function asks for."""
    scene = small()
    leaves = [getattr(scene, name).detach().clone().requires_grad_() for name in PARAMETERS]
    camera = scene.camera
    pose, lens = matrices_of(camera)
    more = {"sh_degree": int(scene.sh.shape[1] ** 0.5) - 1, "absgrad": True}
    image, *_ = rasterization(*leaves, pose[None], lens[None], camera.width, camera.height, **more)
    image.square().sum().backward()


#: What is rendered; each case compiles the kernels that those before it have not.
CASES = {
    **{mode: (mode, RasterOptions()) for mode in ADJOINTS},
    **{f"{mode}, depth": (mode, RasterOptions(depth=True)) for mode in ADJOINTS},
    "channels": ("manual", RasterOptions(), 5),
    "channels, stepwise": ("stepwise", RasterOptions(), 5),
    "weights": ("manual", RasterOptions(strongest=3)),
}


def launches_of(case, monkeypatch, scene):
    with using(CUDA), recorded(monkeypatch) as launches:
        differentiate(scene, *CASES[case])
    return launches


def adjoint_of(launches):
    (launch,) = (launch for launch in launches if launch.kernel.key.startswith("make_reverse"))
    return launch


def check_memory(found, launch):
    """What the program left is what the fibers left: to the bit, sums to their rounding."""
    for here, there in zip(found.memory, launch.after, strict=True):
        if not np.array_equal(here, there):
            sums, expected = (memory.view(np.float32).astype(float) for memory in (here, there))
            assert np.abs(there.view(np.int32)).max() > 2**23, "integers differ"
            assert np.linalg.norm(sums - expected) <= SUMS * np.linalg.norm(expected)


def check_clean(program, launch):
    """No report in two orders of threads, and one result."""
    first, second = (run(program, launch, seed) for seed in range(2))
    assert first.code == second.code == 0, first.said + second.said
    check_memory(first, launch)
    assert all(map(np.array_equal, first.memory, second.memory))
    return first.barriers


def check_controls(program, launch, barriers):
    """A barrier that is taken out is reported: all but one, which stands beside another."""
    silent = [barrier for barrier in barriers if run(program, launch, without=barrier).code == 0]
    assert len(silent) <= 1 and len(silent) < max(len(barriers), 1), silent


def check(launches, sanitizer, tmp_path):
    """Each of them is clean; against the sanitizer of threads, none of its barriers is in vain."""
    for number, launch in enumerate(launches):
        (folder := tmp_path / str(number)).mkdir()
        program = build(launch, sanitizer, folder)
        barriers = check_clean(program, launch)
        if sanitizer == "thread":
            check_controls(program, launch, barriers)


BOTH = pytest.mark.parametrize("sanitizer", ["thread", "address"])


def test_adjoint_has_no_races(monkeypatch, tmp_path):
    launch = adjoint_of(launches_of("manual", monkeypatch, small(100)))  # more than a warp stages at once
    program = build(launch, "thread", tmp_path)
    barriers = check_clean(program, launch)
    assert barriers and all(run(program, launch, without=barrier).code for barrier in barriers)


@pytest.mark.long
@BOTH
@pytest.mark.parametrize("case", CASES)
def test_every_kernel(case, sanitizer, monkeypatch, tmp_path):
    check(launches_of(case, monkeypatch, small()), sanitizer, tmp_path)


@pytest.mark.long
def test_more_than_a_batch(monkeypatch, tmp_path):
    for number, launch in enumerate(launches_of("manual", monkeypatch, dense_tile())):
        (folder := tmp_path / str(number)).mkdir()
        check_clean(build(launch, "thread", folder), launch)


@pytest.mark.long
@BOTH
def test_magnitudes(sanitizer, monkeypatch, tmp_path):
    """It repeats kernels that others watch."""
    with using(CUDA), recorded(monkeypatch) as launches:
        sum_magnitudes()
    (launch,) = (launch for launch in launches if launch.kernel.key.startswith("make_adj_channels"))
    check([launch], sanitizer, tmp_path)


@pytest.mark.long
@BOTH
def test_loss(sanitizer, monkeypatch, tmp_path):
    """Two strips of two bands: of 256 numbers, 30 only lend theirs."""
    image, target = torch.rand(2, 70, 80, 3, generator=torch.Generator().manual_seed(0))
    with using(CUDA), recorded(monkeypatch) as launches:
        image_loss(image.requires_grad_(), target).backward()
    assert [launch.blocks for launch in launches] == [4, 4]
    check(launches, sanitizer, tmp_path)


@pytest.mark.long
@BOTH
def test_sums_of_splats_of_many_tiles(sanitizer, monkeypatch, tmp_path):
    """The path that no scene of a few tiles takes."""
    bins, slots, _ = crowded(40, 9)
    with using(CUDA), recorded(monkeypatch) as launches:
        CUDA.gather(bins, slots)
    check(launches[:1], sanitizer, tmp_path)


@pytest.mark.long
def test_short_arrays_are_reported(monkeypatch, tmp_path):
    launch = adjoint_of(launches_of("manual", monkeypatch, small()))
    program = build(launch, "address", tmp_path)
    for which in range(len(launch.memory)):
        memory = [array[:-4] if i == which else array for i, array in enumerate(launch.memory)]
        assert "heap-buffer-overflow" in run(program, replace(launch, memory=memory)).said
