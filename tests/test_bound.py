"""No pixel is farther from the ideal than its bound says: the oracle without any cut, in float64."""

import os
from dataclasses import replace

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from common import using
from exact_cameras import exact_render
from hostile import refusal
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import warp_splat
from warp_splat.compare.scenes import cloud, look, make_camera, tensors
from warp_splat.compare.stability import cases, verdict
from warp_splat.compare.truth import for_oracle
from warp_splat.config import ALPHA_MIN, RasterOptions
from warp_splat.formats.png import load_png
from warp_splat.raster import drivers
from warp_splat.raster.api import render
from warp_splat.raster.data import Gaussians
from warp_splat.rendering.command import save_exr, write_maps
from warp_splat.scene.types import Decoded, View

RENDERED = [case for case in cases.CASES if case.build]
IDEAL = {"alpha_min": 0.0, "t_min": 0.0, "sh_degree": None}


def exact(gaussians, camera, background, **cuts):
    """An image in float64, and where the order of what is blended is beyond doubt."""
    *geometry, sh_dc, sh_rest = (tensor.detach().double() for tensor in gaussians)
    out = exact_render(*geometry, torch.cat([sh_dc, sh_rest], 1), camera, background.double(), **cuts)
    return out.image, ~out.fragile


def ratios(gaussians, camera, background, options):
    """Bound over error of the pixels whose order is beyond doubt, after a check that none is below 1."""
    out = render(gaussians, camera, background, replace(options, bound=True))
    cuts = for_oracle(options) | IDEAL | {"alpha_min": 0.0 if options.of == "ideal" else ALPHA_MIN}
    ideal, known = exact(gaussians, camera, background, **cuts)
    error = (out.image.detach().double() - ideal).abs().amax(2)
    assert out.bound is not None and out.bound.isfinite().all()
    worst = (error - out.bound)[known].max().item() if known.any() else 0.0
    assert worst <= 0.0, f"error above its bound by {worst:.1e}, largest error {error.max():.1e}"
    return (out.bound / error.clamp_min(1e-12))[known]


@pytest.mark.parametrize("extent", ["ellipse", "square"])
@pytest.mark.parametrize("of", ["ideal", "trained"])
def test_a_bound_changes_no_picture(of, extent):
    options = RasterOptions(alpha_min=1e-3, of=of, extent=extent)
    camera = look(90, 70)
    gaussians = made_up(0, 200, (1.0, 8.0), (0.01, 1.0), 0.2, 1.0, camera)
    plain, bounded = (
        render(gaussians, camera, torch.zeros(3), replace(options, bound=bound)).image for bound in (False, True)
    )
    assert (plain - bounded).abs().max() < 1e-6


@pytest.mark.parametrize("case", RENDERED, ids=[case.name for case in RENDERED])
def test_stiff_and_extreme_cases(case):
    problem = case.build()
    count = len(problem.gaussians["means"])
    kept = torch.tensor(sorted(set(range(count)) - set(problem.left_out)), dtype=torch.int64)
    drawn = replace(problem, gaussians={name: rows[kept] for name, rows in problem.gaussians.items()})
    leaves = verdict.leaves_of(drawn, torch.float32)
    with torch.no_grad():
        gaussians = verdict.activated(drawn, leaves)
        background = leaves["background"].detach()
        ratios(gaussians, problem.camera, background, problem.options)


def made_up(seed, count, sigma, opacity, aspect, bright, camera):
    arrays = cloud(seed, count, camera, sigma=sigma, opacity=opacity, aspect=aspect)
    arrays["sh_dc"] = arrays["sh_dc"] * bright
    return Gaussians(**{name: rows for name, rows in tensors(arrays).items() if name in Gaussians._fields})


OPTIONS = st.fixed_dictionaries(
    {
        "alpha_min": st.sampled_from([0.0, 1e-5, ALPHA_MIN, 0.05, 0.4]),
        "t_min": st.sampled_from([0.0, 1e-4, 0.05, 0.5]),
        "extent": st.sampled_from(["ellipse", "square"]),
        "exp_degree": st.sampled_from([5]),
        "sh_degree": st.sampled_from([None, 0]),
        "max_steps": st.sampled_from([None, 7]),
        "antialiasing": st.booleans(),
        "projection": st.sampled_from(["affine", "ellipsoid", "unscented"]),
        "tolerance": st.sampled_from([None, 0.3, 1e-3]),
        "of": st.sampled_from(["ideal", "trained"]),
    }
)


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@example(  # the brightest color is one whose harmonics are left out, in a list that is cut
    options={"alpha_min": 0.0, "sh_degree": 0, "max_steps": 7}, seed=0, count=29, largest=1.0, opacity=(0.9, 1.0),
    aspect=1e-4, bright=0.0, behind=0.0,
)  # fmt: skip
@example(  # the short axes of long needles count
    options={"alpha_min": 0.0, "antialiasing": True, "projection": "unscented"}, seed=37, count=37, largest=60.0,
    opacity=(0.001, 0.02), aspect=1e-4, bright=0.0, behind=0.0,
)  # fmt: skip
@example(  # within a tolerance, the cut is another than alpha_min
    options={"alpha_min": 0.0, "tolerance": 0.3}, seed=0, count=1, largest=1.0, opacity=(0.05, 0.9), aspect=1e-4,
    bright=0.0, behind=0.0,
)  # fmt: skip
@example(  # the square leaves out what is above 1/255
    options={"extent": "square", "of": "trained"}, seed=3, count=1, largest=60.0, opacity=(0.9, 1.0), aspect=0.9,
    bright=1.0, behind=0.0,
)  # fmt: skip
@given(
    options=OPTIONS,
    seed=st.integers(0, 999),
    count=st.integers(1, 80),
    largest=st.sampled_from([1.0, 5.0, 60.0]),
    opacity=st.sampled_from([(0.001, 0.02), (0.05, 0.9), (0.9, 1.0)]),
    aspect=st.sampled_from([1e-4, 0.05, 0.9]),
    bright=st.sampled_from([0.0, 1.0, 8.0]),
    behind=st.sampled_from([0.0, 1.0]),
)
def test_random_scenes(options, seed, count, largest, opacity, aspect, bright, behind):
    camera = look(40, 36)
    gaussians = made_up(seed, count, (0.3, largest), opacity, aspect, bright, camera)
    ratios(gaussians, camera, torch.full((3,), behind), RasterOptions(**options))


@pytest.mark.parametrize("options", [{}, {"alpha_min": 0.05}, {"tolerance": 0.01}])
@pytest.mark.parametrize("blur", [1e-6, 1e-3, 0.02])
def test_what_is_narrower_than_the_way_between_two_pixels(blur, options):
    camera = make_camera(24, 20, seed=None)
    for seed in range(12):
        gaussians = made_up(seed, 3, (0.01, 0.5), (0.9, 1.0), 0.9, 1.0, camera)
        ratios(gaussians, camera, torch.zeros(3), RasterOptions(blur=blur, **options))


def test_what_may_be_left_out_counts_as_bright_as_its_harmonics_make_it():
    """An alpha that rounding may put on either side of 1/255."""
    camera, opacity = make_camera(41, 37, seed=None), 1.00005 * ALPHA_MIN
    gaussians = made_up(1, 1, (0.5, 0.6), (opacity, opacity), 0.9, 0.0, camera)
    rest = torch.zeros_like(gaussians.sh_rest)
    rest[:, 1] = 1.0  # along z
    gaussians = gaussians._replace(means=torch.tensor([[0.0, 0.0, 5.0]]), sh_rest=rest)
    ratios(gaussians, camera, torch.zeros(3), RasterOptions(tolerance=0.1, of="trained", sh_degree=0))


def ordinary():
    camera = look(70, 50)
    return made_up(3, 400, (0.5, 6.0), (0.05, 0.9), 0.2, 1.0, camera), camera


def drawn(**options):
    """Image, bound, and the part of it that is rounding, of what is ordinary."""
    out = render(*ordinary(), torch.zeros(3), RasterOptions(**options))
    return out.image, out.bound, out.rounding


def test_the_image_is_the_same_and_threads_change_nothing(same_by_threads):
    image, *_ = same_by_threads(lambda: drawn(bound=True))
    plain, bound, _ = drawn()
    assert (image - plain).abs().max() < 1e-6 and bound is None


@pytest.mark.parametrize("tolerance", [None, 1e-2])
def test_kernels_of_cuda_find_a_bound_as_well(tolerance):
    camera = look(24, 20)
    gaussians = made_up(5, 60, (0.5, 6.0), (0.05, 0.9), 0.2, 1.0, camera)
    options = RasterOptions(bound=True, tolerance=tolerance)
    on_cpu = render(gaussians, camera, torch.zeros(3), options).bound
    with using(drivers.CUDA):
        ratios(gaussians, camera, torch.zeros(3), options)
        on_cuda = render(gaussians, camera, torch.zeros(3), options).bound
    assert np.median(on_cuda / on_cpu) < 1.5


def test_less_is_cut_and_the_bound_falls():
    gaussians, camera = ordinary()
    options = [RasterOptions(bound=True, alpha_min=alpha, t_min=alpha**2) for alpha in (0.1, ALPHA_MIN, 1e-4, 1e-6)]
    found = [render(gaussians, camera, torch.zeros(3), each) for each in options]
    medians = [(out.bound - out.rounding).median().item() for out in found]
    assert medians == sorted(medians, reverse=True)
    assert medians[-1] < 1e-2 * medians[0]


@pytest.mark.parametrize("of", ["ideal", "trained"])
@pytest.mark.parametrize("tolerance", [1e-1, 3e-3])
def test_cuts_stay_below_a_tolerance(of, tolerance):
    gaussians, camera = ordinary()
    options = RasterOptions(tolerance=tolerance, of=of)
    out = render(gaussians, camera, torch.zeros(3), options)
    cuts = for_oracle(RasterOptions()) | {"t_min": 0.0, "alpha_min": 0.0 if of == "ideal" else ALPHA_MIN}
    expected, known = exact(gaussians, camera, torch.zeros(3), **cuts)
    assert ((out.image - expected).abs().amax(2) <= out.bound)[known].all()
    above = out.bound - out.rounding > tolerance
    # where an opacity is 1/255 but for rounding, nothing smaller than what it counts can be said
    assert above.double().mean() < (0.02 if of == "trained" else 1e-9)


def test_pixels_stop_later_where_a_tolerance_asks_for_it():
    gaussians, camera = made_up(7, 300, (0.5, 6.0), (0.99, 1.0), 0.5, 8.0, look(70, 50)), look(70, 50)
    options = RasterOptions(tolerance=0.1, of="trained", alpha_max=0.9999)
    out = render(gaussians, camera, torch.zeros(3), options)
    assert (out.bound - out.rounding).max() <= 0.1


def test_a_tolerance_decides_about_opacities_as_near_to_their_cut_as_rounding_allows():
    camera, opacity = make_camera(41, 37, seed=None), 1.00014 * ALPHA_MIN
    gaussians = made_up(1, 1, (0.5, 0.6), (opacity, opacity), 0.9, 0.0, camera)
    middle = gaussians._replace(means=torch.tensor([[0.0, 0.0, 5.0]]), sh_dc=torch.full((1, 1, 3), 1e4))
    out = render(middle, camera, torch.zeros(3), RasterOptions(tolerance=0.1, of="trained"))
    assert out.image.max() > 1.0
    assert (out.bound - out.rounding).max() <= 0.1


def test_a_tolerance_for_each_pixel_and_any_number_of_threads(same_by_threads):
    tolerance = torch.full((50, 70), 1e-1)
    tolerance[10:20, 30:50] = 1e-4
    _, bound, rounding = same_by_threads(lambda: drawn(tolerance=tolerance))
    assert (bound - rounding <= tolerance).all()


def test_gradients_within_a_tolerance():
    gaussians, camera = ordinary()
    found = []
    for options in (RasterOptions(tolerance=1e-4), RasterOptions(alpha_min=1e-9, t_min=1e-9)):
        leaves = Gaussians(*(tensor.clone().requires_grad_() for tensor in gaussians))
        out = render(leaves, camera, torch.zeros(3), options)
        out.image.square().sum().backward()
        found.append([leaf.grad for leaf in leaves])
    for cut, whole in zip(*found, strict=True):
        assert (cut - whole).norm() < 2e-3 * whole.norm()


def test_pictures_of_the_bound(tmp_path, monkeypatch):
    gaussians, camera = ordinary()
    out = render(gaussians, camera, torch.zeros(3), RasterOptions(bound=True))
    photo = np.zeros((camera.height, camera.width, 3), np.uint8)
    largest = write_maps("bound", lambda _camera: out.bound, [View("a", camera, Decoded(photo), camera)], tmp_path)
    assert largest == out.bound.max().item()
    read = oiio.ImageBuf(str(tmp_path / "bound" / "00000.exr")).get_pixels(oiio.FLOAT)
    assert np.array_equal(read[..., 0], out.bound.numpy())
    height, width, _ = load_png(tmp_path / "bound" / "00000.png").shape
    assert height == camera.height and width > camera.width  # the scale is beside it
    close = oiio.ImageOutput.close

    def cut(self):
        closed, (path,) = close(self), tmp_path.glob(".tmp*.exr")
        os.truncate(path, path.stat().st_size - 9)
        return closed

    for at_the_end in (lambda self: False, cut):  # as of a disk that becomes full there, told or not
        monkeypatch.setattr(oiio.ImageOutput, "close", at_the_end)
        refusal(lambda: save_exr(tmp_path / "half.exr", np.ones((4, 4))), "it cannot be written")
        assert not list(tmp_path.glob("*.exr"))


@pytest.mark.parametrize(
    ("options", "background", "words"),
    [
        ({"bound": True}, (-0.1, 0.0, 0.0), r"options\.bound: expected a background of one color"),
        ({"tolerance": 0.0}, (0, 0, 0), r"options\.tolerance: expected numbers above 0, got 0\.0"),
        ({"tolerance": "much"}, (0, 0, 0), r"options\.tolerance: expected a number or a tensor \[H, W\], got str"),
        ({"tolerance": torch.tensor(1j)}, (0, 0, 0), r"options\.tolerance: expected a number or a tensor \[H, W\]"),
        ({"tolerance": 1e-2, "normals": True}, (0, 0, 0), r"options\.tolerance: expected none of normals beside it"),
        ({"tolerance": 1e-2, "extent": "square"}, (0, 0, 0), r"options\.tolerance: expected none of extent 'square'"),
        ({"of": "truth"}, (0, 0, 0), r"options\.of: expected one of ideal, trained, got 'truth'"),
    ],
)
def test_bad_values(options, background, words):
    gaussians, camera = ordinary()
    given = (*gaussians[:4], gaussians[4:], camera, background)
    refusal(lambda: warp_splat.rasterize(*given, options=RasterOptions(**options)), match=words)
