"""Pictures of a trained model: its views with their metrics, or a timed orbit."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch

from warp_splat import launch
from warp_splat.camera import Camera
from warp_splat.config import RasterOptions, RenderConfig
from warp_splat.devices import memory_explained
from warp_splat.errors import InputError
from warp_splat.evaluate import evaluate_views, write_views
from warp_splat.formats import model_folder
from warp_splat.formats.exchange import FORMATS, load_gaussians
from warp_splat.formats.png import save_png, save_video
from warp_splat.formats.splats import SplatFile
from warp_splat.gaussians import GaussianModel
from warp_splat.renderer import render as render_gaussians
from warp_splat.scene import load_scene
from warp_splat.scene.types import Scene
from warp_splat.selftest import settle_device
from warp_splat.trainer import to_bytes

ORBIT_SIZE = (980, 545)  # px
ORBIT_VIEW = (1.4, 0.9)  # horizontal and vertical field of view, rad
ORBIT_RADIUS = 5.0  # world units from the world's origin
WARM_UP, FRAMES, FPS = 10, 100, 25


def render(config: RenderConfig) -> int:
    """Render as ``config`` says; returns the process's exit code.

    Raises:
        InputError: if the model, its scene or an option is not usable.
    """
    say = (lambda *_: None) if config.quiet else print
    device = settle_device(launch.prepare(config.device, config.threads), config.device, say=say)
    folder, iteration, gaussians, trained = _open(config)
    model = GaussianModel.from_splats(gaussians.splats)
    options = options_of(trained)
    say(f"{len(model)} Gaussians from {config.model_path}, iteration {iteration}")
    without_scene = config.orbit and config.orbit_center == "origin"
    scene = None if without_scene else load_trained_scene(config.model_path, config.source_path, trained, say)
    with _memory_explained(device, model, None if config.orbit else scene):
        picture = make_picture(model.to(device), bool(trained.get("white_background")), options)
        if config.orbit:
            _orbit(picture, scene, config.orbit_output)
        elif scene:
            _write_splits(picture, scene, config, folder, iteration, len(model))
    return 0


def _memory_explained(device: torch.device, model: GaussianModel, scene: Scene | None):
    """See :func:`memory_explained`; without a scene, the images are those of an orbit."""
    views = [*scene.train, *scene.test] if scene else []
    sizes = [(view.camera.width, view.camera.height) for view in views] or [ORBIT_SIZE]
    fewer = ["trained with fewer Gaussians (--max_gaussians)", *(["on smaller images (-r)"] if scene else [])]
    elsewhere = ", or use --device cpu" if device.type == "cuda" else ""
    return memory_explained(device, model, sizes, f"render a model {' or '.join(fewer)}{elsewhere}")


def _write_splits(
    picture: Callable[[Camera], np.ndarray],
    scene: Scene,
    config: RenderConfig,
    folder: Path,
    iteration: int,
    count: int,
) -> None:
    """The views of both splits, and the metrics of those held out."""
    if scene.train and not config.skip_train:
        write_views(picture, scene.train, folder / "train" / f"ours_{iteration}")
        print(f"  train  {len(scene.train)} views in {folder / 'train' / f'ours_{iteration}'}")
    if scene.test and not config.skip_test:
        extra = {"split": "test", "gaussians": count}
        means, _ = evaluate_views(picture, scene.test, folder, "test", iteration, extra)
        print(f"  test   {len(scene.test)} views in {folder / 'test' / f'ours_{iteration}'}")
        print(f"  PSNR {means['PSNR']:.2f} dB, SSIM {means['SSIM']:.4f} in {folder / 'results.json'}")


def _open(config: RenderConfig) -> tuple[Path, int, SplatFile, dict]:
    """The folder for the images, the iteration, the Gaussians and the options of the training.

    A file of Gaussians has no folder and no training: its images go beside it, every 8th view is held out.
    """
    if not config.model_path:
        raise InputError("-m: expected the folder of a trained model; train.py prints it at its end.")
    path = Path(config.model_path)
    needs_scene = not (config.orbit and config.orbit_center == "origin")
    if is_file_of_gaussians(path) and not config.source_path and needs_scene:
        raise InputError(f"{path}: a file says nothing of cameras; name the scene with -s, or use --orbit.")
    iteration, gaussians, trained = open_model(path, config.iteration)
    if not trained and not config.orbit:
        model_folder.read_cfg_args(path)  # says what is missing
    return Path(f"{path}.renders") if is_file_of_gaussians(path) else path, iteration, gaussians, trained


def is_file_of_gaussians(path: Path) -> bool:
    """Whether this names a file of Gaussians, not the folder of a model."""
    return not path.is_dir() and path.suffix.lower() in FORMATS


def open_model(path: Path, iteration: int = -1) -> tuple[int, SplatFile, dict]:
    """The iteration, the Gaussians and the options of the training, from a model folder or a file of Gaussians.

    Of a file, the iteration is 0 and the options are those that it tells; of a folder without cfg_args there are none.

    Raises:
        InputError: if there is no such model, or it cannot be read.
    """
    if is_file_of_gaussians(path):
        gaussians = load_gaussians(path)
        return 0, gaussians, {"eval": True, "antialiasing": gaussians.antialiased}
    iteration = model_folder.find_iteration(path, iteration)
    trained = model_folder.read_cfg_args(path) if (path / "cfg_args").exists() else {}
    return iteration, load_gaussians(model_folder.ply_path(path, iteration)), trained


def options_of(trained: dict) -> RasterOptions:
    """How a model is rendered that was trained with these options."""
    return RasterOptions(
        antialiasing=bool(trained.get("antialiasing")),
        projection="ellipsoid" if trained.get("projection") == "ellipsoid" else "affine",
    )


def load_trained_scene(model_path: str, source_path: str, trained: dict, say: Callable[[str], object]) -> Scene:
    """The scene that a model was trained on, as it was loaded then.

    Args:
        model_path: the model, for messages.
        source_path: where the scene is now; empty: where it was.
        trained: options of the training.
        say: receives what there is to say.

    Raises:
        InputError: as :func:`load_scene`.
    """
    resolution = trained.get("resolution", -1)
    if not isinstance(resolution, int):
        raise InputError(f"{model_path}/cfg_args: expected a whole number as resolution, found {resolution!r}.")
    return load_scene(
        source_path or str(trained.get("source_path", "")),
        images=str(trained.get("images", "images")),
        resolution=resolution,
        white_background=bool(trained.get("white_background")),
        eval=bool(trained.get("eval")),
        report=say,
    )


def make_picture(
    model: GaussianModel, white_background: bool, options: RasterOptions
) -> Callable[[Camera], np.ndarray]:
    """A function from a camera to the model's image, [H, W, 3] uint8."""
    background = torch.full((3,), float(white_background), device=model.device)
    with torch.no_grad():
        gaussians = model.activated()

    def picture(camera: Camera) -> np.ndarray:
        with torch.no_grad():
            return to_bytes(render_gaussians(gaussians, camera, background, options).image)

    return picture


def orbit_cameras(center: np.ndarray, up: np.ndarray, start: np.ndarray, count: int) -> list[Camera]:
    """Cameras on a circle around ``center``, looking at it.

    Args:
        center: [3], world.
        up: unit vector, [3]; the circle lies in the plane across it.
        start: the first camera's place, [3]; fixes radius and height.
        count: cameras.
    """
    (width, height), fov = ORBIT_SIZE, ORBIT_VIEW
    fx, fy = 0.5 * width / np.tan(0.5 * fov[0]), 0.5 * height / np.tan(0.5 * fov[1])
    arm = start - center
    lift = np.dot(arm, up) * up
    first = arm - lift
    second = np.cross(up, first)
    cameras = []
    for angle in 2.0 * np.pi * np.arange(count) / count:
        place = center + lift + np.cos(angle) * first + np.sin(angle) * second
        forward = (center - place) / np.linalg.norm(center - place)
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        cameras.append(Camera(width, height, fx, fy, 0.5 * width, 0.5 * height, rotation, -rotation @ place))
    return cameras


def focus_point(scene: Scene) -> tuple[np.ndarray, np.ndarray, float]:
    """The point nearest to all optical axes (least squares), the cameras' mean up, their mean distance from it."""
    cameras = [view.camera for view in scene.train]
    across = [np.eye(3) - np.outer(camera.forward, camera.forward) for camera in cameras]
    center = np.linalg.lstsq(
        sum(across), sum(a @ camera.center for a, camera in zip(across, cameras, strict=True)), rcond=None
    )[0]
    up = -np.mean([camera.rotation[1] for camera in cameras], axis=0)
    distance = float(np.mean([np.linalg.norm(camera.center - center) for camera in cameras]))
    return center, up / np.linalg.norm(up), distance


def focus_orbit(scene: Scene, count: int) -> list[Camera]:
    """``count`` cameras around the point that the scene's cameras look at, level with it and as far from it as they.

    Raises:
        InputError: if there is no such point.
    """
    center, up, distance = focus_point(scene)
    first = scene.train[0].camera.center - center
    level = first - np.dot(first, up) * up
    if not (distance > 1e-6 and np.linalg.norm(level) > 1e-6 * distance):
        raise InputError("--orbit_center focus: the cameras look at no common point; use --orbit_center origin.")
    return orbit_cameras(center, up, center + distance * level / np.linalg.norm(level), count)


def _orbit(picture: Callable[[Camera], np.ndarray], scene: Scene | None, output: str) -> None:
    """Ten frames to warm up, a hundred timed; keep them if ``output`` says where."""
    if scene is None:
        up, start = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, -ORBIT_RADIUS])
        cameras = orbit_cameras(np.zeros(3), up, start, FRAMES)
    else:
        cameras = focus_orbit(scene, FRAMES)
    for camera in cameras[:WARM_UP]:
        picture(camera)
    start = time.perf_counter()
    frames = [picture(camera) for camera in cameras]
    seconds = time.perf_counter() - start
    size = f"{ORBIT_SIZE[0]} x {ORBIT_SIZE[1]}"
    print(f"{FRAMES} frames at {size} in {seconds:.2f} s: {FRAMES / seconds:.1f} frames per second")
    if not any(frame.max() != frame.min() for frame in frames):
        print("Every frame is empty: no Gaussian lies on the orbit's way; try --orbit_center focus.")
    if output:
        _keep(iter(frames), output)


def _keep(frames: Iterator[np.ndarray], output: str) -> None:
    if output.endswith(".mp4"):
        save_video(output, frames, FPS)
    else:
        folder = model_folder.prepare(output)
        for index, frame in enumerate(frames):
            save_png(folder / f"{index:05d}.png", frame)
    print(f"  frames in {output}")
