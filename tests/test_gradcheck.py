"""check_gradients: agrees where the gradients are right, names what is wrong, and its differences are the truth's."""

import numpy as np
import pytest
import torch
from hostile import refusal
from scenes import SCENES

from warp_splat import CameraParameters, RasterOptions, check_gradients
from warp_splat.compare import oracle
from warp_splat.config import ADJOINTS
from warp_splat.raster import blend, differences, project
from warp_splat.raster.checks import check_gaussians
from warp_splat.raster.differences import INPUTS, INTERMEDIATES

EVERYTHING = INPUTS + INTERMEDIATES
VARIANTS = [
    ("degree2", RasterOptions(depth=True)),
    ("degree3", RasterOptions(projection="ellipsoid", depth=True)),
    ("subpixel", RasterOptions(antialiasing=True)),
    pytest.param("needles", RasterOptions(), marks=pytest.mark.slow),
    ("opaque", RasterOptions(depth=True, antialiasing=True, projection="ellipsoid")),
    ("far_world", RasterOptions(alpha_min=0.0, t_min=0.0)),
    pytest.param("dense_tile", RasterOptions(depth=True, extent="square"), marks=pytest.mark.slow),
    pytest.param("size_1x1", RasterOptions(bound=True), marks=pytest.mark.slow),
]


def check(name, **more):
    scene = SCENES[name]()
    return check_gradients(*scene.parameters(), scene.camera, scene.background, **more)


def errors(report):
    return {row.name: (row.error, row.uncertainty, row.verdict) for row in report.rows}


@pytest.mark.parametrize(("name", "options"), VARIANTS, ids=str)
def test_right_gradients_agree(name, options):
    report = check(name, options=options, parameters=EVERYTHING, directions=3)
    assert report.ok and report.worst is None
    assert {row.verdict for row in report.rows} == {"agrees"}, errors(report)
    assert all(row.uncertainty < 5e-3 and row.pixels > 0.5 for row in report.rows), errors(report)


@pytest.mark.parametrize(
    "adjoint", [*ADJOINTS[2:], *(pytest.param(mode, marks=pytest.mark.slow) for mode in (ADJOINTS[1], "generated"))]
)
def test_every_mode_agrees(adjoint):
    report = check("degree1", adjoint=adjoint, options=RasterOptions(depth=True), parameters=EVERYTHING, directions=2)
    assert {row.verdict for row in report.rows} == {"agrees"}, errors(report)


def test_the_known_wrong_mode_is_found():
    report = check("degree1", adjoint="plain", parameters=EVERYTHING, directions=4)
    assert not report.ok
    assert {"opacities", "means", "opacities2d", "conics", "means2d"} <= set(report.named("off")), errors(report)


@pytest.mark.parametrize("name", ["ties", "layers_4000"])
def test_what_cannot_be_told_is_not_called_off(name):
    """Order that any step changes; and 4000 layers at the cut, where every step crosses it somewhere."""
    report = check(name, directions=4)
    assert report.ok and "means" in report.named("unclear")
    assert "too uncertain to tell: means" in str(report)


def test_no_gaussians():
    report = check("empty", parameters=EVERYTHING, directions=1)
    assert report.ok and not report.named("unclear")


def scaled(index, factor):
    """A change of gradients: one of them times ``factor``, or forgotten."""

    def change(gradients):
        gradients[index] = None if factor is None else factor * gradients[index]

    return change


@pytest.mark.parametrize(
    ("function", "index", "factor", "named"),
    [
        (blend.Blend, 1, 1.05, {"conics", "quats", "scales"}),
        pytest.param(blend.Blend, 2, 1.01, {"opacities2d", "opacities"}, marks=pytest.mark.slow),
        (blend.Blend, 5, None, {"background"}),
        (project.Project, 1, torch.tensor([1.0, 1.0, -1.0, 1.0]), {"quats"}),
        pytest.param(project.Project, 5, 0.0, {"sh"}, marks=pytest.mark.slow),
        (project.Project, 0, float("nan"), {"means"}),
    ],
)
def test_a_wrong_gradient_is_named(function, index, factor, named, spoil):
    spoil(function, scaled(index, factor))
    report = check("degree1", parameters=EVERYTHING, directions=4)
    assert not report.ok
    found = set(report.named("off"))
    if "conics" in named:
        found.discard("means")  # a conic depends on its mean, but so little that 5 % of it may not be seen
    assert found == named, errors(report)


def test_turning_balls_changes_nothing(spoil):
    """Of their gradient only rounding is left, and that is no error; anything more is."""
    scene = SCENES["degree1"]()
    means, quats, scales, opacities, sh = scene.parameters()
    upright = torch.tensor([1.0, 0, 0, 0]).expand_as(quats).contiguous()
    arguments = (means, upright, scales[:, :1].expand(-1, 3).contiguous(), opacities, sh, scene.camera)
    assert check_gradients(*arguments, parameters=["quats"]).ok
    spoil(project.Project, lambda gradients: gradients.__setitem__(1, gradients[1] + 1))
    assert check_gradients(*arguments, parameters=["quats"]).named("off") == ["quats"]


def test_a_uniform_error_is_measured(spoil):
    spoil(blend.Blend, scaled(1, 1.05))
    report = check("degree1", parameters=["conics"])
    assert report.rows[0].error == pytest.approx(0.05, rel=0.02)
    assert report.worst.analytic == pytest.approx(1.05 * report.worst.difference, rel=0.01)


def test_the_gaussian_that_is_off_is_found(spoil):
    assert check("degree1", parameters=["scales"]).ok
    loudest = loud_gaussian()

    def change(gradients):
        gradients[2] = gradients[2].clone()
        gradients[2][loudest] = 0

    spoil(project.Project, change)
    report = check("degree1")
    assert report.named("off") == ["scales"]
    assert (report.worst.name, report.worst.index) == ("scales", loudest)
    assert report.worst.analytic == 0 and abs(report.worst.difference) > 0.1
    assert f"most in scales; there, Gaussian {loudest} alone has 0 instead of" in str(report)


def loud_gaussian():
    """Of the largest gradient with respect to the logarithm of its scales."""
    found = subject("degree1")
    gradient = found.gradient("scales", torch.ones(found.picture.shape[:2], dtype=torch.bool))
    return int((gradient * found.inputs["scales"]).abs().sum(1).argmax())


def subject(name, options=None, seed=0):
    """What check_gradients works on."""
    return movable(SCENES[name](), options, seed)


def movable(scene, options=None, seed=0):
    gaussians, options = check_gaussians(*scene.parameters()), options or RasterOptions()
    return differences.MovableScene(gaussians, scene.background, scene.camera, options, "manual", seed)


@pytest.mark.parametrize("name", ["degree2", "dense_tile"])
def test_differences_are_those_of_the_oracle(name):
    """Float64, torch.autograd: nothing in common with either side of the comparison."""
    found, scene = subject(name, RasterOptions(depth=True)), SCENES[name]().to("cpu", torch.float64)
    leaves = {key: getattr(scene, key).requires_grad_() for key in INPUTS}
    *geometry, background = leaves.values()
    truth = oracle.exact_render(*geometry, scene.camera, background)
    found.weights[truth.fragile] = 0
    picture = found._stack(truth)
    for key in INPUTS:
        found_slopes, exact = [], []
        for trial in differences.try_directions(found, key, 4, 2e-3):
            upstream = found.weights.double() * trial.quotient.kept[..., None]
            gradient = torch.autograd.grad(picture, leaves[key], upstream, retain_graph=True)[0]
            exact.append(float((gradient * trial.step).sum()) / differences.LEAST)
            found_slopes.append(trial.quotient.value)
            assert abs(found_slopes[-1] - exact[-1]) < 2 * trial.quotient.uncertainty, key
        error = torch.tensor(found_slopes) - torch.tensor(exact)
        assert error.norm() < 1e-3 * torch.tensor(exact).norm(), key


def test_boxes_grow_as_the_projection_says():
    """Conics and boxes of thicker Gaussians: the boxes that the check derives from the conics alone are the same."""
    thin, thick = subject("needles"), SCENES["needles"]()
    thick.scales.mul_(1.01)
    thick = movable(thick)
    drawn = (thin.splats.radii > 0) & (thick.splats.radii > 0)
    step = (thick.out.conics.double() - thin.out.conics.double()).detach()
    grown = thin.splats.extents * differences._growth(thin, "conics", step)
    assert (grown / thick.splats.extents - 1)[drawn].abs().max() < 2e-5
    assert (thick.splats.extents / thin.splats.extents - 1)[drawn].max() > 1e-3


def test_of_a_panorama_that_learns_poses_are_checked():
    """Its intrinsics are fixed by its size."""
    scene = SCENES["panorama"]()
    report = check_gradients(*scene.parameters(), CameraParameters(scene.camera), directions=2)
    assert report.ok and [row.name for row in report.rows[-2:]] == ["rotation", "translation"]


def test_deterministic_and_seeded():
    first, second, other = (check("single", directions=1, seed=seed) for seed in (0, 0, 1))
    assert first == second and first.rows[0].differences != other.rows[0].differences


def test_takes_the_arguments_of_rasterize():
    scene = SCENES["single"]()
    *four, sh = scene.parameters()
    pair = check_gradients(*four, (sh[:, :1], sh[:, 1:]), scene.camera, directions=1)
    leaves = [tensor.clone().requires_grad_() for tensor in scene.parameters()]
    assert pair == check_gradients(*leaves, scene.camera, torch.zeros(3), directions=1)
    assert all(leaf.grad is None for leaf in leaves)


def test_report_text():
    report = check("single", parameters=["means", "colors"], directions=2)
    lines = str(report).splitlines()
    assert lines[0].split() == "| parameter | gradient | differences | error | uncertainty | pixels | verdict |".split()
    assert [line.split()[1] for line in lines[2:4]] == ["means", "colors"]
    assert lines[-1] == "Adjoint 'manual': nothing is off."


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ({"parameters": ["means", "covariances"]}, r"parameters: expected a list of some of means, .*depths, got"),
        ({"parameters": "means"}, "parameters: expected a list"),
        ({"parameters": []}, "parameters: expected a list"),
        ({"parameters": [np.zeros(2)]}, "parameters: expected a list"),
        ({"adjoint": "automatic"}, "adjoint: expected one of manual, .*plain, got 'automatic'"),
        ({"directions": 0}, "directions: expected a whole number, at least 1, got 0"),
        ({"adjoint": np.zeros(2)}, "adjoint: expected one of manual"),
        ({"seed": "a"}, r"seed: expected a whole number from 0 to below 2\^63, got 'a'"),
        ({"seed": -1}, "seed: expected"),
        ({"seed": True}, "seed: expected"),
        ({"seed": 2**63}, "seed: expected"),
        ({"tolerance": 0.0}, "tolerance: expected a number between 0 and 1, got 0.0"),
        ({"options": RasterOptions(projection="flat")}, "options.projection: expected one of"),
    ],
)
def test_bad_input(argument, message):
    refusal(lambda: check("single", **argument), match=message)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"means": lambda t: t.double()}, "means: expected float32"),
        ({"background": lambda _: "white"}, "background: expected three"),
        ({"background": lambda _: (10**400, 0, 0)}, "background: expected three"),
        ({"background": lambda t: t.to_sparse()}, "background: expected a dense tensor"),
    ],
)
def test_bad_scene(change, message):
    scene = SCENES["single"]()
    given = {name: change.get(name, torch.clone)(getattr(scene, name)) for name in INPUTS}
    refusal(lambda: check_gradients(**given, camera=scene.camera), match=message)
