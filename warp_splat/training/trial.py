"""What a figure of the scene only suggests to ``--parts auto`` is tried: short trainings with the part and without it.

They see small images, and are judged on training photographs that are held back; the test set is not looked at. All of
them together take SHARE of the training's own work at most, by a count of steps and pixels.
"""

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from warp_splat.errors import InputError
from warp_splat.evaluation.metrics import cc_psnr, ssim
from warp_splat.flags import default_of
from warp_splat.runtime.distributed import Processes
from warp_splat.scene.types import Scene, as_shown
from warp_splat.text import Report
from warp_splat.training.options import TrainConfig
from warp_splat.training.parts import AUTO, PARTS
from warp_splat.training.photographs import shares_of_size, shrink_at
from warp_splat.training.plan import RATES, of_length, task_of
from warp_splat.training.seams import Verdict
from warp_splat.training.trainer import Trainer

SHARE = 0.1  # of the training's work
OVERHEAD = 30_000  # pixels that take as long as what a step does besides
SHRINK = 4  # of the images' edges
FOLDS = 2  # rounds, each with a seed and held-back photographs of its own
PERIOD = 5  # of so many photographs, one is held back
FEWEST = 4  # photographs
SHORTEST, LONGEST = 100, 1500  # steps of a training
GAIN = 0.1  # dB of CC_PSNR, in every round


def settle_parts(config: TrainConfig, scene: Scene, processes: Processes, say: Report) -> tuple[TrainConfig, list[str]]:
    """The options with names in place of ``--parts auto``; sentences on what was weighed, and on idle options."""
    verdicts: dict[str, Verdict] = {}
    if config.model.parts == AUTO:
        used, verdicts = config.used_parts, weigh(config, scene)
        suggested = {name: verdict for name, verdict in verdicts.items() if verdict.needed}
        tried = {name: suggested.pop(name) for name in list(suggested) if getattr(PARTS[name].load(), "tried", False)}
        used += suggested
        if tried:
            verdicts |= _tried(config, scene, used, tried, say)
            used += [name for name in tried if verdicts[name].needed]
        config = config.changed(parts=processes.first(",".join(name for name in PARTS if name in used)))
    told = [f"Part {name}: {'taken' if v.needed else 'left out'}, since {v.sentence}." for name, v in verdicts.items()]
    for name in PARTS:
        if name not in config.used_parts and (idle := _changed(config.plugins[name])):
            told.append(f"Warning: the part {name} is not used, without which {', '.join(idle)} will change nothing.")
    return config, told


def weigh(config: TrainConfig, scene: Scene) -> dict[str, Verdict]:
    """What figures of the scene say on each part that ``--parts auto`` may take."""
    offered = {name: entry.load() for name, entry in PARTS.items() if name not in config.used_parts}
    return {name: part.needed(scene) for name, part in offered.items() if hasattr(part, "needed")}


def suggested(config: TrainConfig, scene: Scene) -> TrainConfig:
    """The options with all that figures suggest in place of ``--parts auto``: the most that a training may have."""
    if config.model.parts != AUTO:
        return config
    needed = [name for name, verdict in weigh(config, scene).items() if verdict.needed]
    return config.changed(parts=",".join([*config.used_parts, *needed]))


def _changed(options: Any) -> list[str]:
    """The flags of a part's options that have not their defaults."""
    return [f"--{item.name}" for item in fields(options) if getattr(options, item.name) != default_of(item)]


def _tried(
    config: TrainConfig, scene: Scene, sure: list[str], suggested: dict[str, Verdict], say: Report
) -> dict[str, Verdict]:
    """A verdict by trainings on each part that is suggested, beside those that are sure and those taken before it."""
    count = FOLDS * (1 + len(suggested))
    steps = steps_of(config, scene, count)
    lacking = ""
    if len(scene.train) < FEWEST:
        lacking = f"{len(scene.train)} photographs are too few to hold some back"
    elif steps < SHORTEST:
        lacking = f"this training is too short, which leaves {max(steps, 0)} steps of {SHORTEST} for it"
    if lacking:
        return {name: _untried(verdict, lacking) for name, verdict in suggested.items()}
    say(f"Trying {', '.join(suggested)}: {count} trainings of {steps} steps on small images ...")
    found, base = {}, sure
    without = [quality(config, scene, base, steps, fold) for fold in range(FOLDS)]
    for name, verdict in suggested.items():
        try:
            given = [quality(config, scene, [*base, name], steps, fold) for fold in range(FOLDS)]
        except InputError as error:  # what it needs is in the photographs that are held back
            found[name] = _untried(verdict, str(error).rstrip("."))
            continue
        found[name] = judged(verdict, without, given)
        if found[name].needed:
            base, without = [*base, name], given
    return found


def _untried(verdict: Verdict, reason: str) -> Verdict:
    return Verdict(False, f"{verdict.sentence}, but could not be tried: {reason}")


def judged(verdict: Verdict, without: Sequence[tuple[float, float]], given: Sequence[tuple[float, float]]) -> Verdict:
    """Whether a part is worth it: with it, every round is better by GAIN of CC_PSNR, and none worse in SSIM."""
    changes = np.subtract(given, without)
    needed = bool((changes[:, 0] >= GAIN).all() and (changes[:, 1] >= 0).all())
    decibels = " and ".join(f"{change:+.2f}" for change in changes[:, 0])
    likeness = " and ".join(f"{change:+.4f}" for change in changes[:, 1])
    told = f"on photographs held back, short trainings with it changed CC_PSNR by {decibels} dB and SSIM by {likeness}"
    return Verdict(needed, f"{verdict.sentence}; {told} (limits {GAIN:+} dB and 0)")


def steps_of(config: TrainConfig, scene: Scene, trainings: int) -> int:
    """How long each of the trainings may be, less what their evaluation takes: by a count, so the same everywhere."""
    learn, shares, camera = config.learn, shares_of_size(config.learn, scene.train), scene.train[0].camera
    sizes = np.array([shrink_at(learn, shares, step) for step in range(1, learn.end_or_plan + 1)])
    whole, small = ((camera.width * camera.height / size**2 + OVERHEAD).sum() for size in (sizes, np.array([SHRINK])))
    return min(int(SHARE * whole / small / trainings) - -(-len(scene.train) // PERIOD), LONGEST)


def quality(config: TrainConfig, scene: Scene, parts: list[str], steps: int, fold: int) -> tuple[float, float]:
    """CC_PSNR [dB] and SSIM of photographs held back from a training with these parts, over so many steps."""
    held = scene.train[fold::PERIOD]
    kept = [view for place, view in enumerate(scene.train) if place % PERIOD != fold]
    short = _shortened(config, scene, steps).changed(parts=",".join(parts), seed=config.learn.seed ^ fold)
    trainer = Trainer(replace(scene, train=kept, test=held, find_tracks=lambda: scene.tracks), short)
    for iteration in range(1, steps + 1):
        trainer.advance(iteration)
    values = []
    for view in trainer.refined(held):
        camera, photograph = trainer.photographs.at_size(view, steps)
        mask = None if photograph.mask is None else photograph.mask[..., 0].cpu().numpy()
        if mask is None or mask.any():
            pair = trainer.picture(camera, view.name), as_shown(photograph.image.cpu().numpy())
            values.append((cc_psnr(*pair, mask), ssim(*pair, mask)))
    means = np.mean(values, 0) if values else np.zeros(2)
    return float(means[0]), float(means[1])


def _shortened(config: TrainConfig, scene: Scene, steps: int) -> TrainConfig:
    """The shape of the training over fewer steps, with images that stay small."""
    task = task_of(config, scene, ())
    short = of_length(config, steps / config.learn.end_or_plan, task._replace(most=task.most // SHRINK))
    own = {name: getattr(config.learn, name) for name in RATES}  # verdicts are on the training's
    return short.changed(
        iterations=steps, minutes=0.0, coarse=SHRINK, coarse_by="steps", coarse_until_iter=SHRINK * steps, **own
    )
