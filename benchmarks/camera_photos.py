r"""Cameras of photographs that find their way back into a trained model, and where the photograph would have them.

A photograph's camera is turned by 5 degrees and moved by 10 % of the scene's extent. It then follows the gradients of
the difference to the photograph: of its pose alone, with fx and fy free as well (5 % too long at the start), and with
cx and cy, too (2 % of the width and height off).

    python benchmarks/camera_photos.py -m output/fox -m output/church [--out docs/benchmarks]
"""

from pathlib import Path

import numpy as np
import torch
from cameras import ANGLE, SHIFT, ZOOM, compared, descend, direction, distance
from common import TRAINED, parse, write_table

from warp_splat import Camera, CameraParameters
from warp_splat.evaluation.report import BLUE, GREEN, ORANGE, new_panels, plain_axes, save_figure
from warp_splat.gaussians import GaussianModel
from warp_splat.raster.api import render
from warp_splat.raster.data import Gaussians
from warp_splat.rendering.finished import Finished
from warp_splat.runtime import launch

FREE = {"pose": 0, "and fx, fy": 2, "and cx, cy": 4}  # intrinsics that are free
ASIDE = 0.02  # of the principal point, in widths and heights
#: How many times smaller, steps, rates of Adam at start and end.
STAGES = ((4, 200, 1e-2, 3e-3), (2, 200, 3e-3, 1e-3), (1, 200, 1e-3, 5e-5))
COLORS = dict(zip(FREE, (BLUE, ORANGE, GREEN), strict=True))
#: What a panel shows, and how many intrinsics have to be free for it.
TITLES = {"direction [degrees]": 0, "place [% of extent]": 0, "focal length [%]": 2, "principal point [%]": 4}
HEADERS = ("scene", "photograph", "free", "direction", "place", "fx, fy", "cx, cy")


def errors_of(camera: Camera, right: Camera, extent: float) -> list[float]:
    """Degrees; shares of the extent, of the focal lengths, and of the size, in per cent."""
    degrees, place, focal = distance(camera, right)
    middle = max(abs(camera.cx - right.cx) / right.width, abs(camera.cy - right.cy) / right.height)
    return [degrees, *(100 * float(value) for value in (place / extent, focal, middle))]


def follow(draw, view, extent: float, free: int, seed: int) -> list[list[float]]:
    """Before every step and at last: the :func:`errors_of` from the camera that the scene gives."""
    generator = np.random.default_rng(seed)
    start = np.concatenate([direction(generator, ANGLE), direction(generator, SHIFT), [ZOOM - 1] * 2, [ASIDE] * 2])
    start[6 + free :] = 0.0
    numbers = torch.tensor(start, requires_grad=True)
    units = torch.tensor([1.0] * 3 + [extent] * 3, dtype=torch.float64)
    kept = torch.arange(10) < 6 + free
    errors = []

    def learned(camera: Camera) -> CameraParameters:
        given = [camera.fx, camera.fy, camera.cx, camera.cy]
        spans = [camera.fx, camera.fy, camera.width, camera.height]
        given, spans = torch.tensor([given, spans], dtype=torch.float64)
        return CameraParameters(camera, numbers[:6] * units, given + spans * numbers[6:])

    photo = torch.from_numpy(view.image).float().permute(2, 0, 1) / 255
    for shrink, steps, rate, last in STAGES:
        target = torch.nn.functional.avg_pool2d(photo, shrink).permute(1, 2, 0)
        camera = view.camera.resized(target.shape[1], target.shape[0])
        errors += descend(
            numbers,
            lambda: compared(draw(learned(camera)), target),  # noqa: B023 - called in this round
            lambda: errors_of(learned(view.camera).camera, view.camera, extent),
            *(steps, rate, last, kept),
        )
    return [*errors, errors_of(learned(view.camera).camera, view.camera, extent)]


def follow_all(model: Path) -> dict[tuple[str, str, str], list[list[float]]]:
    """By scene, photograph and what is free: the middle one of those for training; its pose of those held out."""
    finished = Finished(model)
    scene, splats = finished.load_scene("", lambda line: None), finished.file.splats
    activated = Gaussians(*(tensor.detach() for tensor in GaussianModel.from_splats(splats).activated()))
    options, background = finished.options, torch.zeros(3)
    found = {}
    for split, views, names in (("", scene.train, FREE), (", held out", scene.test, list(FREE)[:1])):
        view = views[len(views) // 2]
        for name in names:
            draw = lambda camera: render(activated, camera, background, options).image  # noqa: E731
            key = (Path(str(finished.trained["source_path"])).name, view.name + split, name)
            found[key] = follow(draw, view, scene.extent, FREE[name], seed=0)
            print(*key, found[key][-1], flush=True)
    return found


def plot(runs: dict[tuple[str, str, str], list[list[float]]], path: Path) -> None:
    """Errors over steps, a panel for each."""
    figure, panels = new_panels(2.6, columns=len(TITLES))
    for column, (axes, (title, least)) in enumerate(zip(panels[0], TITLES.items(), strict=True)):
        for (_, photo, free), run in runs.items():
            style = "--" if "held out" in photo else "-"
            if FREE[free] >= least:
                axes.semilogy([errors[column] for errors in run], style, color=COLORS[free], linewidth=0.9)
        plain_axes(axes, title, "steps")
    save_figure(figure, path)


def main() -> None:
    arguments = parse(__doc__, TRAINED)
    launch.prepare("cpu", 1)
    torch.set_num_threads(1)
    runs = {}
    for model in arguments.models:
        runs |= follow_all(model)
    rows = []
    for key, run in runs.items():
        degrees, *shares = run[-1]
        rows.append((*key, f"{degrees:.3f}°", *(f"{share:.3f} %" for share in shares)))
    note = "Distance from the cameras of structure from motion; places as shares of the extent."
    data = {"last": {" | ".join(key): run[-1] for key, run in runs.items()}}
    if arguments.out:
        plot(runs, arguments.out / "camera_photos.png")
    write_table("camera_photos", arguments.out, HEADERS, rows, note, data)


if __name__ == "__main__":
    main()
