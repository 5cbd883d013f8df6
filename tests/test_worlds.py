"""Many worlds in one pass, and what they share drawn once: the bits of a call for each, on the CPU and in fibers."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from hostile import refusal
from scenes import cloud, make_camera

from warp_splat import CameraParameters, Lens, RasterOptions, rasterize
from warp_splat.raster.worlds import Worlds, takes

COUNTS = (30, 0, 25)  # one has none of its own
CAMERA = make_camera(69, 45, fx=60.0)  # whose last tiles are cut


def gaussians(seed, count, **more):
    """A third of them stand where others of all worlds do."""
    means, *rest = cloud(seed, count or 1, CAMERA, degree=1, **more).parameters()
    means[::3] = cloud(99, len(means[::3]), CAMERA, frame=-0.35).parameters()[0]
    return [tensor[:count] for tensor in (means, *rest)]


def together(parts):
    return [torch.cat(tensors) for tensors in zip(*parts, strict=True)]


OWN = [gaussians(seed, count, sigma=(0.6, 2), frame=-0.35) for seed, count in enumerate(COUNTS)]
SHARED = gaussians(7, 40)


def check(pictures, worlds, options):
    """Against a call for each."""
    for world, own in enumerate(worlds):
        out = rasterize(*own, CAMERA, options=options(world))
        for name, table in pictures.items():
            assert torch.equal(table[world], getattr(out, name)), (world, name)


@pytest.mark.parametrize("asked", [{}, {"depth": True, "strongest": 2}, {"antialiasing": True, "extent": "square"}])
def test_the_bits_are_those_of_a_call_for_each(asked, driver):
    options = RasterOptions(**asked)
    backdrop = Worlds(SHARED, [40], CAMERA, options)
    check(backdrop.pictures, [SHARED], lambda _world: options)
    alone = Worlds(together(OWN), COUNTS, CAMERA, options)
    check(alone.pictures, OWN, lambda _world: options)
    among = Worlds(together(OWN), COUNTS, CAMERA, options, backdrop)
    check(among.pictures, [together([SHARED, own]) for own in OWN], lambda _world: options)
    assert among.touched.any() and not among.touched.all() and among.pictures["alpha"][1].max() > 0.1
    assert set(among.pictures) >= {"image", "alpha", *{"depth", "strongest"}.intersection(asked)}


@pytest.mark.parametrize(
    "lens", [Lens("SIMPLE_RADIAL", (-0.1,)), Lens("OPENCV_FISHEYE", (0.1, 0.0, 0.0, 0.0))], ids=str
)
def test_a_lens_is_that_of_each_picture(lens):
    """Not of all below each other, which would be too tall for it; and there are no gradients."""
    camera, options = replace(CAMERA, lens=lens), RasterOptions(strongest=1)
    leaves = [tensor.requires_grad_() for tensor in together([OWN[0]] * 8)]
    worlds = Worlds(leaves, [COUNTS[0]] * 8, camera, options)
    alone = rasterize(*OWN[0], camera, options=options)
    assert all(torch.equal(picture, alone.image) for picture in worlds.pictures["image"])
    assert not any(table.requires_grad for table in worlds.pictures.values())


def test_what_hides_is_each_worlds_own(driver):
    surfaces = torch.stack([torch.full((45, 69), depth) for depth in (4.0, 0.0, 5.0)])
    surfaces[:, :, 40:] = 0.0  # nothing there
    options = RasterOptions(hidden_from=surfaces)
    worlds = [together([SHARED, own]) for own in OWN]
    pictures = Worlds(together(worlds), [40 + count for count in COUNTS], CAMERA, options).pictures
    check(pictures, worlds, lambda world: RasterOptions(hidden_from=surfaces[world]))
    assert not torch.equal(pictures["image"][0], rasterize(*worlds[0], CAMERA).image)


def test_threads_change_no_byte(same_by_threads):
    def run():
        backdrop = Worlds(SHARED, [40], CAMERA, RasterOptions(depth=True))
        return Worlds(together(OWN), COUNTS, CAMERA, RasterOptions(depth=True), backdrop).pictures.values()

    same_by_threads(run)


def test_what_is_wrong_is_said():
    means, *rest = together(OWN)
    means[40, 1] = torch.nan
    whole = "counts: expected a list of whole numbers, one for each world, got"
    same = "backdrop: expected one world of the same Camera object and options"
    backdrop, tall = Worlds(SHARED, [40], CAMERA, RasterOptions()), make_camera(69, 55, fx=60.0)
    cases = [
        ("got 1 that are NaN or infinite, the first in Gaussian 40", {"gaussians": [means, *rest]}),
        ("counts: expected 55 Gaussians in all, got 54", {"counts": [30, 24]}),
        *((whole, {"counts": counts}) for counts in ([60, -5], [27.5, 27.5], 55, b"\x37", None, [])),
        ("backdrop: expected what was drawn of another world, got tuple", {"backdrop": ({}, None)}),
        (same, {"options": RasterOptions(depth=True), "backdrop": backdrop}),
        (same, {"camera": tall, "backdrop": backdrop}),
        ("that has none itself", {"backdrop": Worlds(SHARED, [40], CAMERA, RasterOptions(), backdrop)}),
        ("for several worlds, got CameraParameters", {"camera": CameraParameters(CAMERA)}),
        ("options.alpha_min: expected a number", {"options": RasterOptions(alpha_min="x")}),
        ("neither bound, tolerance", {"options": RasterOptions(bound=True)}),
        ("hidden_from: expected shape [3, 45, 69]", {"options": RasterOptions(hidden_from=torch.ones(45, 69))}),
    ]
    given = {"gaussians": together(OWN), "counts": COUNTS, "camera": CAMERA, "options": RasterOptions()}
    for sentence, wrong in cases:
        refusal(partial(Worlds, **given | wrong), sentence)
    assert not takes(CAMERA, RasterOptions(bound=True)) and not takes(CAMERA, RasterOptions(tolerance=0.01))
