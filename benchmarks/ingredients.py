"""Ingredients of a training that are not in the package; ``benchmarks/prototypes.py`` measures what each is worth.

Each is a prototype: a part that is put into a trainer, other points to start from, or other options of a plan.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import torch
import warp as wp
from scipy.spatial import KDTree
from torch.autograd.function import once_differentiable

from warp_splat.config import TILE
from warp_splat.meshing import stereo
from warp_splat.meshing.fusion import Drawn, agreed, nearest_to, rays
from warp_splat.pruning.score import ViewSetting, weights
from warp_splat.raster.api import RenderOutput
from warp_splat.raster.data import Splats2D
from warp_splat.raster.drivers import DRIVERS
from warp_splat.raster.tolerance import only
from warp_splat.scene.types import Scene, View
from warp_splat.training.options import TrainConfig
from warp_splat.training.seams import Step
from warp_splat.training.trainer import Trainer

PIXELS, NEIGHBORS, TURNS, AGREEING = 1 << 12, 3, 3, 2  # of a dense start: of a photograph; views; of the search; views


def dense(scene: Scene, count: int) -> Scene:
    """With points where patches of photographs agree, up to ``count`` in all."""
    views = [_at_start(scene, view) for view in scene.train]
    depths = torch.cat([drawn.depth.flatten() for drawn, _ in views]).numpy()
    near, far = np.percentile(depths, (1, 99))
    nearness = wp.vec2(float(1 / far / stereo.RANGE), float(stereo.RANGE / near))
    drawn, found = [drawn for drawn, _ in views], []
    with patch.object(stereo, "TURNS", TURNS):
        for i, view in enumerate(drawn):
            others = nearest_to(i, drawn)
            facing = [o for o in others if o.camera.rotation[2] @ view.camera.rotation[2] > stereo.ALONG][:NEIGHBORS]
            planes = stereo._planes(view, torch.zeros_like(view.depth), facing, nearness)
            near_by = stereo._nearness(planes, view.camera)
            found.append(view._replace(depth=torch.where(near_by > 0, 1 / near_by, 0.0)))
    points, colors = [scene.points], [scene.colors]
    for view, (_, picture) in zip(agreed(found, AGREEING / (len(found) - 1)), views, strict=True):
        seen = view.depth > 0
        center = torch.from_numpy(view.camera.center.astype(np.float32))
        points.append((rays(view.camera, view.depth.device) * view.depth[..., None] + center)[seen].numpy())
        colors.append(picture[seen.numpy()])
    order = np.random.default_rng(0).permutation(sum(map(len, points[1:]))) + len(scene.points)
    kept = np.concatenate([np.arange(len(scene.points)), order[: max(count - len(scene.points), 0)]])
    return replace(scene, points=np.concatenate(points)[kept], colors=np.concatenate(colors)[kept])


def _at_start(scene: Scene, view: View) -> tuple[Drawn, np.ndarray]:
    """A small view with the depth of the nearest point of structure from motion, and its photograph as uint8."""
    share = min(1.0, math.sqrt(PIXELS / (view.camera.width * view.camera.height)))
    camera = view.camera.resized(round(share * view.camera.width), round(share * view.camera.height))
    seen = scene.tracks[view.name].points if view.name in scene.tracks else scene.points
    x, y, z = camera.rotation @ seen.T + camera.translation[:, None]
    ahead = z > 0
    places = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], 1)[ahead]
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    nearest = KDTree(places).query(np.stack([columns, rows], 2))[1]
    depth = torch.from_numpy(z[ahead][nearest].astype(np.float32))
    planes = torch.from_numpy(view.picture).float().permute(2, 0, 1)[None]
    small = torch.nn.functional.interpolate(planes, (camera.height, camera.width), mode="area")[0].permute(1, 2, 0)
    return Drawn(camera, depth, (small.mean(2, keepdim=True) / 255).contiguous()), small.round().byte().numpy()


class Skipping:
    """Where a view's loss is no more than usual, its adjoint and step are left out; never twice in a row for a view."""

    def __init__(self, trainer: Trainer, begin: float):
        self.begin = begin * trainer.config.learn.iterations
        self.usual: dict[View, float] = {}
        self.skipped: set[View] = set()
        trainer.parts.append(self)

    def loss(self, loss: torch.Tensor, _: RenderOutput, step: Step) -> torch.Tensor:
        """Without a graph, if it is skipped."""
        value, usual = float(loss.detach()), self.usual.get(step.view, 0.0)
        self.usual[step.view] = usual + 0.2 * (value - usual) if usual else value
        if step.iteration < self.begin or value > usual or step.view in self.skipped:
            self.skipped.discard(step.view)
            return loss
        self.skipped.add(step.view)
        return loss.detach().requires_grad_()


class ByLoss:
    """Views come as often as their loss is large: each saves up its share, and the richest is next."""

    def __init__(self, trainer: Trainer):
        views, random = trainer.scene.train, np.random.default_rng(trainer.config.learn.seed)
        self.saved = dict(zip(views, random.random(len(views)).tolist(), strict=True))
        self.usual: dict[View, float] = {}
        self.deal, trainer.deck.deal = trainer.deck.deal, self.dealt
        trainer.parts.append(self)

    def loss(self, loss: torch.Tensor, _: RenderOutput, step: Step) -> torch.Tensor:
        """Noted."""
        self.usual[step.view] = float(loss.detach())
        return loss

    def dealt(self, count: int) -> list[View]:
        """The next."""
        if len(self.usual) < len(self.saved):
            return self.deal(count)
        mean = sum(self.usual.values()) / len(self.usual)
        for view, loss in self.usual.items():
            self.saved[view] += loss / mean / len(self.usual)
        chosen = max(self.saved, key=lambda view: self.saved[view])
        self.saved[chosen] -= 1
        return [chosen]


class PairsPrice:
    """A price on pairs: the pixels in which Gaussians are over 1/255, over the photograph's."""

    def __init__(self, trainer: Trainer, price: float):
        self.price_each = price
        trainer.parts.append(self)

    def loss(self, loss: torch.Tensor, out: RenderOutput, _: Step) -> torch.Tensor:
        """With the price."""
        seen, size = out.radii > 0, out.image[..., 0].numel()
        (xx, xy, yy), opacities = out.conics[seen].unbind(1), out.opacities2d[seen]
        areas = 2 * math.pi * (255 * opacities).clamp_min(1.0).log() / (xx * yy - xy * xy).clamp_min(1e-12).sqrt()
        return loss + self.price_each * areas.clamp_max(size).sum() / size


class Pruning:
    """Once growth has ended, a share of the Gaussians goes: those of the least weight in the views that see most."""

    def __init__(self, trainer: Trainer, share: float):
        self.trainer, self.share = trainer, share
        self.at = trainer.growth.end  # type: ignore[attr-defined]
        trainer.parts.append(self)

    def after_step(self, iteration: int) -> None:
        """Prune."""
        if iteration != self.at:
            return
        it, views = self.trainer, self.trainer.scene.train[:: max(len(self.trainer.scene.train) // 12, 1)]
        with torch.no_grad():
            gaussians = it.model.activated()
        setting = ViewSetting(views, it.options, it.background)
        of_views = torch.stack([weights(gaussians, view, setting)[0] for view in views])
        second = of_views.topk(2, 0).values[1]  # one view alone does not count
        kept = second.argsort(stable=True)[round(self.share * len(second)) :].sort().values
        it.optimizer.replace(kept, {name: leaf.detach()[:0] for name, leaf in it.model.parameters.items()})


class GaussNewton:
    """Base colors, or opacities too, step by gradient over weight, in place of Adam's second moment.

    A Gaussian's weights over the view's pixels are found by one more adjoint of the blend; an accumulator in the first
    would be cheaper.
    """

    def __init__(self, trainer: Trainer, names: tuple[str, ...], rate: float):
        self.trainer, self.names, self.rate = trainer, names, rate
        self.weight = torch.zeros(0)
        self.size = 0
        self.step, trainer.optimizer.step = trainer.optimizer.step, self.stepped
        trainer.parts.append(self)

    def loss(self, loss: torch.Tensor, out: RenderOutput, _: Step) -> torch.Tensor:
        """Notes weights."""
        self.size = out.image.numel()
        self.weight = torch.autograd.grad(out.image, out.colors, torch.ones_like(out.image), retain_graph=True)[0][:, 0]
        return loss

    def stepped(self, radii: torch.Tensor | None) -> None:
        """Of the named parameters, and Adam's of the others."""
        for name in self.names if radii is not None else ():
            table = self.trainer.optimizer.tables[name]
            leaf, grad = table.leaf.detach(), table.leaf.grad
            assert grad is not None
            scale = self.weight + 0.5  # a pixel, so that what is hardly seen hardly moves
            if name == "opacities":
                scale = scale * (1 - torch.sigmoid(leaf)).reshape(-1) + 1e-3
            move = self.size * grad / scale.reshape(-1, *[1] * (grad.dim() - 1))
            leaf -= self.rate * table.rate * move.clamp(-1.0, 1.0)
            table.leaf.grad = None
        self.step(radii)


class Weigh(torch.autograd.Function):
    """An image whose gradient is weighed."""

    @staticmethod
    def forward(ctx, image, weight):
        ctx.save_for_backward(weight)
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx, adj_image):
        return adj_image * ctx.saved_tensors[0], None


class Blocks:
    """A share of the blocks of 2 x 2 tiles until the cooldown, by their error at the last visit, weighed by 1 / p.

    All blocks at the first visit of a view at a size. The rest of the image is the photograph, so that SSIM looks
    across the borders.
    """

    def __init__(self, trainer: Trainer, share: float):
        learn = trainer.config.learn
        self.trainer, self.share, self.end = trainer, share, learn.iterations - learn.cooldown
        self.random = np.random.default_rng(learn.seed)
        self.errors: dict[tuple, torch.Tensor] = {}
        self.chances, self.chosen = torch.ones(0), torch.ones(0, dtype=torch.bool)
        self.original, trainer.differentiate_view = trainer.differentiate_view, self.differentiated
        trainer.parts.append(self)

    def differentiated(self, step: Step, splats: Splats2D | None = None) -> torch.Tensor:
        """The gradients of some blocks."""
        camera, _ = self.trainer.photographs.at_size(step.view, step.iteration)
        self.tiles = -(-camera.height // TILE), -(-camera.width // TILE)
        self.key = step.view, camera.width
        known = self.errors.get(self.key)
        self.active = known is not None and step.iteration < self.end
        if not self.active:
            return self.original(step, splats)
        assert known is not None
        count = self.share * known.numel()
        chances = (known / known.mean() * 0.75 + 0.25) * self.share
        for _ in range(3):
            chances = (chances * count / chances.sum()).clamp_max(1.0)
        places = (chances.flatten().cumsum(0) + self.random.random()).floor().long()
        self.chances, self.chosen = chances, (places.diff(prepend=torch.zeros(1, dtype=torch.long)) > 0).view_as(known)
        listed = self._tiles(self.chosen).flatten()
        driver = DRIVERS["cpu"]
        fewer = replace(driver, bin=lambda *given: only(driver.bin(*given), listed))
        with patch.dict(DRIVERS, cpu=fewer):
            return self.original(step, splats)

    def _tiles(self, blocks: torch.Tensor) -> torch.Tensor:
        return blocks.repeat_interleave(2, 0).repeat_interleave(2, 1)[: self.tiles[0], : self.tiles[1]]

    def _pixels(self, blocks: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
        pixels = self._tiles(blocks).repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)
        return pixels[: image.shape[0], : image.shape[1], None]

    def image(self, image: torch.Tensor, _: RenderOutput, step: Step) -> torch.Tensor:
        """With the photograph where nothing was blended."""
        photograph = self.trainer.photographs.at_size(step.view, step.iteration)[1].image
        target = photograph.float() / 255 if photograph.dtype == torch.uint8 else photograph
        apart = (image.detach() - target).abs().mean(2)[None, None]
        error = torch.nn.functional.avg_pool2d(apart, 2 * TILE, ceil_mode=True)[0, 0] + 1e-4
        if not self.active:
            self.errors[self.key] = error
            return image
        self.errors[self.key] = torch.where(self.chosen, error, self.errors[self.key])
        inside = self._pixels(self.chosen, image)
        return Weigh.apply(torch.where(inside, image, target), self._pixels(1 / self.chances, image))


def once_more(config: TrainConfig, start: int) -> dict:
    """An interval in which the budget is reached, and one densification more."""
    options = config.plugins["budget"]
    count = math.ceil(math.log2(config.grow.max_gaussians / start)) + 1
    steps = (options.densify_until_iter - options.densify_from_iter) // count
    return {"densification_interval": min(100, max(steps, 1))}


class Ingredient(NamedTuple):
    """What is changed of ``--preset fast``, where it is measured, and what came of it."""

    seeds: dict[str, int]  # by size
    put: Callable[[Trainer], object] = lambda _: None  # into a trainer, before its first step
    start: Callable[[Scene, int], Scene] = lambda scene, _: scene  # of a scene, and the budget
    options: Callable[[TrainConfig, int], dict] = lambda *_: {}  # that are changed of a plan
    more: float = 1.0  # times the steps of the preset that it is compared with
    after: str = ""  # the method that it is taken from
    kept: str = "no"


SMALL_ONE, BOTH = {"small": 1}, {"small": 1, "large": 1}
INGREDIENTS = {
    "densified as often as the budget doubles the start": Ingredient(
        {"short, few points": 3, "few points": 1},
        options=lambda config, _: {"densification_interval": config.plugins["budget"].densification_interval},
        kept="yes, in `--minutes`: these plans ended below their budget",
    ),
    "the same, and once more": Ingredient(
        {"short": 3}, options=once_more, kept="no: church loses by all three seeds, though little"
    ),
    "densified every 25 steps": Ingredient(
        SMALL_ONE,
        options=lambda *_: {"densification_interval": 25},
        kept="no: it costs quality where the budget is reached anyway",
    ),
    "a dense start": Ingredient(
        BOTH,
        start=lambda scene, budget: dense(scene, budget // 2),
        after="PatchMatch",
        kept="no: costs more than it gives; embedded lacked Gaussians, which more densifications give for less",
    ),
    "views that got no worse skipped, once growth has ended": Ingredient(
        SMALL_ONE, put=lambda trainer: Skipping(trainer, 0.78), after="SkipGS", kept="no: see the next row"
    ),
    "the same in 1.15 times the steps": Ingredient(
        {"small": 3},
        put=lambda trainer: Skipping(trainer, 0.78),
        more=1.15,
        after="SkipGS",
        kept="no: nothing on photographs; embedded had a densification more",
    ),
    "views that got no worse skipped, from a fifth on": Ingredient(
        SMALL_ONE, put=lambda trainer: Skipping(trainer, 0.2), after="SkipGS", kept="no: fewer steps do as well"
    ),
    "views as often as their loss is large": Ingredient(
        SMALL_ONE, put=ByLoss, kept="no: worse on photographs, and no cheaper"
    ),
    "a price of 3e-5 on pairs": Ingredient(
        SMALL_ONE, put=lambda trainer: PairsPrice(trainer, 3e-5), kept="no: no fewer seconds in a plan this short"
    ),
    "a price of 1e-4 on pairs": Ingredient(
        SMALL_ONE, put=lambda trainer: PairsPrice(trainer, 1e-4), kept="no: likewise, and one photograph scene loses"
    ),
    "30 % pruned after growth, by weight in the second-best view": Ingredient(
        SMALL_ONE,
        put=lambda trainer: Pruning(trainer, 0.3),
        after="FastGS",
        kept="no: worse, and looking at 12 views costs more than a plan this short can save",
    ),
    "Gauss-Newton: colors, 2 times the rate": Ingredient(
        SMALL_ONE,
        put=lambda trainer: GaussNewton(trainer, ("sh_dc",), 2.0),
        kept="no: worse, even if the second adjoint cost nothing",
    ),
    "Gauss-Newton: colors, 6 times the rate": Ingredient(
        SMALL_ONE,
        put=lambda trainer: GaussNewton(trainer, ("sh_dc",), 6.0),
        kept="no: no better than Adam, even if the second adjoint cost nothing",
    ),
    "Gauss-Newton: colors and opacities, 6 times the rate": Ingredient(
        SMALL_ONE, put=lambda trainer: GaussNewton(trainer, ("sh_dc", "opacities"), 6.0), kept="no: worse"
    ),
    "half of the blocks of 32 x 32 px, by their error": Ingredient(
        SMALL_ONE,
        put=lambda trainer: Blocks(trainer, 0.5),
        after="TurboGS",
        kept="no: worse on two of three scenes, and picking tiles out of the lists costs what blends save",
    ),
}
