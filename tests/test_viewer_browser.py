"""The viewer in a real browser (see browser.py): what it shows, what its controls do, and how it ends."""

import re
import socket
import time
from contextlib import contextmanager

import numpy as np
import pytest
import torch
from browser import browser_page
from commands import PATIENCE, SCENE, end, served
from torch.nn import functional

from warp_splat.camera import Camera
from warp_splat.cli import main
from warp_splat.color import to_bytes
from warp_splat.formats.exchange import load_gaussians
from warp_splat.formats.model_folder import ply_path
from warp_splat.formats.png import load_png
from warp_splat.gaussians import GaussianModel
from warp_splat.rendering.finished import make_renderer
from warp_splat.scene import load_scene
from warp_splat.viewer.browser_camera import framed

WIDTH, HEIGHT = 1000, 600
pytestmark = pytest.mark.slow  # half a minute each where WebGL runs in software
#: The picture without viser's panel, its warning that WebGL runs in software, and its axes.
CLEAR = np.ones((HEIGHT, WIDTH), bool)
CLEAR[:, -340:] = CLEAR[:210, :330] = CLEAR[-80:, :80] = False


def eventually(condition):
    """Wait for a truth, and return it."""
    until = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < until, "it did not happen"
        time.sleep(0.1)
    return found


def likeness(one, other):
    """PSNR [dB] of two pictures where nothing lies over them."""
    return 10 * np.log10(255**2 / ((one[CLEAR].astype(float) - other[CLEAR]) ** 2).mean().clip(1e-9))


@pytest.fixture(scope="module")
def scene():
    return load_scene(SCENE, resolution=2, eval=True, report=lambda line: None)


@pytest.fixture(scope="module")
def model(scene, tmp_path_factory):
    """A file of Gaussians without spherical harmonics: the points of the scene, as a training starts."""
    model = GaussianModel.from_points(scene.points, scene.colors, 0)
    model.parameters["opacities"].data += 4.0
    path = tmp_path_factory.mktemp("viewer") / "points.ply"
    model.save(path)
    return path


def open_page(page, address):
    page.goto(f"{address}/?fixedDpr=1")  # else viser draws fewer pixels where WebGL is slow
    page.get_by_text("px in").wait_for(timeout=1e3 * PATIENCE)


@contextmanager
def watched(*command):
    """Yield the page of a command with a viewer, its errors, the process, the address, and what was said so far."""
    with browser_page(WIDTH, HEIGHT) as (page, errors), served(*command) as (process, address, said):
        open_page(page, address)
        yield page, errors, process, address, said


def paused(page):
    """Pause a training."""
    page.get_by_role("button", name="Pause").click()
    page.get_by_text("paused").wait_for(timeout=1e3 * PATIENCE)


def screenshot(page, folder):
    page.screenshot(path=folder / "screenshot.png")
    return load_png(folder / "screenshot.png")


def drag(page, begin, end, steps):
    page.mouse.move(*begin)
    page.mouse.down()
    page.mouse.move(*end, steps=steps)
    page.mouse.up()


def dragged(page, folder):
    """A screenshot after a drag to the right, at rest."""
    drag(page, (300, 300), (500, 340), 10)
    page.wait_for_timeout(1000)
    return screenshot(page, folder)


def test_view(scene, model, tmp_path):
    """A screenshot at a photograph's camera agrees with our render better than the render of a camera a pixel aside.

    That bound moves with the picture's content; what may come on top of it is JPEG at quality 95 and nothing else.
    """
    shot = lambda: screenshot(page, tmp_path)  # noqa: E731
    view = scene.train[0]
    draw = make_renderer(GaussianModel.from_splats(load_gaussians(model).splats))
    camera, box = framed(view.camera, WIDTH, HEIGHT)
    wanted = to_bytes(draw(camera, False).image)
    aside = Camera(WIDTH, HEIGHT, camera.fx, camera.fy, camera.cx + 1, camera.cy, camera.rotation, camera.translation)
    level = max(likeness(to_bytes(draw(aside, False).image), wanted), 30.0)
    with watched("view", model, "-s", SCENE) as (page, errors, process, *_):
        assert f"{len(scene.points):,} Gaussians" in page.inner_text("body")
        page.get_by_role("button", name="next").click()
        eventually(lambda: likeness(shot(), wanted) > level)

        page.get_by_role("slider").press("End")
        planes = torch.from_numpy(view.image).permute(2, 0, 1)[None].float()
        planes = functional.interpolate(planes, wanted[box].shape[:2], mode="bilinear")
        overlaid = wanted.copy()
        overlaid[box] = planes[0].permute(1, 2, 0).byte()
        eventually(lambda: likeness(shot(), overlaid) > 30)
        page.get_by_role("slider").press("Home")
        eventually(lambda: likeness(shot(), wanted) > level)

        drag(page, (400, 400), (460, 420), 5)
        eventually(lambda: likeness(shot(), wanted) < 25)
        page.get_by_role("button", name="again").click()
        eventually(lambda: likeness(shot(), wanted) > level)

        page.get_by_role("combobox").first.click()
        page.get_by_role("option", name="depth").click()
        eventually(lambda: "depth" in page.get_by_text("px in").inner_text())
        depth = to_bytes(draw(camera, True).depth[..., None].repeat(1, 1, 3) / 10)
        assert likeness(shot(), wanted) < 25 and likeness(shot(), depth) < 25
        assert errors == []
        assert end(process)[0] == 0


@pytest.mark.long
def test_second_browser_busy_port_and_missing_scene(model, tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with watched("view", model, "--port", port) as (page, errors, process, address, said):
            assert f"(port {port} is taken)" in said and "Without photographs" in said
            other = page.context.browser.new_page(viewport={"width": 300, "height": 200})
            open_page(other, address)
            drag(other, (50, 150), (90, 160), 3)
            before = screenshot(page, tmp_path)
            other.close()
            drag(page, (400, 400), (460, 420), 5)
            eventually(lambda: likeness(screenshot(page, tmp_path), before) < 25)  # the first goes on
            assert errors == []
            page.close()
            assert end(process)[0] == 0


TRAINING = f"-s {SCENE} -r 8 --iterations 1000 --densify_from_iter 20 --max_gaussians 6000 --test_iterations 1".split()


@pytest.mark.long
def test_training(tmp_path):
    """Looked at, moved around in, paused, continued: the same bytes as without."""
    with watched("train", *TRAINING, "-m", tmp_path / "seen", "--viewer") as (page, errors, process, *_):
        paused(page)
        count = re.search(r"iteration ([\d,]+) of 1,000, paused", page.inner_text("body"))[1]
        before = screenshot(page, tmp_path)
        eventually(lambda: likeness(dragged(page, tmp_path), before) < 25)  # more than once, while all is a blur
        assert f"iteration {count} of 1,000, paused" in page.inner_text("body") and int(count.replace(",", "")) < 1000
        page.get_by_role("button", name="Continue").click()
        page.get_by_text("iteration 1,000 of 1,000").wait_for(timeout=1e3 * PATIENCE)
        assert errors == []
        page.close()
        said = process.communicate(timeout=PATIENCE)[0]
        assert process.returncode == 0 and "Traceback" not in said and "The viewer stays" in said, said
    assert main(["train", *TRAINING, "-m", str(tmp_path / "unseen"), "--quiet"]) == 0
    one, other = (ply_path(tmp_path / name, 1000).read_bytes() for name in ("seen", "unseen"))
    assert one == other


@pytest.mark.long
def test_interrupted_training(tmp_path):
    command = "train", *TRAINING, "--iterations", 100_000, "-m", tmp_path / "model", "--viewer"
    with watched(*command) as (page, _, process, *_):
        paused(page)
        code, said = end(process)
        assert code == 130 and "To continue after iteration" in said
