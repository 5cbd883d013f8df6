"""The page of export-html without a browser: what is embedded, and the few that stand for many."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from common import picture_of
from fake_viser import some_scene
from pages import CAMERAS, EVIL, OPTIONS, Blocks, many_splats, unpacked
from splat_files import covariances, some_splats

from warp_splat.camera import Camera
from warp_splat.cli import main
from warp_splat.evaluation.metrics import psnr
from warp_splat.export_html import pack
from warp_splat.export_html.command import make_page
from warp_splat.export_html.merge import groups, importance, merged
from warp_splat.export_html.pack import parts, shown
from warp_splat.formats.exchange import save_gaussians
from warp_splat.formats.model_folder import ply_path, write_cameras
from warp_splat.formats.splats import SplatArrays, SplatFile
from warp_splat.gaussians import GaussianModel
from warp_splat.lenses import Lens

PARTS = ["gaussians0", "gaussians1", "gaussians2", "gaussians3", "harmonics1", "harmonics2", "harmonics3"]


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
    most = 36 * 1.01 / 128  # 1/128 of the largest
    np.testing.assert_allclose(found.sh[7:9, 1:], wanted.sh[7:9, 1:], atol=most, rtol=0)
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


def test_up_is_as_coordinates_say(tmp_path):
    """Cameras that look down tell where north is."""
    save_gaussians(ply_path(tmp_path, 5), SplatFile(some_splats(9), coordinates={"origin": [0.0, 0.0, 0.0]}))
    down = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    views = [replace(view, original=replace(view.camera, rotation=down)) for view in some_scene().train]
    write_cameras(tmp_path, [], views)
    assert main(["export-html", str(tmp_path), str(tmp_path / "a.html")]) == 0
    assert json.loads(Blocks((tmp_path / "a.html").read_text()).found["scene"])["up"] == [0, -1, 0]


def test_names_of_strangers_are_text():
    text = make_page(EVIL, some_splats(3), [(EVIL, CAMERAS[0][1])], OPTIONS)
    page = Blocks(text)
    assert page.found["title"] == EVIL
    assert json.loads(page.found["scene"])["cameras"][0]["name"] == EVIL
    assert page.tags == Blocks(make_page("fine", some_splats(3), CAMERAS, OPTIONS)).tags
    assert re.search(r"content=\"default-src 'none'; script-src 'sha256-[^' ]*'; ", text)


def test_cameras_are_those_beside_the_gaussians(tmp_path, monkeypatch):
    """Of a model whose cameras were refined until another iteration; else those of the folder."""
    views, found = some_scene().train, []
    for iteration in (5, 7):
        save_gaussians(ply_path(tmp_path, iteration), SplatFile(some_splats(20)))
    write_cameras(tmp_path, [], views)
    write_cameras(ply_path(tmp_path, 5).parent, [], views[1:])
    monkeypatch.setattr("warp_splat.export_html.command.make_page", lambda *given: found.append(given[2]) or "")
    for model in (ply_path(tmp_path, 5), tmp_path):
        assert main(["export-html", str(model), str(tmp_path / "page.html")]) == 0
    assert [[name for name, _ in cameras] for cameras in found] == [[v.name for v in views[k:]] for k in (1, 0)]


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
        return picture_of(GaussianModel.from_splats(chosen))(camera)

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
    (_, camera), *_ = CAMERAS
    splats.means[0] = camera.center + 0.1 * camera.rotation[2]  # too near to be drawn
    order = importance(splats, [camera])
    away = np.linalg.norm(splats.means - camera.center, axis=1)
    seen = order > 0
    assert 100 < seen.sum() < 2900
    np.testing.assert_array_equal(np.argsort(-order[seen]), np.argsort(away[seen]))
    assert (splats.means.astype(float) @ camera.rotation[2] + camera.translation[2])[seen].min() > 0 and not seen[0]


def test_a_panorama_sees_all_around(small_chunks):
    splats = some_splats(3000)
    splats.scales[:], splats.opacities[:] = -3.0, 0.0
    splats.means[:] *= 2 / np.linalg.norm(splats.means, axis=1, keepdims=True)
    camera = Camera(40, 20, 20 / np.pi, 20 / np.pi, 20, 10, np.eye(3), np.zeros(3), lens=Lens("EQUIRECTANGULAR", ()))
    np.testing.assert_allclose(importance(splats, [camera]), importance(splats, [camera])[0], rtol=1e-5)


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
