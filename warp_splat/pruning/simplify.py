"""``warp-splat simplify``: a finished model in fewer Gaussians and harmonics, to a share, a loss or a size of file."""

import math
import os
import re
import time
from bisect import bisect_right
from collections.abc import Callable
from pathlib import Path

import numpy as np

from warp_splat.config import SimplifyConfig
from warp_splat.errors import InputError
from warp_splat.evaluation.metrics import psnr
from warp_splat.evaluation.report import BLUE, GREEN, ORANGE, new_panels, plain_axes, save_figure
from warp_splat.formats.files import write_csv
from warp_splat.formats.model_folder import folder_of, is_file_of_gaussians, read_cfg_args
from warp_splat.formats.splats import COEFFICIENTS, SplatArrays, SplatFile, sizes
from warp_splat.pruning.opened import Opened, as_held, output_of, require_some, write, written_bytes
from warp_splat.pruning.score import costs
from warp_splat.pruning.thinning import Thinning, model_of, tuned
from warp_splat.rendering.changes import largest_change
from warp_splat.rendering.finished import Finished
from warp_splat.text import format_table, upward

LEVELS = (1.0, 0.8, 0.65, 0.5, 0.4, 0.3, 0.2)  # shares of the Gaussians that the table and the plot show
HARMONICS_LOSS = 0.02  # dB of the training views that leaving out harmonics may cost
TRIES = 6  # halvings of the range of counts, for a loss or a size: 1/64 of the Gaussians is left of it
UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9}
UNSEEN = "Without a scene, Gaussians are left out by opacity and extent alone, which costs several times the decibels."


def simplify(config: SimplifyConfig) -> int:
    """Simplify as ``config`` says; returns the process's exit code.

    Raises:
        InputError: if the model, its scene or an option is not usable; if nothing would be left.
    """
    _check(config)
    output = output_of(config, "simplified.ply")
    args = folder_of(config.model) / "cfg_args"
    scene = read_cfg_args(args.parent).get("source_path") if args.exists() else ""
    if is_file_of_gaussians(config.model) and not (config.source_path or os.path.exists(str(scene or ""))):
        return _unseen(config, output)
    opened = Opened(config)
    if config.tolerance and opened.harmonics is not None:
        raise InputError("--tolerance: expected one color behind the Gaussians, found a sky; choose with --max_loss.")
    whole, file = opened.file.splats, as_held(output, opened.file)
    thinning = Thinning(file.splats, opened.setting)
    _curve(opened, thinning, output)

    def made(count: int) -> SplatArrays:
        if not config.steps:
            return thinning.to(count)
        return tuned(opened.scene, file, opened.setting, count, config.steps, opened.trained, opened.exposures)

    total, views = len(file.splats.means), opened.scene.train
    enough = opened.psnr(whole, views) - config.max_loss if config.max_loss else -math.inf

    def changed(splats: SplatArrays) -> tuple[float, float]:
        before, after = (model_of(some, opened.setting).activated() for some in (whole, splats))
        cameras = [view.camera for view in views]
        return largest_change(before, after, cameras, opened.setting.background, opened.setting.options)

    lost = whole.sh[:, file.splats.sh.shape[1] :].any()
    if lost and not config.steps:
        broken = config.tolerance and changed(file.splats)[1] > config.tolerance
        if broken or (config.max_loss and opened.psnr(file.splats, views) < enough):
            raise InputError(f"{output}: expected a format with room for harmonics; this loses more than allowed.")
    if config.tolerance:
        _, count = _narrowed(0, total, lambda count: changed(made(count))[1] > config.tolerance)
    elif config.max_loss:
        spare = min(HARMONICS_LOSS, config.max_loss / 2) if file.splats.sh.shape[1] > 1 else 0.0
        _, count = _narrowed(0, total, lambda count: opened.psnr(made(count), views) < enough + spare)
    else:
        count = _count(config, output, file, thinning.to)
    # no fewer keep the promise
    splats = file.splats if config.max_loss and count == total and not (lost and config.steps) else made(count)
    if not config.tolerance:
        splats = fewer_harmonics(opened, splats, enough if config.max_loss else None)
    if config.size and config.steps:  # trained numbers are harder to pack
        thinning = Thinning(splats, opened.setting)
        splats = thinning.to(_count(config, output, file._replace(splats=splats), thinning.to))
    saved = write(output, opened, splats)
    if config.tolerance:
        measured, bound = changed(splats)
        found = f"{measured:.2g} measured, {upward(bound)} its bound"
        print(f"  largest change of a pixel, before the format rounds, {len(views)} training views: {found}")
        if bound > config.tolerance:
            print("  Without any change, the bound of rounding is more: nothing is left out; raise --tolerance.")
    numbers = np.bincount(degrees_of(splats))
    print(f"  harmonics: {', '.join(f'{number} of degree {degree}' for degree, number in enumerate(numbers))}")
    if opened.print_quality(whole, saved) < enough - 5e-3:  # which two digits do not show
        print("  That is more than --max_loss, because of what the format rounds or has no room for: choose another.")
    print(f"  what each share costs: {output.with_suffix('.curve.png')}, .csv")
    return int(saved != output)


def fewer_harmonics(opened: Opened, splats: SplatArrays, least: float | None = None) -> SplatArrays:
    """The Gaussians with zeros for harmonics of degrees that do not show, each from its own degree on.

    What each degree of each Gaussian changes by itself tells which: squares may add up to HARMONICS_LOSS. A quarter of
    that is tried where the training views lose more.

    Args:
        opened: the model and its training views.
        splats: its Gaussians, or some of them.
        least: PSNR [dB] that these views keep, in place of all but HARMONICS_LOSS.
    """
    views, now = opened.scene.train, opened.psnr(splats, opened.scene.train)
    least = now - HARMONICS_LOSS if least is None else least
    squares = sum(3 * view.camera.width * view.camera.height for view in views) * 10 ** (-now / 10)
    allowed = squares * (10 ** (HARMONICS_LOSS / 10) - 1) * (now >= least)
    change = costs(model_of(splats, opened.setting), opened.setting).harmonics.cpu().numpy()
    bounds = np.unique(np.append(change, 0.0))  # up to one of them a Gaussian's change is accepted
    while True:
        larger = bisect_right(bounds, allowed, key=lambda bound: _degrees(change, bound)[1])  # first for which too much
        kept = np.array(COEFFICIENTS)[_degrees(change, bounds[larger - 1])[0], None] > np.arange(splats.sh.shape[1])
        fewer = splats._replace(sh=np.where(kept[..., None], splats.sh, np.float32(0)))
        if larger == 1 or opened.psnr(fewer, views) >= least:
            return fewer
        allowed /= 4


def _degrees(change: np.ndarray, bound: float) -> tuple[np.ndarray, float]:
    """The lowest degree of each Gaussian that changes the images by at most ``bound``, and the sum of the changes."""
    padded = np.column_stack([change, np.zeros(len(change))])
    degrees = (padded <= bound).argmax(axis=1)
    return degrees, float(padded[np.arange(len(change)), degrees].sum())


def degrees_of(splats: SplatArrays) -> np.ndarray:
    """The highest degree of each Gaussian that is not zero [N]."""
    used = np.any(splats.sh != 0, axis=2)
    return np.searchsorted(COEFFICIENTS, np.where(used, np.arange(used.shape[1]), 0).max(axis=1), side="right")


def bytes_of(size: str) -> int:
    """A number of bytes from text: 10MB, 500 kB, 1.5M.

    Raises:
        InputError: if it is no size.
    """
    if not (found := re.fullmatch(r"(\d+\.?\d*)\s*([KMG]?)B?", size.strip().upper())) or not float(found[1]):
        raise InputError(f"--size {size:.40}: expected a size of file such as 10MB or 500kB.")
    return int(float(found[1]) * UNITS[found[2]])


def _check(config: SimplifyConfig) -> None:
    if len(given := [name for name in ("keep", "max_loss", "size", "tolerance") if getattr(config, name)]) != 1:
        found = " and ".join(f"--{name}" for name in given) or "none"
        raise InputError(f"simplify: expected one of --keep, --max_loss, --size and --tolerance above 0, got {found}.")
    if config.size:
        bytes_of(config.size)
    if config.tolerance and config.steps:
        raise InputError("--steps: training changes all pixels; leave it out where there is a --tolerance.")


def _count(config: SimplifyConfig, output: Path, file: SplatFile, to: Callable[[int], SplatArrays]) -> int:
    """How many Gaussians of ``file`` to keep, for ``--keep`` or ``--size``; ``to`` gives those of a count."""
    total = len(file.splats.means)
    if config.keep:
        count = round(config.keep * total)
    else:
        most = bytes_of(config.size)
        fits = lambda count: written_bytes(output, file._replace(splats=to(count))) <= most  # noqa: E731
        if fits(total):
            return total
        count = _narrowed(1, total, fits, total.bit_length() + TRIES)[0] if fits(1) else 0
    if not count:
        raise InputError(f"{config.model}: nothing would be left of {total} Gaussians; keep more, or allow more bytes.")
    return count


def _narrowed(low: int, high: int, is_low: Callable[[int], bool], tries: int = TRIES) -> tuple[int, int]:
    """Counts nearer to where ``is_low`` ends: it holds of the first of the two, and not of the second."""
    for _ in range(tries):
        if high - low <= max(1, low >> TRIES):
            break
        middle = (low + high) // 2
        low, high = (middle, high) if is_low(middle) else (low, middle)
    return low, high


def _curve(opened: Opened, thinning: Thinning, output: Path) -> None:
    """Print, write and plot what shares of the Gaussians are worth, before any training."""
    rows, (name, views) = [], opened.scene.evaluated
    opened.picture_of(opened.file.splats)(views[0].camera, views[0].name)  # what is done but once is not timed
    for share in LEVELS:
        splats = thinning.to(max(1, round(share * len(opened.file.splats.means))))
        picture, start = opened.picture_of(splats), time.perf_counter()
        renders = [picture(view.camera, view.name) for view in views]
        seconds = time.perf_counter() - start
        pairs = zip(renders, views, strict=True)
        row = {
            "kept": share,
            "Gaussians": len(splats.means),
            "MB": written_bytes(output, opened.file._replace(splats=splats)) / 1e6,
            "frames_per_second": len(views) / seconds,
            f"{name}_PSNR": float(np.minimum([psnr(render, v.picture, v.mask) for render, v in pairs], 99.0).mean()),
        }
        rows.append(row)
    lines = [[f"{value:.2f}" if isinstance(value, float) else value for value in row.values()] for row in rows]
    print(format_table([head.replace("_", " ") for head in rows[0]], lines))
    write_csv(output.with_suffix(".curve.csv"), rows)
    figure, grid = new_panels(2.5, 1, 3, sharex=True)
    titles = {"MB": "size [MB]", "frames_per_second": "frames per second", f"{name}_PSNR": f"{name} PSNR [dB]"}
    for axes, color, (key, title) in zip(np.ravel(grid), (BLUE, GREEN, ORANGE), titles.items(), strict=True):
        plain_axes(axes, title, "share of the Gaussians kept")
        axes.plot([row["kept"] for row in rows], [row[key] for row in rows], color=color, marker="o", markersize=4)
    save_figure(figure, output.with_suffix(".curve.png"))


def _unseen(config: SimplifyConfig, output: Path) -> int:
    """Without a scene: the largest by opacity and extent."""
    if config.max_loss or config.steps or config.tolerance:
        raise InputError("--max_loss, --tolerance, --steps: expected photographs to compare; name a scene with -s.")
    print(UNSEEN)
    finished = Finished(config.model, config.iteration, config.crop)
    require_some(finished)
    file = as_held(output, finished.file)
    order = np.argsort(-sizes(file.splats), kind="stable")
    keep = lambda count: file.splats.take(np.sort(order[:count]))  # noqa: E731
    count = _count(config, output, file, keep)
    return int(write(output, finished, keep(count)) != output)
