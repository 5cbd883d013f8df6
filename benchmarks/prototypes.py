"""Ingredients that are not in the package, each beside `--preset fast` at equal processor seconds.

Each is a prototype: a part that is put into a trainer, or other points to start from. It trains by turns with the
preset in one process on one thread, so that both meet the same machine; the ratio of their processor seconds (starts
included) is what it costs. What the preset reaches in as many seconds lies between its trainings of half as many steps
and of as many. Runs are kept in a folder and not repeated; several of these programs may run at once.

    python benchmarks/prototypes.py --runs output/prototypes --fox path/to/fox --church path/to/church [--out folder]
"""

import json
import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import torch
import warp as wp
from common import RUNS, option, parse, write_table
from scipy.spatial import KDTree
from torch.autograd.function import once_differentiable

from warp_splat.config import TILE
from warp_splat.evaluation.metrics import ssim
from warp_splat.kernels.patches import search
from warp_splat.meshing import stereo
from warp_splat.meshing.fusion import Drawn, agreed, nearest_to, rays
from warp_splat.presets import EMBEDDED_DEFAULTS, PRESETS
from warp_splat.pruning.score import ViewSetting, weights
from warp_splat.raster.api import RenderOutput
from warp_splat.raster.data import Splats2D
from warp_splat.raster.drivers import DRIVERS
from warp_splat.raster.tolerance import only
from warp_splat.runtime import launch
from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene
from warp_splat.scene.types import Scene, View
from warp_splat.training.options import TrainConfig
from warp_splat.training.plan import of_length, task_of
from warp_splat.training.seams import Step
from warp_splat.training.trainer import Trainer

#: Divisor of edges, budget; the points of small ones are thinned as the preset's budget is.
SIZES = {"fox": (8, 8000), "church": (8, 8000), "embedded": (2, 12_000)}
SIZES |= {"fox, half": (2, 100_000), "church, half": (2, 100_000), "embedded, whole": (1, 50_000)}
SMALL = ("fox", "church", "embedded")
LARGE = ("embedded, whole", "fox, half", "church, half")
GROUPS = {"small": (SMALL, 0.25), "large": (LARGE, 0.25), "short": (LARGE, 0.0625)}  # scenes, share of the steps
GROUPS |= {"few points": (("embedded, whole",), 0.25), "short, few points": (("embedded, whole",), 0.0625)}
COST = "fox, half", 0.0625  # the scene and the share of the steps in which an ingredient's seconds are measured
TURNS_EACH = 50  # in which two trainings run by turns
PRESET = "--preset fast"
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
            others = (drawn[j] for j in nearest_to(i, drawn))
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


def train(scene: Scene, name: str, share: float, seed: int, ingredient: Ingredient | None) -> list[dict]:
    """What the preset, or an ingredient, reaches in ``share`` of the steps; of larger scenes, by turns with the preset.

    With the processor's seconds, times those of the preset where that ran by turns. That is the second then.
    """
    ours, limit = name.startswith("embedded"), SIZES[name][1]
    preset = PRESETS["fast"] | (EMBEDDED_DEFAULTS["fast"] if ours else {})
    fewer = preset["max_gaussians"] // limit
    scene = replace(scene, points=scene.points[::fewer], colors=scene.colors[::fewer])
    whole = TrainConfig(**preset | {"max_gaussians": limit, "seed": seed, "device": "cpu"})
    task = task_of(whole, scene, Trainer(scene, whole).photographs.shares)
    plain, trainers, seconds = Ingredient({}), [], []
    for it in [ingredient, plain] if ingredient and name not in SMALL else [ingredient or plain]:
        config = of_length(whole, share * it.more, task)
        config = config.changed(**{"densification_interval": 100} | it.options(config, len(scene.points)))
        begun = time.process_time()
        trainers.append(Trainer(it.start(scene, config.grow.max_gaussians), config))
        it.put(trainers[-1])
        seconds.append(time.process_time() - begun)
        trainers[-1].warm_up()
    for turn in range(TURNS_EACH):
        for place, trainer in enumerate(trainers):
            last, begun = trainer.config.learn.iterations, time.process_time()
            for iteration in range(1 + last * turn // TURNS_EACH, 1 + last * (turn + 1) // TURNS_EACH):
                if iteration > 1:
                    trainer.update(iteration - 1)
                trainer.differentiate(iteration)
            seconds[place] += time.process_time() - begun
    made = zip(trainers, seconds, strict=True)
    return [measured(it, scene) | {"seconds": time, "cost": time / seconds[-1]} for it, time in made]


def measured(trainer: Trainer, scene: Scene) -> dict:
    """Of a training that has ended."""
    similar = [ssim(trainer.picture(view.camera), view.picture) for view in scene.test]
    reached = {"psnr": trainer.evaluate(scene.test), "train": trainer.evaluate(scene.train[::4])}
    return reached | {"ssim": float(np.mean(similar)), "gaussians": len(trainer.model)}


class Runs:
    """What has been trained, in a folder; trains what is not there."""

    def __init__(self, folder: Path, places: dict[str, Path | None], only_table: bool):
        self.folder, self.places, self.only_table = folder, places, only_table
        self.scenes: dict[str, Scene] = {}

    def get(self, what: str, name: str, share: float, seeds: int) -> dict[int, dict]:
        """By seed; without what another program is at, or is not to be trained."""
        found, place = {}, self.places[name.partition(",")[0]]
        for seed in range(seeds):
            path = self._path(what, name, share, seed)
            if not path.exists() and place and not self.only_table:
                path.touch()
                try:
                    if name not in self.scenes:
                        self.scenes[name] = load_scene(place, eval=True, resolution=SIZES[name][0], report=str)
                    made, *beside = train(self.scenes[name], name, share, seed, INGREDIENTS.get(what))
                    path.write_text(json.dumps(made))
                    if beside:
                        self._path(PRESET, name, share, seed).write_text(json.dumps(beside[0]))
                    print(name, share, what, seed, {key: round(value, 3) for key, value in made.items()}, flush=True)
                finally:
                    if not path.stat().st_size:
                        path.unlink()
            if path.exists() and path.stat().st_size:
                found[seed] = json.loads(path.read_text())
        return found

    def _path(self, what: str, name: str, share: float, seed: int) -> Path:
        word = "".join(letter if letter.isalnum() else "_" for letter in what)
        return self.folder / f"{name}_{share:g}_{word}_{seed}.json"


def row_of(runs: Runs, what: str, size: str) -> tuple | None:
    """Of each scene the gain over the preset in as many steps, and over what it reaches in as many seconds."""
    it, cells, costs = INGREDIENTS[what], dict.fromkeys(SMALL, ""), []
    names, share = GROUPS[size]
    for name in names:
        news, olds = (runs.get(which, name, share, it.seeds[size]) for which in (what, PRESET))
        half, beside = runs.get(PRESET, name, share / 2, 1), runs.get(what, *COST, 1) if size == "small" else news
        both = [seed for seed in news if seed in olds]
        if not both or not half or not beside:
            continue
        costs.append(float(np.mean([run["cost"] for run in beside.values()])))
        same = np.array([news[seed]["psnr"] - olds[seed]["psnr"] for seed in both])
        gain = same - max(olds[0]["psnr"] - half[0]["psnr"], 0.0) * math.log2(costs[-1])
        cells[name.partition(",")[0]] = f"{same.mean():+.2f}, {gain.mean():+.2f}{_span(gain, '+.2f')}"
    if not costs:
        return None
    return what, it.after, size, it.seeds[size], f"{np.mean(costs):.2f}", *cells.values(), it.kept


def row_of_preset(runs: Runs, size: str) -> tuple:
    """What it reaches itself, and how that scatters."""
    cells, (names, share) = dict.fromkeys(SMALL, ""), GROUPS[size]
    for name in names:
        reached = np.array([run["psnr"] for run in runs.get(PRESET, name, share, 3).values()])
        if len(reached):
            cells[name.partition(",")[0]] = f"{reached.mean():.2f}{_span(reached, '.2f')}"
    return PRESET, "", size, 3, "1", *cells.values(), ""


def _span(values: np.ndarray, how: str) -> str:
    return f" ({values.min():{how}} to {values.max():{how}})" if len(values) > 1 else ""


HEADERS = ("ingredient", "after", "size", "seeds", "seconds", *SMALL, "kept")
NOTE = (
    "First row: held-out PSNR of --preset fast, densifying every 100 steps. Others: gains over it [dB] with the same "
    "seeds, in as many steps, and in as many seconds; in brackets, from seed to seed. All in a quarter of the "
    "preset's steps (short: a sixteenth), with rates and budgets as --minutes takes them. seconds: the processor's, "
    "times the preset's, by turns in one process on one thread; for small ones those of fox at half size in a "
    "sixteenth of the steps. What the preset reaches in other seconds lies on a line through half as many steps, in "
    "their logarithm. small: photographs of an eighth of their edges, budgets of 8,000 (embedded: half, 12,000); "
    "large and short: half of their edges, 100,000 (embedded: whole, 50,000); times the root of the share of steps, "
    "like the points of small ones."
)


def main() -> None:
    arguments = parse(
        __doc__,
        *RUNS,
        option("--only", default="", help="ingredients whose names begin so, between commas"),
    )
    launch.prepare("cpu", 1)
    launch.load(search, torch.device("cpu"))
    arguments.runs.mkdir(parents=True, exist_ok=True)
    places = {"fox": arguments.fox, "church": arguments.church, "embedded": embedded_scene()}
    runs = Runs(arguments.runs, places, arguments.only_table)
    chosen = {what: it for what, it in INGREDIENTS.items() if what.startswith(tuple(arguments.only.split(",")))}
    rows = [row for what, it in chosen.items() for size in it.seeds if (row := row_of(runs, what, size))]
    rows.insert(0, row_of_preset(runs, "small"))
    write_table("prototypes", arguments.out, HEADERS, rows, NOTE)


if __name__ == "__main__":
    main()
