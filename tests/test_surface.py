"""The part that makes surfaces truer: its terms written out in float64, what they do, and what is refused."""

from dataclasses import replace
from operator import attrgetter

import numpy as np
import pytest
import torch
from hostile import refusal
from trainings import Pretended, begin, stepped, steps

from warp_splat.formats.checkpoint import load_checkpoint
from warp_splat.lenses import Lens
from warp_splat.scene.neighbors import distances
from warp_splat.training.options import TrainConfig
from warp_splat.training.record import keep, restore
from warp_splat.training.seams import Step
from warp_splat.training.trainer import Trainer

LEARNED = attrgetter("normals", "planes")
SURFACE = {"parts": "surface", "surface_normals": 0.3, "surface_views": 0.7, "opacity_reset_interval": 99}


def looked(trainer, view):
    """A view with normals and planes that take gradients."""
    options = trainer.parts[0].asks(trainer.options, Step(50, view))
    out, _ = trainer._render(view.camera, trainer.background, options)
    out.normals, out.planes = (plane.detach().requires_grad_() for plane in LEARNED(out))
    return out


def terms(out, view, views, kept, extent):
    """Both in step 50, in float64, of every other pixel of every other row; and 1 / depth where there is one."""
    camera, (height, width) = view.camera, out.alpha.shape
    columns, rows = np.arange(0, width, 2) + 0.5, np.arange(1, height, 2) + 0.5
    x, y = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    ray = np.stack([*np.broadcast_arrays(x, y[:, None]), np.ones((len(y), len(x)))], -1) @ camera.rotation
    height, width = len(y), len(x)
    planes = (values[1::2, ::2].detach().double().numpy() for values in (out.normals, out.planes[..., 0], out.alpha))
    normals, plane, alpha = planes
    slope = (normals * ray).sum(-1)
    seen = (alpha > 0.5) & (slope < -0.05 * alpha) & (plane < 0)
    depth = np.where(seen, plane / np.where(seen, slope, 1), 1)
    points = camera.center + depth[..., None] * ray
    unlike = 0.0
    for row, column in zip(*np.nonzero(seen[1:-1, 1:-1]), strict=True):
        i, j = row + 1, column + 1
        normal = np.cross(points[i + 1, j] - points[i - 1, j], points[i, j + 1] - points[i, j - 1])
        unlike += alpha[i, j] - normals[i, j] @ normal / np.linalg.norm(normal)
    apart = distances([camera], [other.camera for other in views], extent)[0]
    error = 0.0
    for place in [place for place in np.argsort(apart, kind="stable") if views[place] is not view][:4]:
        other = views[place].camera
        inside = points[seen] @ other.rotation.T + other.translation
        for (u, v), z in zip(other.pixels(inside), inside[:, 2], strict=True):
            column, row = np.array([u / other.width, v / other.height]) * 128 - 0.5
            left, top = int(np.floor(column)), int(np.floor(row))
            there = 0.0
            for i, j in ((top, left), (top, left + 1), (top + 1, left), (top + 1, left + 1)):
                if z > 0 and 0 <= i < 128 and 0 <= j < 128:
                    there += (1 - abs(i - row)) * (1 - abs(j - column)) * kept[place, i, j]
            error += abs(1 - z * there) if there > 0 and abs(1 - z * there) < 0.02 else 0.0
    return unlike / (height - 2) / (width - 2), error / 4 / height / width, np.where(seen, 1 / depth, 0)


def test_the_terms_are_those_written_out(scene, tmp_path):
    trainer, _ = stepped(scene, tmp_path, 30, **SURFACE)
    part, views, view = trainer.parts[0], scene.train, scene.train[3]
    assert part.kept.any(2).any(1).sum() > 12  # since the first quarter of the steps
    out, before = looked(trainer, view), part.kept.clone()
    loss = part.loss(torch.zeros(()), out, Step(50, view))
    unlike, error, nearness = terms(out, view, views, before.double().numpy(), scene.extent)
    assert unlike > 1e-3 and error > 1e-5
    assert float(loss) == pytest.approx(0.3 * unlike + 0.7 * error, rel=1e-4)
    height, width = nearness.shape
    rows, columns = ((np.arange(128) + 0.5) * size // 128 for size in (height, width))
    np.testing.assert_allclose(part.kept[3], nearness[np.int64(rows)[:, None], np.int64(columns)], rtol=1e-4, atol=1e-6)


def test_what_is_masked_does_not_count(scene, tmp_path):
    trainer, _ = stepped(scene, tmp_path, 30, **SURFACE)
    part, view, step = trainer.parts[0], scene.train[3], Step(50, scene.train[3])
    photograph = trainer.photographs.at_size(view, 50)[1]
    mask = torch.ones(*photograph.image.shape[:2], 1, dtype=torch.uint8)
    half = mask.shape[1] // 2
    mask[:, :half] = 0
    for given, inside in ((None, True), (mask, False)):
        part.photograph(photograph._replace(mask=given), step)
        out = looked(trainer, view)
        part.loss(torch.zeros(()), out, step).backward()
        for plane in LEARNED(out):  # depths beside a pixel that counts are looked at
            assert plane.grad[:, : half - 2].any() == inside and plane.grad[:, half:].any()
        assert part.kept[3, :, :48].any() == inside and part.kept[3, :, 80:].any()


def test_gradients(scene, tmp_path):
    """Of normals, by finite differences; of depths, along the other camera's axis, as far as they are looked up."""
    trainer, _ = stepped(scene, tmp_path, 30, **{**SURFACE, "surface_views": 0.0})
    part, view = trainer.parts[0], scene.train[3]
    out, nothing = looked(trainer, view), torch.zeros((), dtype=torch.float64)
    part.loss(nothing, out, Step(50, view)).backward()
    moves = [1e-4 * torch.randn(plane.shape, generator=torch.Generator().manual_seed(0)) for plane in LEARNED(out)]
    ends = []
    for sign in (1, -1):
        normals, planes = (plane.detach() + sign * move for plane, move in zip(LEARNED(out), moves, strict=True))
        ends.append(float(part.loss(nothing, replace(out, normals=normals, planes=planes), Step(50, view))))
    slope = sum(float((plane.grad * move).sum()) for plane, move in zip(LEARNED(out), moves, strict=True))
    assert ends[0] - ends[1] == pytest.approx(2 * slope, rel=0.02)
    other = scene.train[5].camera
    part.kept[5] = 0.25
    points = torch.tensor(other.center + 4.05 * other.forward - view.camera.center, dtype=torch.float32)
    points = (points + torch.rand(6, 5, 3) / 100).requires_grad_()
    part._error(points, view.camera, 5).sum().backward()
    assert np.allclose(points.grad, 0.25 * other.forward, atol=1e-6)


def test_depths_and_normals_come_to_agree(scene, tmp_path):
    """More than in a training without the part."""
    unlike = []
    for weight in (0.0, 3.0):
        trainer, run = begin(scene, tmp_path, **{**SURFACE, "surface_normals": weight}, densify_from_iter=99)
        steps(trainer, run, 50)
        kept = trainer.parts[0].kept.double().numpy()
        made = [terms(looked(trainer, view), view, scene.train, kept, scene.extent) for view in scene.train[:3]]
        unlike.append(sum(normals for normals, _, _ in made))
    assert unlike[1] < 0.95 * unlike[0]


@pytest.mark.slow
def test_the_same_bits_for_any_number_of_threads(scene, tmp_path, same_by_threads):
    def trained():
        return stepped(scene, tmp_path, 30, **SURFACE)[0].model.parameters.values()

    same_by_threads(trained)


def test_views_of_one_step_take_other_pixels(scene, tmp_path):
    """Of four, all pixels count, each once."""
    trainer, _ = stepped(scene, tmp_path, 30, **{**SURFACE, "surface_views": 0.0})
    view, counted = scene.train[3], 0
    for place in range(4):
        out = looked(trainer, view)
        trainer.parts[0].loss(torch.zeros(()), out, Step(52, view, place)).backward()
        rows, columns = np.nonzero(out.planes.grad[..., 0].numpy())
        assert len(rows) and len({*(rows % 2)}) == len({*(columns % 2)}) == 1
        counted |= 1 << int(2 * (rows[0] % 2) + columns[0] % 2)
    assert counted == 15


def test_it_asks_for_nothing_in_the_first_quarter(scene, tmp_path):
    trainer, _ = begin(scene, tmp_path, **SURFACE)
    asked = [trainer.parts[0].asks(trainer.options, Step(step, scene.train[0])).normals for step in (0, 1, 12, 13, 50)]
    assert asked == [True, False, False, True, True]


def test_two_tiny_photographs(scene, tmp_path):
    """Of which each has one neighbor, and of 3 x 5 px none whose normal is told; begun without the part."""
    few = replace(scene, train=scene.train[:2])
    trainer, run = stepped(few, tmp_path, 20)
    keep(trainer, run)
    trainer, run = begin(few, tmp_path, **SURFACE)
    row, options = few.train[0].camera.resized(4, 1), replace(trainer.options, normals=True)
    flat, _ = trainer._render(row, trainer.background, options)
    assert trainer.parts[0].loss(torch.zeros(()), flat, Step(50, few.train[0])) == 0
    restore(trainer, run, load_checkpoint(tmp_path))
    assert run.iteration == 20 and not trainer.parts[0].kept.any()
    steps(trainer, run, 24)
    part, tiny = trainer.parts[0], few.train[0].camera.resized(3, 5)
    compared = []  # not with itself
    part._error = lambda points, camera, other: compared.append(other) or 0.0 * points[..., 0]
    out, _ = trainer._render(tiny, trainer.background, replace(trainer.options, normals=True))
    assert part.loss(torch.zeros(()), out, Step(50, few.train[0])) == 0 and compared == [1]


def test_what_it_cannot_work_with_is_one_sentence(scene, tmp_path):
    bent = replace(scene.train[0].camera, lens=Lens("OPENCV", (0.1, 0.0, 0.0, 0.0)))
    curved = replace(scene, train=[replace(scene.train[0], camera=bent), *scene.train[1:]])
    refusal(lambda: begin(curved, tmp_path, **SURFACE), "--parts surface: expected pinholes, found a lens or a shutter")
    config = TrainConfig(device="cpu", parts="surface")
    refusal(lambda: Trainer(scene, config, Pretended(0, 2)), "--parts surface: expected one process")
