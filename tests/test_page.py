"""The page of export-html: what is embedded, and in a real browser: pictures against ours, the hand, strangers' names.

The browser's tests are skipped where there is none; see browser.py. Its WebGL runs in software.
"""

import base64
import gzip
import json
import re
import threading
from dataclasses import replace
from html.parser import HTMLParser
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise

import numpy as np
import pytest
from browser import browser_page
from splat_files import covariances, some_splats

from warp_splat.cli import main
from warp_splat.config import RasterOptions
from warp_splat.evaluation.metrics import psnr
from warp_splat.export_html import command, pack
from warp_splat.export_html.command import make_page
from warp_splat.export_html.merge import groups, importance, merged
from warp_splat.export_html.pack import parts, shown
from warp_splat.formats import model_folder
from warp_splat.formats.exchange import save_gaussians
from warp_splat.formats.png import load_png
from warp_splat.formats.splats import SplatArrays, SplatFile
from warp_splat.gaussians import GaussianModel
from warp_splat.rendering.camera_paths import orbit_cameras
from warp_splat.rendering.finished import make_picture
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


def test_what_cannot_be_exported_is_refused_and_an_older_page_stays(tmp_path, fails, monkeypatch):
    folder, _, _ = model(tmp_path / "model", some_splats(20))
    target = tmp_path / "page.html"
    target.write_text("older")
    for arguments, sentence in (
        ([folder, tmp_path / "page.ply"], "page.ply: expected the name of a page"),
        ([tmp_path / "none.ply", target], "none.ply: no such file"),
        ([tmp_path, target], "is it a model folder"),
        ([folder, target, "--max_gaussians", "-1"], "--max_gaussians: expected at least 0"),
    ):
        assert sentence in fails("export-html", *arguments)
    monkeypatch.setattr("warp_splat.export_html.command.LONGEST", 100)
    assert "use --max_gaussians" in fails("export-html", folder, target)
    assert target.read_text() == "older" and sorted(path.name for path in tmp_path.iterdir()) == ["model", "page.html"]


CAMERAS = [("one", orbit_cameras(np.zeros(3), np.array([0, -1.0, 0]), np.array([0, 0, -9.0]), 1)[0])]
PARTS = ["gaussians0", "gaussians1", "gaussians2", "gaussians3", "harmonics1", "harmonics2", "harmonics3"]


@pytest.fixture
def small_chunks(monkeypatch):
    """10,000 Gaussians are three parts, after one of 4,096 that stand for them."""
    monkeypatch.setattr(pack, "CHUNK", 4096)
    monkeypatch.setattr(command, "MOST_MOVING", 4096)


def many_splats():
    splats = some_splats(10_000)
    splats.scales[:] -= 3.0
    return splats


@pytest.mark.parametrize(("total", "count"), [(1, 1), (7, 7), (1000, 1), (1000, 37), (1000, 768)])
def test_groups_are_so_many_and_hold_each_point_once(total, count):
    rng = np.random.default_rng(0)
    points, important = rng.normal(size=(total, 3)), rng.exponential(size=total) ** 4
    points[: total // 3] = 1.0  # many at one place
    order, starts = groups(points, important, count)
    np.testing.assert_array_equal(np.sort(order), np.arange(total))
    assert len(starts) == count and starts[0] == 0 and (np.diff([*starts, total]) > 0).all()


def test_groups_are_neighbors_and_smaller_where_it_is_important():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(4000, 3))
    order, starts = groups(points, np.where(points[:, 0] > 0, 1.0, 1e-4), 100)
    clouds = np.split(points[order], starts[1:])
    important = [cloud for cloud in clouds if cloud[:, 0].mean() > 0]
    assert len(important) > 80
    assert np.mean([cloud.std(axis=0).max() for cloud in important]) < 0.4


def test_groups_of_one_are_what_they_were(small_chunks):
    splats = pack.shown(some_splats(300))
    same, alone, _ = merged(splats, len(splats.means), [CAMERAS[0][1]])
    np.testing.assert_allclose(alone.means, same.means, atol=1e-5)
    np.testing.assert_allclose(alone.sh, same.sh[:, :1], atol=1e-5)
    np.testing.assert_allclose(alone.opacities, same.opacities, atol=1e-3, rtol=1e-4)
    np.testing.assert_allclose(covariances(alone), covariances(same), atol=1e-5, rtol=1e-3)


def test_a_group_has_the_mean_the_covariance_and_the_cover_of_its_members():
    """Against points drawn from the mixture."""
    rng = np.random.default_rng(0)
    splats = some_splats(5)
    splats.opacities[:] = [-3.0, -2.0, -3.0, -4.0, -2.0]
    _, matched, _ = merged(splats, 1, [])
    deviations = np.exp(splats.scales.astype(float))
    cover = deviations[:, [0, 0, 1]] * deviations[:, [1, 2, 2]]
    weights = cover.mean(axis=1) / (1 + np.exp(-splats.opacities.astype(float)))
    members = rng.choice(5, 400_000, p=weights / weights.sum())
    drawn = np.einsum("nij,nj->ni", np.linalg.cholesky(covariances(splats))[members], rng.normal(size=(400_000, 3)))
    drawn += splats.means[members]
    size = np.sqrt(np.trace(covariances(matched)[0]))
    np.testing.assert_allclose(matched.means[0], drawn.mean(axis=0), atol=0.01 * size)
    np.testing.assert_allclose(covariances(matched)[0], np.cov(drawn.T), atol=0.01 * size**2)
    np.testing.assert_allclose(matched.sh[0, 0], splats.sh[members, 0].mean(axis=0), atol=0.01)
    deviations = np.exp(matched.scales[0].astype(float))
    cover = (deviations[[0, 0, 1]] * deviations[[1, 2, 2]]).mean() / (1 + np.exp(-float(matched.opacities[0])))
    assert cover == pytest.approx(weights.sum(), rel=1e-4)


def test_numbers_out_of_range_give_finite_ones():
    splats = some_splats(100)
    splats.scales[::3], splats.scales[1::3] = 400.0, -400.0
    splats.means[:10], splats.sh[20:30], splats.quats[5] = 1e30, 3e38, 0.0
    found = merged(splats, 20, [CAMERAS[0][1]])[1]
    assert all(np.isfinite(array).all() for array in found)


def test_merged_ones_look_more_like_a_surface_than_its_most_important_ones_do():
    rng = np.random.default_rng(0)
    splats, camera = some_splats(10_000, 1), CAMERAS[0][1].resized(280, 156)
    splats.means[:, 2] = 0.1 * splats.means[:, 2] + np.sin(splats.means[:, 0])
    splats.sh[:, 0] = np.sin(splats.means) + 0.2 * rng.normal(size=(10_000, 3))
    splats.scales[:] = rng.normal(-2.5, 0.5, (10_000, 3))

    def picture(chosen):
        return make_picture(GaussianModel.from_splats(chosen), False, RasterOptions())(camera)

    everything, few = picture(splats), picture(pack.shown(splats, 1000))
    assert psnr(picture(merged(splats, 1000, [camera])[1]), everything) > 3 + psnr(few, everything)


def test_parts_decode_to_all_gaussians(small_chunks):
    splats, coarse, _ = merged(pack.shown(many_splats()), 4096, [CAMERAS[0][1]])
    blocks = pack.parts(splats, np.zeros(3), coarse)
    assert list(blocks) == PARTS
    first = {"gaussians0": blocks.pop("gaussians0")}
    np.testing.assert_allclose(unpacked(first, 4096, 1).means, coarse.means, rtol=2**-18 * 1.01, atol=0)
    found = unpacked(blocks, len(splats.means), 16)
    np.testing.assert_allclose(found.means, splats.means, rtol=2**-18 * 1.01, atol=0)
    np.testing.assert_allclose(found.sh[:, 1:], splats.sh[:, 1:], atol=1.01 / 256, rtol=0)


def test_cameras_say_what_is_important(small_chunks):
    """What they see comes first; of that, what is near."""
    splats = some_splats(3000)
    splats.scales[:], splats.opacities[:] = -3.0, 0.0
    order = importance(splats, [CAMERAS[0][1]])
    depths = splats.means.astype(float) @ CAMERAS[0][1].rotation[2] + CAMERAS[0][1].translation[2]
    seen = order > 0
    assert 100 < seen.sum() < 2900
    np.testing.assert_array_equal(np.argsort(-order[seen]), np.argsort(depths[seen]))
    assert (depths[seen] > 0).all()


@pytest.mark.slow
def test_what_comes_before_the_program_is_bounded():
    """Random numbers, which do not compress: the most bytes that a first picture can need, whatever follows."""
    rng = np.random.default_rng(0)
    few = some_splats(1)
    numbers = [rng.uniform(-3, 3, (pack.CHUNK + 1000, *array.shape[1:])).astype(np.float32) for array in few]
    page = make_page("large", SplatArrays(*numbers), CAMERAS, OPTIONS)
    assert page.index("})();</script>") < 4.5e6 < len(page)
    ids = [id for id in Blocks(page).found if re.fullmatch(r"(gaussians|harmonics)\d|program", str(id))]
    assert ids == ["gaussians0", "program", "gaussians1", "gaussians2", "harmonics1", "harmonics2"]
    ids = list(Blocks(make_page("small", some_splats(100), CAMERAS, OPTIONS)).found)
    assert ids[ids.index("gaussians0") :][:3] == ["gaussians0", "harmonics0", "program"]


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
    before = photographed(page, tmp_path)[: int(page.locator("#bar").bounding_box()["y"])]
    _, coarse, _ = merged(pack.shown(splats), 4096, cameras)
    ours = make_picture(GaussianModel.from_splats(coarse), False, RasterOptions())
    assert psnr(before, ours(cameras[0])[: len(before)]) > 45
    assert page.evaluate("document.readyState") == "loading"
    slow_server.more.set()
    for index, camera in enumerate(cameras):
        assert psnr(pixels(page, index), picture(camera)) > 45
    count = len(pack.shown(splats).means)
    assert page.inner_text("#count") == f"{count:,} Gaussians"
    assert page.evaluate("warpSplat.times.drawn") == count
    *moving, at_rest = page.evaluate(MOVING)
    assert (
        moving[-1] == 4096 and at_rest == count and moving == sorted(moving, reverse=True)
    )  # all, then the first part
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
    found = photographed(page, tmp_path)[: int(page.locator("#bar").bounding_box()["y"])]
    fine = fine._replace(sh=fine.sh[:, :1])
    came = [np.concatenate([few[rest:], many[:4096]]) for few, many in zip(coarse, fine, strict=True)]
    ours = make_picture(GaussianModel.from_splats(SplatArrays(*came)), False, RasterOptions())(cameras[0])
    assert psnr(found, ours[: len(found)]) > 45
