"""The page of export-html in a real browser: pictures against ours, the hand, strangers' names, slow connections.

Skipped where there is none; see browser.py. Its WebGL runs in software.
"""

import base64
import threading
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise

import numpy as np
import pytest
import torch
from browser import browser_page
from common import picture_of
from pages import EVIL, many_splats
from splat_files import some_splats

from warp_splat.cli import main
from warp_splat.config import RasterOptions
from warp_splat.evaluation.metrics import psnr
from warp_splat.export_html import pack
from warp_splat.export_html.merge import merged
from warp_splat.formats import model_folder
from warp_splat.formats.exchange import save_gaussians
from warp_splat.formats.png import load_png
from warp_splat.formats.splats import SplatArrays, SplatFile
from warp_splat.formats.stored import SH_C0
from warp_splat.gaussians import GaussianModel
from warp_splat.rendering.camera_paths import ORBIT_LENS, orbit_cameras
from warp_splat.scene.types import Decoded, View


def model(folder, splats, options=RasterOptions(), white=False, name="1.jpg", linear=False):  # noqa: B008 - frozen
    """A model folder with three cameras; (its path, a function from a camera to our picture, the cameras)."""
    cameras = orbit_cameras(np.array([0.2, 0, 0]), np.array([0, -1.0, 0]), np.array([0, 2.0, -9.0]), 3, ORBIT_LENS)
    cameras = [replace(camera.resized(280, 156), cx=150.0, cy=70.0) for camera in cameras]
    views = [View(name, camera, Decoded(np.zeros((1, 1, 3), np.uint8)), camera) for camera in cameras]
    save_gaussians(model_folder.ply_path(folder, 7), SplatFile(splats, options.antialiasing))
    model_folder.write_cameras(folder, [], views)
    settings = {"antialiasing": options.antialiasing, "projection": options.projection}
    model_folder.write_cfg_args(folder, {**settings, "white_background": white, "linear_light": linear})
    background = torch.full((3,), float(white))
    return folder, picture_of(GaussianModel.from_splats(splats), background, options, linear), cameras


def export(folder, *arguments):
    assert main(["export-html", str(folder), str(folder / "page.html"), *arguments]) == 0
    return (folder / "page.html").resolve().as_uri()


@pytest.fixture(scope="module")
def browser():
    """A page, the errors of its console, and the addresses that it asked for."""
    with browser_page(280, 156) as (page, errors):
        requests = []
        page.on("request", lambda request: requests.append(request.url))
        yield page, errors, requests


def open_page(browser, address):
    page, errors, requests = browser
    errors.clear()
    requests.clear()
    page.goto(address)
    page.wait_for_selector("#message:not(:has-text('Loading'))", state="attached", timeout=60_000)
    assert not errors
    assert {request.split(":")[0] for request in requests} <= {"file", "blob"}
    return page


PIXELS = """async (index) => {
  await warpSplat.setCamera(warpSplat.cameras[index]);
  const gl = document.getElementById("canvas").getContext("webgl2");
  const [width, height] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
  const bytes = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
  return [width, height, btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join(""))];
}"""


def pixels(page, index):
    """What the page draws for one of its cameras, [H, W, 3] uint8."""
    width, height, data = page.evaluate(PIXELS, index)
    return np.frombuffer(base64.b64decode(data), np.uint8).reshape(height, width, 4)[::-1, :, :3]


def photographed(page, tmp_path):
    """What the user sees above the bar, [H, W, 3] uint8."""
    page.screenshot(path=tmp_path / "screen.png")
    return load_png(tmp_path / "screen.png")[: int(page.locator("#bar").bounding_box()["y"]), :, :3]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("coefficients", "options", "white", "linear"),
    [
        (16, RasterOptions(), False, False),
        (9, RasterOptions(antialiasing=True), True, False),
        (4, RasterOptions(projection="ellipsoid"), False, False),
        (1, RasterOptions(), True, False),
        (4, RasterOptions(), False, True),
    ],
)
def test_pictures_agree_with_ours(browser, tmp_path, coefficients, options, white, linear):
    splats = some_splats(400, coefficients)
    splats.scales[:] -= 1.5
    splats.scales[:100] -= 2.0  # smaller than a pixel, where antialiasing matters
    folder, picture, cameras = model(tmp_path, splats, options, white, linear=linear)
    page = open_page(browser, export(folder))
    for index, camera in enumerate(cameras):
        found = pixels(page, index)
        assert psnr(found, picture(camera)) > 45
    assert found.std() > 10


@pytest.mark.slow
def test_no_pixel_at_the_rim_is_lost_to_rounded_corners(browser, tmp_path):
    """Small ones, so bright that the faintest pixel of each has five levels, and of numbers that the page can store."""
    splats = some_splats(400, 1)
    splats.means[:], splats.scales[:], splats.opacities[:] = np.round(splats.means * 64) / 64, -4.0, 2.0
    splats.quats[:], splats.sh[:] = [1, 0, 0, 0], 4.5 / SH_C0
    folder, picture, cameras = model(tmp_path, splats)
    page = open_page(browser, export(folder))
    for index, camera in enumerate(cameras):
        assert np.abs(pixels(page, index).astype(int) - picture(camera)).max() <= 1


#: Of a card whose textures, or of a browser whose canvases have so many pixels at most.
LARGEST = """
const gl = WebGL2RenderingContext.prototype, get = gl.getParameter;
if (EDGE) gl.getParameter = function (name) { return name === gl.MAX_TEXTURE_SIZE ? 140 : get.call(this, name); };
const share = (canvas) => Math.min(1, Math.sqrt(140 * 78 / 0.98 / canvas.width / canvas.height));
for (const [side, of] of EDGE ? [] : [["width", "drawingBufferWidth"], ["height", "drawingBufferHeight"]])
  Object.defineProperty(gl, of, { get() { return Math.floor(this.canvas[side] * share(this.canvas)); } });
"""


@pytest.mark.slow
@pytest.mark.parametrize("edge", ["true", "false"])
def test_a_window_larger_than_what_can_be_drawn(browser, tmp_path, edge):
    """Shows the whole picture, of fewer pixels."""
    folder, picture, cameras = model(tmp_path, some_splats(100))
    with browser[0].context.browser.new_page(viewport={"width": 280, "height": 156}) as page:
        page.add_init_script(LARGEST.replace("EDGE", edge))
        found = pixels(open_page((page, [], []), export(folder)), 0)
    assert psnr(found, picture(cameras[0].resized(140, 78))) > 45


def test_small_differences_of_depth_decide_the_order(browser, tmp_path):
    """Of layers 1e-5 apart, in front of or behind one that is far from them."""
    splats = some_splats(20, 1)
    splats.means[1:] *= 1e-4
    splats.scales[:], splats.opacities[:] = -1.0, 1.0
    folder, picture, cameras = model(tmp_path, splats)
    page = open_page(browser, export(folder))
    for index, camera in enumerate(cameras):
        assert np.abs(pixels(page, index).astype(int) - picture(camera)).max() <= 2


@pytest.mark.slow
def test_a_screenshot_shows_the_first_camera_and_a_drag_another_view(browser, tmp_path):
    folder, picture, cameras = model(tmp_path, some_splats(400))
    page = open_page(browser, export(folder))
    first = photographed(page, tmp_path)
    assert page.inner_text("#camera") == "1.jpg (1 of 3)" and page.inner_text("#count") == "400 Gaussians"
    assert psnr(first, picture(cameras[0])[: len(first)]) > 45

    def after(act):
        act()
        page.wait_for_timeout(500)
        return photographed(page, tmp_path)

    def drag(button="left"):
        page.mouse.move(100, 60)
        page.mouse.down(button=button)
        page.mouse.move(130, 50, steps=3)
        page.mouse.up(button=button)

    views = [first, after(drag), after(lambda: drag("right")), after(lambda: page.mouse.wheel(0, 300))]
    for before, now in pairwise(views):
        assert psnr(before, now) < 35
    page.click("#next")
    second = after(lambda: None)
    assert psnr(second, picture(cameras[1])[: len(second)]) > 45
    np.testing.assert_array_equal(after(lambda: page.keyboard.press("ArrowLeft")), first)


def test_two_fingers_pinch(browser, tmp_path):
    folder, _, _ = model(tmp_path, some_splats(400))
    page = open_page(browser, export(folder))
    touch = page.context.new_cdp_session(page)
    before = photographed(page, tmp_path)

    def fingers(kind, *places):
        points = [{"x": x, "y": 60, "id": index} for index, x in enumerate(places)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    fingers("touchStart", 120, 160)
    fingers("touchMove", 100, 180)
    fingers("touchMove", 60, 220)
    fingers("touchEnd")
    page.wait_for_timeout(500)
    assert psnr(before, photographed(page, tmp_path)) < 35


def test_names_of_strangers_are_text_in_a_browser(browser, tmp_path):
    folder, _, _ = model(tmp_path / "<img src=x onerror=alert(1)>", some_splats(20), name=EVIL)
    page = open_page(browser, export(folder))
    assert page.inner_text("#camera").startswith("</script><script>window.evil")
    assert page.title() == "<img src=x onerror=alert(1)>"
    assert page.evaluate("window.evil") is None


def test_an_empty_model_and_a_file_without_cameras(browser, tmp_path):
    save_gaussians(tmp_path / "nothing.ply", SplatFile(some_splats(0)))
    save_gaussians(tmp_path / "some.ply", SplatFile(some_splats(400, 1)))
    for name, message in (("nothing", "This model holds no Gaussians."), ("some", "")):
        assert main(["export-html", str(tmp_path / f"{name}.ply"), str(tmp_path / f"{name}.html")]) == 0
        page = open_page(browser, (tmp_path / f"{name}.html").as_uri())
        assert page.inner_text("#message") == message
        assert not page.is_visible("#next")
        assert (pixels(page, 0).max() > 100) == (message == "")


@pytest.mark.parametrize(
    ("lacking", "sentence"),
    [
        ("HTMLCanvasElement.prototype.getContext = () => null", "WebGL 2"),
        ("delete window.DecompressionStream", "a browser of 2023 or later"),
    ],
)
def test_an_old_browser_is_told_by_a_sentence(browser, tmp_path, lacking, sentence):
    folder, _, _ = model(tmp_path, some_splats(20))
    page, errors, _ = browser
    context = page.context.browser.new_context()
    context.add_init_script(lacking)
    address = export(folder)
    page = open_page((context.new_page(), errors, []), address)
    assert sentence in page.inner_text("#message")
    context.close()


def test_what_cannot_be_exported_is_refused_and_an_older_page_stays(tmp_path, fails, monkeypatch):
    folder, _, _ = model(tmp_path / "model", some_splats(20))
    target = tmp_path / "page.html"
    target.write_text("older")
    for arguments, sentence in (
        ([folder, tmp_path / "page.ply"], "page.ply: expected a name that ends in .html"),
        ([tmp_path / "none.ply", target], "none.ply: no such file"),
        ([tmp_path, target], "is it a model folder"),
        ([folder, target, "--max_gaussians", "-1"], "--max_gaussians: expected at least 0"),
    ):
        assert sentence in fails("export-html", *arguments)
    monkeypatch.setattr("warp_splat.export_html.command.LONGEST", 100)
    assert "use --max_gaussians" in fails("export-html", folder, target)
    assert target.read_text() == "older" and sorted(path.name for path in tmp_path.iterdir()) == ["model", "page.html"]


@pytest.fixture
def slow_server():
    """Serves ``page`` up to ``stop``, and the rest once ``more`` is set."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.end_headers()
            self.wfile.write(server.page[: server.stop])
            server.more.wait(60)
            self.wfile.write(server.page[server.stop :])

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.more = threading.Event()
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server
    server.more.set()
    server.shutdown()
    server.server_close()


MOVING = """async () => {
  const canvas = document.getElementById("canvas"), found = [];
  for (let k = 0; k < 40; k++) {
    canvas.dispatchEvent(new WheelEvent("wheel", { deltaY: 0, cancelable: true })); // moves by nothing
    await new Promise(requestAnimationFrame);
    found.push(warpSplat.times.drawn);
  }
  while (found.at(-1) === warpSplat.times.drawn) await new Promise(requestAnimationFrame);
  return [...found, warpSplat.times.drawn];
}"""


UNTIL = """async (drawn) => {
  while (warpSplat.times.drawn !== drawn) await new Promise(requestAnimationFrame);
}"""


@pytest.mark.slow
def test_the_first_picture_comes_before_the_rest(small_chunks, browser, slow_server, tmp_path):
    """Of those that stand for many, as are pictures in motion; the rest follows; at rest, all are drawn."""
    splats = many_splats()
    folder, picture, cameras = model(tmp_path, splats)
    export(folder)
    slow_server.page = (folder / "page.html").read_bytes()
    slow_server.stop = slow_server.page.index(b"})();</script>") + len(b"})();</script>")
    page, errors, _ = browser
    errors.clear()
    page.goto(f"http://127.0.0.1:{slow_server.server_port}/", wait_until="commit")
    page.wait_for_selector("#message:not(:has-text('Loading'))", state="attached", timeout=20_000)
    assert page.inner_text("#count").startswith("4,096 for ")
    before = photographed(page, tmp_path)
    _, coarse, _ = merged(pack.shown(splats), 4096, cameras)
    ours = picture_of(GaussianModel.from_splats(coarse))
    assert psnr(before, ours(cameras[0])[: len(before)]) > 45
    assert page.evaluate("document.readyState") == "loading"
    slow_server.more.set()
    for index, camera in enumerate(cameras):
        assert psnr(pixels(page, index), picture(camera)) > 45
    count = len(pack.shown(splats).means)
    assert page.inner_text("#count") == f"{count:,} Gaussians"
    assert page.evaluate("warpSplat.times.drawn") == count
    *moving, at_rest = page.evaluate(MOVING)
    assert moving[-1] == 4096 and at_rest == count
    assert moving == sorted(moving, reverse=True)  # all, then the first part
    assert not errors


def test_a_page_that_ends_too_early_says_so_and_shows_what_came(small_chunks, browser, tmp_path):
    """The first 4,096 in place of those that stood for them, and the others that stand for the rest."""
    splats = many_splats()
    folder, _, cameras = model(tmp_path, splats)
    export(folder)
    text = (folder / "page.html").read_text()
    (folder / "page.html").write_text(text[: text.index('id="gaussians2"') + 1000])
    fine, coarse, starts = merged(pack.shown(splats), 4096, cameras)
    rest = np.count_nonzero(starts < 4096)
    page = open_page(browser, (folder / "page.html").as_uri())
    page.wait_for_selector("#message:has-text('ends too early')", timeout=20_000)
    page.evaluate("document.getElementById('message').hidden = true")
    page.evaluate(UNTIL, int(8192 - rest))
    found = photographed(page, tmp_path)
    fine = fine._replace(sh=fine.sh[:, :1])
    came = [np.concatenate([few[rest:], many[:4096]]) for few, many in zip(coarse, fine, strict=True)]
    ours = picture_of(GaussianModel.from_splats(SplatArrays(*came)))(cameras[0])
    assert psnr(found, ours[: len(found)]) > 45
