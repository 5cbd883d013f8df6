"""The page of a large model: Gaussians that stand for many, of which the first picture is made, and those in motion.

The browser's tests are skipped where there is none; see browser.py.
"""

import re
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from splat_files import covariances, some_splats
from test_page import OPTIONS, Blocks, browser, export, model, open_page, photographed, pixels, unpacked  # noqa: F401

from warp_splat.config import RasterOptions
from warp_splat.evaluation.metrics import psnr
from warp_splat.export_html import command, pack
from warp_splat.export_html.command import make_page
from warp_splat.export_html.merge import groups, importance, merged
from warp_splat.formats.splats import SplatArrays
from warp_splat.gaussians import GaussianModel
from warp_splat.rendering.camera_paths import orbit_cameras
from warp_splat.rendering.command import make_picture

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
def test_the_first_picture_comes_before_the_rest(small_chunks, browser, slow_server, tmp_path):  # noqa: F811
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


def test_a_page_that_ends_too_early_says_so_and_shows_what_came(small_chunks, browser, tmp_path):  # noqa: F811
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
