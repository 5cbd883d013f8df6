"""The pictures of the documentation that no benchmark makes: ``python docs/make_pictures.py page -m output/abc123``.

The model is one that was trained on the embedded scene. ``page`` and ``viewer`` need playwright and a Chromium (see
tests/browser.py).
"""

import argparse
import json
import re
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
import renderer_pictures
import torch
import trimesh

DOCS = Path(__file__).parent
IMAGES = DOCS / "images"
sys.path[:0] = [str(DOCS.parent / folder) for folder in ("tests", "assets")]

from browser import browser_page  # noqa: E402
from scene_geometry import Patch  # noqa: E402
from scene_trace import Measure  # noqa: E402

from warp_splat.cli import main  # noqa: E402
from warp_splat.evaluation.report import new_figure, plot_training, save_figure  # noqa: E402
from warp_splat.formats.model_folder import find_iteration  # noqa: E402
from warp_splat.formats.png import load_png  # noqa: E402
from warp_splat.meshing.fusion import rays  # noqa: E402
from warp_splat.rendering.finished import Finished  # noqa: E402

PATIENCE = 180_000  # ms, on a machine without a GPU that is busy
SHOWN = 6  # frames of each video
VIEW = 6  # of those held out: its tint shows most


def sheet(model: str) -> Path:
    """The worst and the best held-out views, as training left them, smaller."""
    iteration = find_iteration(model)
    assert main(["render", "-m", model, "--skip_train", "--iteration", str(iteration)]) == 0
    return _save(load_png(Path(model) / "contact_sheet.png"), "contact_sheet.jpg")


def curves(model: str) -> Path:
    """The curves of its training, drawn again."""
    plot_training(IMAGES / "training.png", json.loads((Path(model) / "history.json").read_text()))
    return IMAGES / "training.png"


def videos(model: str) -> Path:
    """Frames of each kind of video, a row for each."""
    rows = []
    for video in ("orbit", "spiral", "path"):
        with tempfile.TemporaryDirectory() as folder:
            options = ["--video", video, "--frames", str(SHOWN * 10), "--video_output", folder]
            assert main(["render", "-m", model, *options]) == 0
            frames = sorted(Path(folder).iterdir())[5::10]
            rows.append(np.concatenate([load_png(frame) for frame in frames], axis=1))
    return _save(np.concatenate(rows), "videos.jpg")


def page(model: str) -> Path:
    """The page of ``warp-splat export-html`` at its first camera, after a drag."""
    with tempfile.TemporaryDirectory() as folder, browser_page(960, 640) as (browser, errors):
        exported = Path(folder) / "page.html"
        assert main(["export-html", model, str(exported)]) == 0
        browser.goto(exported.as_uri())
        browser.wait_for_selector("#message:empty", state="attached")
        browser.mouse.move(480, 300)
        browser.mouse.down()
        browser.mouse.move(560, 290, steps=4)
        browser.mouse.up()
        browser.wait_for_timeout(3000)  # until it is sharp
        path = IMAGES / "page.jpg"
        browser.screenshot(path=path, type="jpeg", quality=80)
        assert not errors, errors
    return path


def viewer(model: str) -> Path:
    """The page of ``warp-splat view``, at the camera of the third photograph."""
    command = [sys.executable, "-m", "warp_splat", "view", model]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            address = next(found[0] for line in server.stdout if (found := re.search(r"http://[\d.:]+", line)))
            with browser_page(1200, 675) as (page, errors):
                page.goto(f"{address}/?fixedDpr=1")
                page.get_by_text("px in").wait_for(timeout=PATIENCE)
                for _ in range(3):
                    page.get_by_role("button", name="next").click()
                page.locator(".mantine-Notification-closeButton").click()  # that WebGL runs in software here
                page.mouse.move(600, 600)
                page.wait_for_timeout(8000)  # until it is sharp
                path = IMAGES / "viewer.jpg"
                page.screenshot(path=path, type="jpeg", quality=85)
                assert not errors, errors
        finally:
            server.terminate()
    return path


def capture(plain: str, better: str) -> Path:
    """A held-out view by two models of one scene, between them its photograph."""
    folders = [Path(model) / "test" / f"ours_{find_iteration(model)}" for model in (plain, better)]
    shown = (folders[0] / "renders", folders[0] / "gt", folders[1] / "renders")
    pictures = [load_png(folder / f"{VIEW:05d}.png") for folder in shown]
    return _save(np.concatenate(pictures, axis=1), "capture.jpg")


def surface(model: str) -> Path:
    """A held-out photograph, and the surface of ``warp-splat mesh`` from its camera: bright where it faces it."""
    view = Finished(model).load_scene("", lambda _: None).evaluated[1][VIEW]
    with tempfile.TemporaryDirectory() as folder:
        assert main(["mesh", model, str(Path(folder) / "surface.ply")]) == 0
        found = trimesh.load(Path(folder) / "surface.ply", process=False)
    along = rays(view.camera, torch.device("cpu")).double().numpy()
    along /= np.linalg.norm(along, axis=2, keepdims=True)
    origins = np.broadcast_to(view.camera.center, along.shape).reshape(-1, 3)
    measure = Measure(Patch(found.vertices, found.vertex_normals, None, found.faces, None))
    distance = measure(origins, along.reshape(-1, 3)).reshape(along.shape[:2])
    points = np.where(distance > 0, distance, np.nan)[..., None] * along
    normals = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    facing = np.abs((normals * along).sum(2)) / np.linalg.norm(normals, axis=2)
    shaded = np.rint(255 * np.nan_to_num(facing, nan=1.0)).astype(np.uint8)
    return _save(np.concatenate([view.picture, shaded[..., None].repeat(3, 2)], axis=1), "surface.jpg")


def _save(picture: np.ndarray, name: str) -> Path:
    """As a JPEG file of about the width of a page."""
    height, width, _ = picture.shape
    figure = new_figure(5.0, 5.0 * height / width)
    figure.add_axes((0, 0, 1, 1)).imshow(picture, interpolation="lanczos")
    figure.axes[0].set_axis_off()
    save_figure(figure, IMAGES / name)
    return IMAGES / name


PICTURES = {
    "sheet": sheet,
    "curves": curves,
    "videos": videos,
    "page": page,
    "viewer": viewer,
    "capture": capture,
    "surface": surface,
    "renderer": partial(renderer_pictures.draw, images=IMAGES),
}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("picture", choices=PICTURES)
    parser.add_argument("-m", dest="models", nargs="+", required=True, help="folder of a trained model; capture: two")
    chosen = parser.parse_args()
    print(PICTURES[chosen.picture](*chosen.models))
