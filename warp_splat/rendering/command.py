"""Pictures of a trained model: its views with their metrics, or frames of a camera path, as a video or timed.

With ``--bound``, how wrong each pixel of a view may be, too: colors on a logarithmic scale, and floats.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import torch
from tqdm import tqdm

from warp_splat.camera import Camera
from warp_splat.config import RenderConfig
from warp_splat.errors import InputError
from warp_splat.evaluation.alignment import where_taken
from warp_splat.evaluation.perceptual import choose_metrics
from warp_splat.evaluation.report import save_figure
from warp_splat.evaluation.views import evaluate_views, metrics_line, show_views, write_views
from warp_splat.formats import model_folder
from warp_splat.formats.files import atomic_write
from warp_splat.formats.png import save_png, save_video
from warp_splat.gaussians import GaussianModel
from warp_splat.raster.selftest import settle_device
from warp_splat.rendering.camera_paths import ORBIT_LENS, focus_orbit, origin_orbit, path_cameras, spiral_cameras
from warp_splat.rendering.finished import Finished, as_photographed
from warp_splat.rendering.popping import popping_of
from warp_splat.runtime.devices import memory_explained
from warp_splat.runtime.interrupts import later
from warp_splat.scene.types import Scene, View
from warp_splat.text import upward

SCALE = (1e-6, 1.0)  # of the colors
DPI = 100


def write_maps(name: str, find: Callable[[Camera], torch.Tensor], views: list[View], folder: Path) -> float:
    """Write ``NAME/00000.png`` and ``NAME/00000.exr`` in ``folder`` for each of ``views``, of which ``find`` finds one.

    Returns:
        The largest number of all.

    Raises:
        InputError: if a file cannot be written.
    """
    largest = 0.0
    for index, view in enumerate(views):
        values = find(view.camera).cpu().numpy()
        largest = max(largest, float(values.max()))
        save_scaled(folder / name / f"{index:05d}.png", values)
        save_exr(folder / name / f"{index:05d}.exr", values)
    return largest


def save_scaled(path: Path, values: np.ndarray) -> None:
    """Positive ``values`` [H, W] as colors, with the scale beside them."""
    with later():
        from matplotlib.figure import Figure  # noqa: PLC0415 - slow to load, only for these

    height, width = values.shape
    figure = Figure(figsize=(width / DPI + 1.0, height / DPI), dpi=DPI)
    axes = figure.add_axes((0.0, 0.0, width / (width + DPI), 1.0))
    axes.set_axis_off()
    shown = axes.imshow(values.clip(*SCALE), norm="log", vmin=SCALE[0], vmax=SCALE[1], cmap="turbo", aspect="auto")
    figure.colorbar(shown, cax=figure.add_axes(((width + 0.1 * DPI) / (width + DPI), 0.05, 0.2 * DPI / width, 0.9)))
    save_figure(figure, path)


def save_exr(path: Path, values: np.ndarray) -> None:
    """``values`` [H, W] as floats of 32 bits.

    Raises:
        InputError: if the file cannot be written.
    """
    spec = oiio.ImageSpec(values.shape[1], values.shape[0], 1, "float")
    spec.attribute("DateTime", "1970:01:01 00:00:00")  # else that of writing, and other bytes
    with atomic_write(path) as new:
        output = oiio.ImageOutput.create(str(new))
        done = output and output.open(str(new), spec) and output.write_image(values[..., None]) and output.close()
        # a disk that becomes full with the last bytes is no error of OpenImageIO's
        read = oiio.ImageBuf(str(new)).get_pixels(oiio.FLOAT) if done else None
        if not np.array_equal(read, values[..., None].astype(np.float32)):
            found = oiio.geterror() or output.geterror() or "it does not hold what was written, the disk may be full"
            raise InputError(f"{path}: it cannot be written: {found}; name another folder.")


OTHER_VIDEOS = {".avi", ".gif", ".m4v", ".mkv", ".mov", ".mpg", ".webm", ".wmv"}
WARM_UP, TIMED, FPS = 10, 100, 25  # frames of --orbit; frames per second of any video


def render_model(config: RenderConfig) -> int:
    """Render as ``config`` says; returns the process's exit code.

    Raises:
        InputError: if the model, its scene or an option is not usable.
    """
    say = (lambda *_: None) if config.quiet else print
    _check(config)
    metrics, absent = choose_metrics(config.lpips_weights)
    device = settle_device(config.device, config.threads, say=say)
    path = Path(config.model_path)
    folder = Path(f"{path}.renders") if model_folder.is_file_of_gaussians(path) else path  # of a file, beside it
    finished = Finished(path, config.iteration)
    model, iteration = GaussianModel.from_splats(finished.file.splats).arranged(), finished.iteration
    if (config.orbit or config.video) and not len(model):
        raise InputError(f"{config.model_path}: expected a Gaussian to film, found none; name another model.")
    output = config.video_output or (str(folder / f"{config.video}.mp4") if config.video else "")
    if output:  # before frames are drawn for it
        model_folder.check_place(Path(output).parent if Path(output).suffix.lower() == ".mp4" else Path(output))
    given = scene = None
    if not config.orbit or config.orbit_center == "focus":  # the timed orbit around the origin looks at no camera
        given = finished.load_scene(config.source_path, say)
        if not (config.skip_test or config.video or config.orbit) and (found := given.trained_among(path)):
            raise InputError(
                f"{config.model_path}: expected to test on photographs that were held out, found {len(found)} that "
                f"were trained on, such as {found[0]}; name the scene of then with -s, or use --skip_test."
            )
        if (scene := finished.refined(given)) is not given:
            say("The cameras are those of the model, which were refined with it.")
    options = replace(finished.options, of=config.of, tolerance=config.tolerance or None)
    say(f"{len(model)} Gaussians from {config.model_path}, iteration {iteration}")
    with _memory_explained(device, model, None if config.orbit else scene):
        picture = finished.picture(model.to(device), scene, options)
        draw, activated = finished.renderer(model, replace(options, bound=config.bound)), model.activated()
        maps = {
            "bound": lambda camera: draw(camera).bound,
            "popping": lambda camera: popping_of(activated, camera, options),
        }
        before = ["in linear light"] * finished.is_linear(scene) + ["before exposures"] * bool(finished.exposures)
        certify = partial(_certify, config, maps, f" ({', '.join(before)})" if before else "")
        if config.orbit or config.video:
            _film(picture, _cameras(config, scene), output, config)
        elif scene:
            for sentence in absent:
                say(sentence)
            train, test = [] if config.skip_train else scene.train, [] if config.skip_test else scene.test
            if not (train or test):
                print(f"Nothing to draw: {len(scene.train)} images to train on, {len(scene.test)} held out.")
            if train:
                written = folder / "train" / f"ours_{iteration}"
                count = sum(1 for _ in write_views(picture, train, written))
                print(f"  train  {count} views in {written}")
                certify(train, written)
            if test:
                extra = {"split": "test", "gaussians": len(model)}
                seen = activated, finished.background(device), options, given.extent
                finish = partial(as_photographed, finished.exposures), finished.is_linear(scene)
                where = where_taken(*seen, *finish) if scene is not given else None
                means, compared = evaluate_views(picture, test, folder, "test", iteration, extra, metrics, where)
                show_views(compared, folder, "test", iteration, say)
                print(f"  test   {len(test)} views in {folder / 'test' / f'ours_{iteration}'}")
                certify(test, folder / "test" / f"ours_{iteration}")
                print(f"  {metrics_line(means)}: {folder / 'results.json'}, pictures in {folder / 'contact_sheet.png'}")
    return 0


def _certify(config: RenderConfig, maps: Mapping[str, Callable], before: str, views: list[View], folder: Path):
    """Write how wrong pixels may be, and how much another order may change them, if asked for; ``before`` what else."""
    what = {"ideal": "what its Gaussians say", "trained": "what was trained"}[config.of]
    sentences = {
        "bound": f"no pixel is farther from {what} than",
        "popping": "another order of Gaussians that overlap in depth changes no pixel by more than",
    }
    for name, find in maps.items() if config.bound else ():
        print(f"  {sentences[name]} {upward(write_maps(name, find, views, folder))}{before}: {folder / name}")


def _check(config: RenderConfig) -> None:
    if config.orbit and config.video:
        raise InputError(f"--orbit, --video {config.video}: expected one of them; leave the other out.")
    if config.video_output and not (config.orbit or config.video):
        raise InputError(f"--video_output {config.video_output}: expected --video or --orbit beside it.")
    if config.bound and (config.orbit or config.video):
        raise InputError("--bound: expected views of a scene, got a video or --orbit; leave one of them out.")
    if config.of != RenderConfig.of and not (config.bound or config.tolerance):
        raise InputError(f"--of {config.of}: expected --tolerance or --bound beside it.")
    if config.frames != RenderConfig.frames and not config.video:
        raise InputError(f"--frames {config.frames}: expected --video beside it.")
    if config.orbit_center and not (config.orbit or config.video == "orbit"):
        raise InputError(f"--orbit_center {config.orbit_center}: expected --orbit or --video orbit beside it.")
    if (suffix := Path(config.video_output).suffix.lower()) in OTHER_VIDEOS:
        raise InputError(f"--video_output {config.video_output}: expected .mp4 or a folder, found {suffix}; rename it.")
    if not config.model_path:
        raise InputError("-m: expected the folder of a trained model; train.py prints it at its end.")


def _memory_explained(device: torch.device, model: GaussianModel, scene: Scene | None):
    """See :func:`memory_explained`; without a scene, the images are those of an orbit."""
    cameras = [view.camera for view in (*scene.train, *scene.test)] if scene else [ORBIT_LENS]
    fewer = ["trained with fewer Gaussians (--max_gaussians)", *(["on smaller images (-r)"] if scene else [])]
    elsewhere = ", or use --device cpu" if device.type == "cuda" else ""
    return memory_explained(device, model, cameras, f"render a model {' or '.join(fewer)}{elsewhere}")


def _cameras(config: RenderConfig, scene: Scene | None) -> list[Camera]:
    """Those of ``--orbit`` or of ``--video``; a video has the size and the focal lengths of the first photograph."""
    if scene is None:
        return origin_orbit(TIMED)
    if config.orbit:
        return focus_orbit(scene, TIMED)
    lens = scene.train[0].camera
    if config.video == "orbit" and config.orbit_center == "origin":
        return origin_orbit(config.frames, lens)
    make = {"orbit": focus_orbit, "spiral": spiral_cameras, "path": path_cameras}[config.video]
    return make(scene, config.frames, lens)


def _film(picture: Callable[[Camera], np.ndarray], cameras: list[Camera], output: str, config: RenderConfig) -> None:
    """Render a frame from each camera and keep it, if ``output`` says where; ``--orbit`` times them before."""
    if config.orbit:
        for camera in cameras[:WARM_UP]:
            picture(camera)
        start = time.perf_counter()
        rendered = [picture(camera) for camera in cameras]
        seconds = time.perf_counter() - start
        size = f"{cameras[0].width} x {cameras[0].height}"
        print(f"{len(rendered)} frames at {size} in {seconds:.2f} s: {len(rendered) / seconds:.1f} frames per second")
    else:
        rendered = map(picture, tqdm(cameras, disable=config.quiet, unit="frame"))
    frames = _watched(rendered)
    if Path(output).suffix.lower() == ".mp4":
        save_video(output, frames, FPS)
    elif output:
        folder = model_folder.prepare_folder(output)
        for index, frame in enumerate(frames):
            save_png(folder / f"{index:05d}.png", frame)
        if (older := len(list(folder.glob("[0-9]" * 5 + ".png"))) - len(cameras)) > 0:
            print(f"Warning: {older} older frames are in {folder}, too.")
    else:
        list(frames)
    if output:
        print(f"  frames in {output}")


def _watched(frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """The same frames; says so if all of them were empty."""
    contrast = 0
    for frame in frames:
        contrast = max(contrast, int(frame.max()) - int(frame.min()))
        yield frame
    if contrast == 0:
        print("Every frame is empty: no Gaussian lies on the way; try --orbit_center focus.")
