"""The page of export-html: what is embedded, and in a real browser: pictures against ours, the hand, strangers' names.

The browser's tests are skipped where there is none; see browser.py. Its WebGL runs in software.
"""

import base64
import gzip
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise

import numpy as np
import pytest
from browser import browser_page
from splat_files import covariances, some_splats

from warp_splat.cli import main
from warp_splat.config import RasterOptions
from warp_splat.evaluation.metrics import psnr
from warp_splat.export_html import pack
from warp_splat.export_html.command import make_page
from warp_splat.export_html.pack import parts, shown
from warp_splat.formats import model_folder
from warp_splat.formats.exchange import save_gaussians
from warp_splat.formats.png import load_png
from warp_splat.formats.splats import SplatArrays, SplatFile
from warp_splat.gaussians import GaussianModel
from warp_splat.rendering.camera_paths import orbit_cameras
from warp_splat.rendering.command import make_picture
from warp_splat.scene.types import View

EVIL = "</script><script>window.evil = 1</script><img src=x onerror='window.evil = 1'>\u2028.jpg"
OPTIONS = {"ANTIALIASED": False, "ELLIPSOID": False, "LINEAR": False, "BACKGROUND": 0.0}


class Blocks(HTMLParser):
    """The scripts of a page by id, and all tags."""

    def __init__(self, text):
        super().__init__()
        self.found, self.tags, self.open = {}, [], None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.open = dict(attrs).get("id", "program") if tag == "script" else tag

    def handle_data(self, data):
        self.found[self.open] = self.found.get(self.open, "") + data

    def handle_endtag(self, tag):
        self.open = None


def unpacked(blocks, count, coefficients):
    """The numbers of warp_splat/export_html/pack.py's tables, decoded as it says."""

    def table(name):
        found = [np.frombuffer(gzip.decompress(data), np.uint8) for id, data in blocks.items() if id.startswith(name)]
        parts = [part.reshape(-1, min(pack.CHUNK, count - k * pack.CHUNK)).T for k, part in enumerate(found)]
        return np.concatenate(parts) if parts else np.zeros((count, 0), np.uint8)

    rows = table("gaussians")
    shorts = rows[:, 12:32].copy().view("<i2").astype(np.float64)
    opacities = rows[:, 18:20].copy().view("<u2")[:, 0] / 65535
    half = shorts[:, 4:7] / 8192  # tan(angle / 4) times the axis
    norm = (half**2).sum(axis=1, keepdims=True)
    quats = np.concatenate([(1 - norm) / (1 + norm), 2 * half / (1 + norm)], axis=1)
    groups = table("harmonics").reshape(count, pack.texels(coefficients), 16)
    rest = (
        groups[:, :, :15].view(np.int8).reshape(count, -1, 5, 3)
        * (2.0 ** groups[:, :, 15].astype(np.float64) / 128)[:, :, None, None]
    )
    sh = np.concatenate([shorts[:, None, 7:10] / 256, rest.reshape(count, -1, 3)], axis=1)[:, :coefficients]
    return SplatArrays(rows[:, :12].copy().view("<f4"), sh, opacities, shorts[:, :3] / 256, quats)


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_what_is_embedded_decodes_within_the_stated_error(coefficients):
    wanted, origin = some_splats(200, coefficients), np.array([1e4, -20.0, 3.0])
    wanted.sh[7:9] *= 40.0
    wanted = wanted._replace(means=(wanted.means + origin).astype(np.float32))
    found = unpacked(parts(wanted, origin), 200, coefficients)
    offsets = wanted.means - origin
    np.testing.assert_allclose(found.means, offsets, rtol=2**-18 * 1.01, atol=0)
    np.testing.assert_allclose(found.scales, wanted.scales, atol=1.01 / 512, rtol=0)
    np.testing.assert_allclose(found.opacities, 1 / (1 + np.exp(-wanted.opacities.astype(float))), atol=1.01 / 131070)
    quats = wanted.quats.astype(np.float64) / np.linalg.norm(wanted.quats, axis=1, keepdims=True)
    chords = np.minimum(*(np.linalg.norm(found.quats - sign * quats, axis=1) for sign in (1, -1)))
    assert np.degrees(4 * np.arcsin(chords / 2)).max() < 0.025
    np.testing.assert_allclose(found.sh[:, 0], wanted.sh[:, 0], atol=1.01 / 512, rtol=0)
    small = np.abs(wanted.sh[:, 1:]).max(axis=(1, 2), initial=0) < 127 / 128
    np.testing.assert_allclose(found.sh[small, 1:], wanted.sh[small, 1:], atol=1.01 / 256, rtol=0)
    np.testing.assert_allclose(
        found.sh[7:9, 1:], wanted.sh[7:9, 1:], atol=36 * 1.01 / 128, rtol=0
    )  # 1/128 of the largest
    one, other = covariances(found._replace(means=wanted.means)), covariances(wanted)
    assert (np.abs(one - other).max(axis=(1, 2)) <= 0.01 * np.abs(other).max(axis=(1, 2))).all()


def test_coefficients_beyond_the_range_stay_finite():
    splats = some_splats(5)
    splats.sh[:] = np.float32([3e38, -3e38, 1e3])[None, None]
    found = unpacked(parts(splats, np.zeros(3)), 5, 16)
    np.testing.assert_allclose(found.sh[:, 1:], np.broadcast_to([127.0, -127, 127], (5, 15, 3)))


def test_what_cannot_be_seen_is_left_out_and_the_large_and_opaque_are_kept():
    splats = some_splats(100)
    splats.opacities[:10] = -5.6  # below 1/255
    splats.quats[10] = 0
    assert len(shown(splats).means) == 89
    splats.scales[:] = -3.0
    splats.scales[20, :2] = 1.0  # a plate
    splats.opacities[20:23] = 3.0
    np.testing.assert_array_equal(shown(splats, 3).means[0], splats.means[20])
    assert len(shown(splats, 3).means) == 3 and len(shown(splats, 1000).means) == 89


def test_names_of_strangers_are_text():
    cameras = [(EVIL, orbit_cameras(np.zeros(3), np.array([0, -1.0, 0]), np.array([0, 0, -9.0]), 1)[0])]
    text = make_page(EVIL, some_splats(3), cameras, OPTIONS)
    page = Blocks(text)
    assert page.found["title"] == EVIL
    assert json.loads(page.found["scene"])["cameras"][0]["name"] == EVIL
    assert page.tags == Blocks(make_page("fine", some_splats(3), [("fine", cameras[0][1])], OPTIONS)).tags
    assert re.search(r"content=\"default-src 'none'; script-src 'sha256-[^' ]*'; ", text)


def model(folder, splats, options=RasterOptions(), white=False, name="1.jpg", linear=False):  # noqa: B008 - frozen
    """A model folder with three cameras; (its path, a function from a camera to our picture, the cameras)."""
    cameras = orbit_cameras(np.array([0.2, 0, 0]), np.array([0, -1.0, 0]), np.array([0, 2.0, -9.0]), 3)
    cameras = [replace(camera.resized(280, 156), cx=150.0, cy=70.0) for camera in cameras]
    views = [View(name, camera, np.zeros((1, 1, 3), np.uint8), camera) for camera in cameras]
    save_gaussians(model_folder.ply_path(folder, 7), SplatFile(splats, options.antialiasing))
    model_folder.write_cameras(folder, [], views)
    settings = {"antialiasing": options.antialiasing, "projection": options.projection}
    model_folder.write_cfg_args(folder, {**settings, "white_background": white, "linear_light": linear})
    return folder, make_picture(GaussianModel.from_splats(splats), white, options, linear), cameras


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
    """What the user sees, [H, W, 3] uint8."""
    page.screenshot(path=tmp_path / "screen.png")
    return load_png(tmp_path / "screen.png")[:, :, :3]


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


def test_a_screenshot_shows_the_first_camera_and_a_drag_another_view(browser, tmp_path):
    folder, picture, cameras = model(tmp_path, some_splats(400))
    page = open_page(browser, export(folder))
    first = photographed(page, tmp_path)
    above = slice(0, int(page.locator("#bar").bounding_box()["y"]))
    assert page.inner_text("#camera") == "1.jpg (1 of 3)" and page.inner_text("#count") == "400 Gaussians"
    assert psnr(first[above], picture(cameras[0])[above]) > 45

    def after(act):
        act()
        page.wait_for_timeout(500)
        return photographed(page, tmp_path)[above]

    def drag(button="left"):
        page.mouse.move(100, 60)
        page.mouse.down(button=button)
        page.mouse.move(130, 50, steps=3)
        page.mouse.up(button=button)

    views = [first[above], after(drag), after(lambda: drag("right")), after(lambda: page.mouse.wheel(0, 300))]
    for before, now in pairwise(views):
        assert psnr(before, now) < 35
    page.click("#next")
    second = after(lambda: None)
    assert psnr(second, picture(cameras[1])[above]) > 45
    np.testing.assert_array_equal(after(lambda: page.keyboard.press("ArrowLeft")), first[above])


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
    nothing = SplatArrays(*(array[:0] for array in some_splats(1)))
    save_gaussians(tmp_path / "nothing.ply", SplatFile(nothing))
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


def test_what_cannot_be_exported_is_refused_and_an_older_page_stays(tmp_path, capsys, monkeypatch):
    folder, _, _ = model(tmp_path / "model", some_splats(20))
    target = tmp_path / "page.html"
    target.write_text("older")
    for arguments, sentence in (
        ([folder, tmp_path / "page.ply"], r"page\.ply: expected the name of a page"),
        ([tmp_path / "none.ply", target], r"none\.ply: no such file"),
        ([tmp_path, target], "is it a model folder"),
        ([folder, target, "--max_gaussians", "-1"], "--max_gaussians: expected at least 0"),
    ):
        assert main(["export-html", *map(str, arguments)]) == 1
        assert re.search(sentence, capsys.readouterr().err)
    monkeypatch.setattr("warp_splat.export_html.command.LONGEST", 100)
    assert main(["export-html", str(folder), str(target)]) == 1
    assert "use --max_gaussians" in capsys.readouterr().err
    assert target.read_text() == "older" and sorted(path.name for path in tmp_path.iterdir()) == ["model", "page.html"]
