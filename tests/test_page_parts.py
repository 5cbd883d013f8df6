"""The page of a large model: parts in the order of importance, a first picture from the first of them, fewer in motion.

The browser's tests are skipped where there is none; see browser.py.
"""

import re
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from splat_files import some_splats
from test_page import OPTIONS, Blocks, browser, export, model, open_page, photographed, pixels, unpacked  # noqa: F401

from warp_splat.config import RasterOptions
from warp_splat.evaluation.metrics import psnr
from warp_splat.export_html import command, pack
from warp_splat.export_html.command import make_page
from warp_splat.formats.splats import SplatArrays, sizes
from warp_splat.gaussians import GaussianModel
from warp_splat.rendering.camera_paths import orbit_cameras
from warp_splat.rendering.command import make_picture

CAMERAS = [("one", orbit_cameras(np.zeros(3), np.array([0, -1.0, 0]), np.array([0, 0, -9.0]), 1)[0])]
PARTS = ["gaussians0", "gaussians1", "gaussians2", "harmonics0", "harmonics1", "harmonics2"]


@pytest.fixture
def small_chunks(monkeypatch):
    """10,000 Gaussians are three parts, of which one is drawn while moving."""
    monkeypatch.setattr(pack, "CHUNK", 4096)
    monkeypatch.setattr(command, "MOST_MOVING", 4096)


def many_splats():
    splats = some_splats(10_000)
    splats.scales[:] -= 3.0
    return splats


def test_the_largest_come_first_and_neighbors_stay_neighbors(small_chunks):
    splats = many_splats()
    kept = pack.shown(splats)
    size = sizes(kept)
    for first in (4096, 8192):
        assert size[:first].min() >= size[first:].max()
    where = {tuple(mean): row for row, mean in enumerate(splats.means)}
    rows = np.array([where[tuple(mean)] for mean in kept.means])
    for first in (0, 4096, 8192):
        assert (np.diff(rows[first : first + 4096]) > 0).all()
    few = some_splats(4096)
    few.opacities[:] = 0.0
    np.testing.assert_array_equal(pack.shown(few).means, few.means)  # in one part, as they were


def test_parts_decode_to_all_gaussians(small_chunks):
    splats = pack.shown(many_splats())
    blocks = pack.parts(splats, np.zeros(3))
    assert list(blocks) == PARTS
    found = unpacked(blocks, len(splats.means), 16)
    np.testing.assert_allclose(found.means, splats.means, rtol=2**-18 * 1.01, atol=0)
    np.testing.assert_allclose(found.sh[:, 1:], splats.sh[:, 1:], atol=1.01 / 256, rtol=0)


def test_cameras_say_what_is_important(small_chunks):
    """What they see comes first; of that, what is near."""
    splats = some_splats(3000)
    splats.scales[:], splats.opacities[:] = -3.0, 0.0
    order = pack.importance(splats, [CAMERAS[0][1]])
    depths = splats.means.astype(float) @ CAMERAS[0][1].rotation[2] + CAMERAS[0][1].translation[2]
    seen = order > 0
    assert 100 < seen.sum() < 2900
    np.testing.assert_array_equal(np.argsort(-order[seen]), np.argsort(depths[seen]))
    assert (depths[seen] > 0).all()
    kept = pack.shown(splats, int(seen.sum()), [CAMERAS[0][1]])
    np.testing.assert_array_equal(kept.means, splats.means[seen])


def test_what_comes_before_the_program_is_bounded():
    """Random numbers, which do not compress: the most bytes that a first picture can need, whatever follows."""
    rng = np.random.default_rng(0)
    few = some_splats(1)
    numbers = [rng.uniform(-3, 3, (pack.CHUNK + 1000, *array.shape[1:])).astype(np.float32) for array in few]
    page = make_page("large", SplatArrays(*numbers), CAMERAS, OPTIONS)
    assert page.index("})();</script>") < 4.5e6 < len(page)
    ids = [id for id in Blocks(page).found if re.fullmatch(r"(gaussians|harmonics)\d|program", str(id))]
    assert ids == ["gaussians0", "program", "gaussians1", "harmonics0", "harmonics1"]
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


@pytest.mark.slow
def test_the_first_picture_comes_before_the_rest(small_chunks, browser, slow_server, tmp_path):  # noqa: F811
    """Of what came so far; the rest follows; in motion, only the first part is drawn; at rest, all."""
    splats = many_splats()
    folder, picture, cameras = model(tmp_path, splats)
    export(folder)
    slow_server.page = (folder / "page.html").read_bytes()
    slow_server.stop = slow_server.page.index(b"})();</script>") + len(b"})();</script>")
    page, errors, _ = browser
    errors.clear()
    page.goto(f"http://127.0.0.1:{slow_server.server_port}/", wait_until="commit")
    page.wait_for_selector("#message:not(:has-text('Loading'))", state="attached", timeout=20_000)
    assert page.inner_text("#count").startswith("4,096 of ")
    before = photographed(page, tmp_path)[: int(page.locator("#bar").bounding_box()["y"])]
    first = pack.shown(splats, 4096, cameras)
    enlarged = np.float32(np.log(len(pack.shown(splats).means) / 4096) / 8)
    ours = GaussianModel.from_splats(first._replace(sh=first.sh[:, :1], scales=first.scales + enlarged))
    assert psnr(before, make_picture(ours, False, RasterOptions())(cameras[0])[: len(before)]) > 45
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


def test_a_page_that_ends_too_early_says_so(small_chunks, browser, tmp_path):  # noqa: F811
    folder, _, _ = model(tmp_path, many_splats())
    export(folder)
    text = (folder / "page.html").read_text()
    (folder / "page.html").write_text(text[: text.index('id="harmonics1"') + 1000])
    page = open_page(browser, (folder / "page.html").as_uri())
    page.wait_for_selector("#message:has-text('ends too early')", timeout=20_000)
