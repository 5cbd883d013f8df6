"""What NVIDIA's compiler makes of the kernels, interpreted by tests/ptx.py, against the same kernels in fibers.

It checks the code's generation, the layout of parameters, and the arithmetic of addresses.
"""

from collections.abc import Callable
from dataclasses import replace

import cubins
import pytest
import torch
import warp as wp
from common import using
from cuda_on_host import Launch, compiled, recorded
from ptx import execute
from scenes import FISHEYE, OPENCV
from test_binning import crowded
from test_cuda_on_host import CASES, adjoint_of, check_memory, differentiate, small, sum_magnitudes
from test_densify import HALF, steps, tables_of
from test_sky import made

from warp_splat import Camera, CameraParameters, RasterOptions
from warp_splat.gaussians import Activate
from warp_splat.kernels.statistics import make_observe
from warp_splat.raster.behind import put_behind
from warp_splat.raster.drivers import CUDA
from warp_splat.raster.expose import expose
from warp_splat.raster.project import project
from warp_splat.runtime.launch import launch_in_lanes
from warp_splat.training.loss import image_loss

pytestmark = pytest.mark.skipif(
    90 not in wp.get_cuda_supported_archs(), reason="Warp is built without CUDA's compiler."
)


def differentiate_all(*case) -> None:
    differentiate(small(), *case)


def loss() -> None:
    image, target = torch.rand(2, 70, 80, 3, generator=torch.Generator().manual_seed(0))
    image_loss(image.requires_grad_(), target).backward()


def through(camera) -> None:
    differentiate(replace(small(), camera=camera), "manual", RasterOptions())


def through_rolling() -> None:
    camera = small().camera
    through(Camera.rolling(camera, replace(camera, translation=camera.translation + 0.02)))


def through_learned(lens) -> None:
    camera = replace(small().camera, lens=lens)
    through(CameraParameters(camera, coefficients=torch.tensor(lens.coefficients, requires_grad=True)))


def observe() -> None:
    adj_means2d, radii = torch.randn(203, 2), torch.arange(203, dtype=torch.int32) % 3
    launch_in_lanes(make_observe, 1, [wp.vec2(20.0, 12.0), adj_means2d, radii], [*torch.rand(2, 203)])


def list_many_tiles() -> None:
    """An image of 2^15 tiles, which take more than 16 bits."""
    scene = small()
    camera = replace(scene.camera, width=16, height=2**19)
    CUDA.bin(project(scene.gaussians(), camera, RasterOptions()), camera, RasterOptions())


def activate() -> None:
    given = (torch.randn(size, requires_grad=True) for size in ((203, 3), 203))
    sum(x.square().sum() for x in Activate.apply(*given)).backward()


def put_sky_behind() -> None:
    camera, leaves, upstream = made(37, 31, 8.0, None)
    put_behind(*leaves, camera).backward(upstream)


def map_colors() -> None:
    image, numbers = torch.rand(30, 40, 3, requires_grad=True), torch.full((12,), 0.1, requires_grad=True)
    expose(image, "affine", numbers, None, 0.0).square().sum().backward()


def sum_rows(*widths: int) -> None:
    """Of splats of many tiles, too."""
    bins, slots, _ = crowded(40, sum(widths))
    CUDA.gather(bins, slots, [torch.zeros(40, width) for width in widths])


def adam(named: dict[int, int], sparse: bool, kind: torch.dtype = torch.float32) -> None:
    tables = tables_of(203, kind)
    named |= {tensor.data_ptr(): tensor.nbytes for table in tables for tensor in table}
    steps(tables, 1, torch.arange(203, dtype=torch.int32) % 3 if sparse else None)


#: What is run in fibers, given the addresses that kernels take as numbers.
RUNS: dict[str, Callable[[dict], None]] = {
    **{name: lambda _, case=case: differentiate_all(*case) for name, case in CASES.items()},
    "harmonics": lambda _: differentiate(replace(small(), sh=small().sh.repeat(1, 16, 1)), "manual", RasterOptions()),
    "ellipsoid": lambda _: differentiate_all("manual", RasterOptions(projection="ellipsoid")),
    "most weights": lambda _: differentiate_all("manual", RasterOptions(strongest=cubins.STRONGEST_MOST)),
    "opencv": lambda _: through(replace(small().camera, lens=OPENCV)),
    "fisheye": lambda _: through(replace(small().camera, lens=FISHEYE)),
    "opencv, learned": lambda _: through_learned(OPENCV),
    "fisheye, learned": lambda _: through_learned(FISHEYE),
    "camera": lambda _: through(CameraParameters(small().camera)),
    "rolling shutter": lambda _: through_rolling(),
    "sky": lambda _: put_sky_behind(),
    "map of colors": lambda _: map_colors(),
    "activate": lambda _: activate(),
    "observe": lambda _: observe(),
    "many tiles": lambda _: list_many_tiles(),
    "magnitudes": lambda _: sum_magnitudes(),
    "loss": lambda _: loss(),
    "sums": lambda _: sum_rows(*cubins.WIDTHS[:4]),
    "sums, channels": lambda _: sum_rows(*cubins.WIDTHS[:3], cubins.CHANNEL_WIDTHS[-1]),
    "adam": lambda named: adam(named, False),
    "adam, sparse": lambda named: adam(named, True),
    "adam, halves": lambda named: adam(named, False, HALF),
    "adam, sparse halves": lambda named: adam(named, True, HALF),
}
IN_THE_GATE = ("manual", "loss", "adam")


def launches_of(run, monkeypatch) -> list[Launch]:
    named: dict[int, int] = {}
    with using(CUDA), recorded(monkeypatch, named) as launches:
        RUNS[run](named)
    return launches


def check(launch, folder, before="", after=""):
    """Of code in which ``before`` is replaced: it leaves in memory what the fibers did."""
    text, name, shared = compiled(launch, folder, ".ptx")
    assert before in text
    check_memory(execute(text.replace(before, after), name, launch, shared), launch)


@pytest.mark.parametrize(
    "run", [pytest.param(run, marks=pytest.mark.slow if run in IN_THE_GATE else pytest.mark.long) for run in RUNS]
)
def test_every_kernel(run, monkeypatch, tmp_path):
    launches = launches_of(run, monkeypatch)
    assert launches
    for number, launch in enumerate(launches):
        check(launch, tmp_path / str(number))


def test_wrong_code_is_found(monkeypatch, tmp_path):
    launch = adjoint_of(launches_of("manual", monkeypatch))
    folder = tmp_path / "adjoint"
    check(launch, folder)
    for before, after in (
        *(("shfl.sync.bfly", "shfl.sync.down"), ("ex2.approx.ftz", "rcp.approx.ftz"), ("mad.lo.s32", "mul.lo.s32")),
        *(("setp.geu.f32", "setp.lt.f32"), ("mul.lo.s64", "add.s64"), ("min.f32", "max.f32")),
    ):
        with pytest.raises(AssertionError):
            check(launch, folder, before, after)
    with pytest.raises(NotImplementedError, match=r"does not know 'fma\.rz\.f32"):
        check(launch, folder, "fma.rn.f32", "fma.rz.f32")


@pytest.mark.long
def test_what_is_run(monkeypatch):
    seen = {launch.kernel.module for run in RUNS for launch in launches_of(run, monkeypatch)}
    assert [name for name, module in cubins.modules().items() if module not in seen] == []
