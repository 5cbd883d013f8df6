"""Surfaces against a sphere and a plane of known depths, and of a model of Gaussians on a sphere."""

import functools
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from commands import no_space
from hostile import refusal
from scene_files import write_image
from scipy.spatial.transform import Rotation

from warp_splat import RasterOptions, rasterize
from warp_splat.camera import Camera
from warp_splat.cli import main
from warp_splat.color import from_srgb
from warp_splat.config import MeshConfig
from warp_splat.formats.exchange import save_gaussians
from warp_splat.formats.exposures import Exposures
from warp_splat.formats.files import write_bytes
from warp_splat.formats.splats import SplatArrays, SplatFile
from warp_splat.lenses import Lens
from warp_splat.meshing.command import _grid, photographed, smoothed, surface_in, without_islands
from warp_splat.meshing.fusion import Drawn, Surface, agreed, depth_of, pixel, surface_of, voxels_of
from warp_splat.meshing.stereo import _small, filled
from warp_splat.pruning.opened import Opened
from warp_splat.rendering.finished import as_photographed
from warp_splat.scene.types import Decoded, View

trimesh = pytest.importorskip("trimesh", reason="no trimesh: pip install 'warp-splat[mesh]'")
MASKED = 12  # columns of a photograph
VOXEL, VIEWS, DISTANCE = 0.08, 24, 4.0


def on_sphere(index, count):
    """Places on the unit sphere, of so many (Fibonacci's)."""
    z, angle = 1 - (2 * index + 1) / count, index * np.pi * (3 - np.sqrt(5))
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], -1)


def camera_at(index):
    """One of ``VIEWS`` around the origin, which it looks at."""
    rotation = Rotation.align_vectors([[0, 0, -1]], [on_sphere(index, VIEWS)])[0].as_matrix()
    return Camera(80, 60, 90, 95, 41, 29, rotation, np.array([0, 0, DISTANCE]))


def ball(index, radius=1.0):
    """What a camera sees of a ball around the origin: depths in closed form."""
    camera = camera_at(index)
    x, y = np.meshgrid(np.arange(80) + 0.5, np.arange(60) + 0.5)
    along = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)
    squared = (along**2).sum(-1)
    under = DISTANCE**2 - squared * (DISTANCE**2 - radius**2)
    depth = np.where(under > 0, (DISTANCE - np.sqrt(under.clip(0))) / squared, 0)
    image = np.broadcast_to(np.float32([0.2, 0.5, 0.8]), (60, 80, 3)).copy()
    return Drawn(camera, torch.from_numpy(depth.astype(np.float32)), torch.from_numpy(image))


def surface(views):
    voxels = voxels_of(views, VOXEL)
    return surface_of(voxels, views, VOXEL)


def test_a_ball():
    found = surface([ball(index) for index in range(VIEWS)])
    mesh = trimesh.Trimesh(found.vertices, found.faces, process=False)
    assert mesh.is_watertight and mesh.volume == pytest.approx(4 / 3 * np.pi, rel=0.03)  # outwards: it is positive
    assert np.abs(np.linalg.norm(found.vertices, axis=1) - 1).max() < 0.5 * VOXEL
    np.testing.assert_allclose(found.colors, np.float32([[0.2, 0.5, 0.8]]).repeat(len(found.colors), 0), atol=1e-5)


@pytest.mark.parametrize("places", [[1_300_000], [-900_000, 900_000]])
def test_balls_far_from_the_origin(places):
    """About 2^20 voxels: float32 has no more digits than these, and their surface no folds."""
    views = []
    for far in (np.array([0.0, place * VOXEL, 0.0]) for place in places):
        for view in (ball(index) for index in range(VIEWS)):
            turned = view.camera.translation - view.camera.rotation @ far
            views.append(view._replace(camera=replace(view.camera, translation=turned)))
    found = surface(views)
    middles = np.array(places)[(np.abs(found.vertices[:, 1, None] - VOXEL * np.array(places))).argmin(1)] * VOXEL
    rays = found.vertices - np.stack([0 * middles, middles, 0 * middles], 1)
    assert np.abs(np.linalg.norm(rays, axis=1) - 1).max() < VOXEL
    mesh = trimesh.Trimesh(rays, found.faces, process=False)
    assert mesh.is_winding_consistent and mesh.volume == pytest.approx(4 / 3 * np.pi * len(places), rel=0.03)


def test_scenes_that_are_too_wide_are_refused(monkeypatch):
    monkeypatch.setattr("warp_splat.meshing.command.voxels_of", lambda *_: torch.tensor([[0, 0, 0], [1 << 21, 0, 0]]))
    config = MeshConfig(model="model", output="a.ply", voxel=1.0)
    refusal(lambda: _grid(config, 1.0, [ball(0)], 1e9), "--voxel 1: it takes more than 2097152 along an axis")


def test_a_disc_is_where_rays_meet_its_plane():
    camera = Camera(64, 48, 80, 85, 30, 25, np.eye(3), np.array([0, 0, DISTANCE]))
    turn = Rotation.from_euler("xyz", [30, 40, 0], degrees=True)
    numbers = [[0, 0, 0]], turn.as_quat(scalar_first=True)[None], [[0.5, 0.5, 0.001]], [0.999], np.ones((1, 1, 3))
    disc = [torch.tensor(np.array(values), dtype=torch.float32) for values in numbers]
    depth = depth_of(rasterize(*disc, camera, options=RasterOptions(strongest=8)), camera).numpy()
    y, x = np.nonzero(depth)
    along = np.stack([(x + 0.5 - 30) / 80, (y + 0.5 - 25) / 85, np.ones(len(x))], 1)
    normal = turn.as_matrix()[:, 2]
    assert len(x) > 100
    np.testing.assert_allclose(depth[y, x], DISTANCE * normal[2] / (along @ normal), rtol=1e-3)


def patterned():
    """Views of a slanted plane with a pattern, whose depths are wrong; masked photographs; depths in closed form."""
    normal, waves = np.array([0.3, -0.2, 1.0]), np.random.default_rng(0).normal(0, 10, (2, 20))
    views, photographs, depths = [], [], []
    x, y = np.meshgrid(np.arange(96) + 0.5, np.arange(72) + 0.5)
    along = np.stack([(x - 47) / 100, (y - 37) / 100, np.ones_like(x)], -1)
    for index in range(6):
        center = 0.4 * np.array([np.cos(index), np.sin(index), 0])
        camera = Camera(96, 72, 100, 100, 47, 37, np.eye(3), -center)
        depths.append((4 - normal @ center) / (along @ normal))
        shade = np.sin((center + depths[-1][..., None] * along)[..., :2] @ waves).mean(-1, keepdims=True)
        picture = np.rint(120 + 10 * index + (150 + 10 * index) * shade).clip(0, 255)  # exposures differ
        mask = np.broadcast_to(np.arange(96) >= MASKED, (72, 96)).astype(np.uint8)
        photographs.append(SimpleNamespace(camera=camera, picture=picture.astype(np.uint8).repeat(3, 2), mask=mask))
        wrong = torch.from_numpy((depths[-1] * (0.85 + 0.05 * index)).astype(np.float32))
        views.append(Drawn(camera, wrong, torch.zeros(72, 96, 3)))
    return views, photographs, np.stack(depths)


@pytest.mark.slow
def test_photographs_tell_depths_that_the_model_does_not():
    views, photographs, truth = patterned()
    assert not any(view.depth.any() for view in agreed(views[1:3]))
    depths = np.stack([view.depth.numpy() for view in filled(views, agreed(views), photographs)])
    error = np.abs(depths / truth - 1)[depths > 0]
    assert not depths[..., :MASKED].any()
    assert (depths[..., MASKED:] > 0).mean() > 0.7 and np.quantile(error, 0.9) < 0.01 and np.median(error) < 0.003


def test_nothing_to_go_by():
    """A model without any depth, and photographs that a lens distorts."""
    views, photographs, _ = patterned()
    blank = [view._replace(depth=torch.zeros(72, 96)) for view in views]
    blank = filled(blank, agreed(blank), photographs)
    assert not any(view.depth.any() for view in blank) and np.isnan(pixel(blank))
    bent = [SimpleNamespace(camera=SimpleNamespace(lens="a lens", shutter=None))] * len(views)
    for view, wanted in zip(filled(views, agreed(views), bent), agreed(views), strict=True):
        np.testing.assert_array_equal(view.depth, wanted.depth)


@pytest.mark.slow
def test_any_number_of_threads(same_by_threads):
    views, (wrong, photographs, _) = [ball(index) for index in range(4)], patterned()
    same_by_threads(lambda: surface(agreed(views)))
    same_by_threads(lambda: [view.depth for view in filled(wrong, agreed(wrong), photographs)])


def test_depths_that_others_do_not_see():
    """Of a view that is wrong, and of one alone."""
    views = [ball(index) for index in range(VIEWS)]
    wrong = views[0]._replace(depth=torch.where(views[0].depth > 0, views[0].depth - 0.5, 0.0))
    kept = agreed([wrong, *views[1:]])
    assert not kept[0].depth.any()
    assert (kept[1].depth > 0).sum() > 0.5 * (views[1].depth > 0).sum()
    assert np.isnan(pixel(agreed(views[:1])))


def test_holes_stay_holes():
    mesh = surface([ball(0)])
    assert not trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).is_watertight
    assert (mesh.vertices @ camera_at(0).rotation[2] < 0.3).all()  # nothing behind what is seen


def closed(views):
    """With an inside."""
    voxels = voxels_of(views, VOXEL)
    box = torch.cartesian_prod(*(torch.arange(axis.min() - 1, axis.max() + 2, dtype=torch.int32) for axis in voxels.T))
    return surface_in(box, views, VOXEL, True)


@pytest.mark.parametrize("seen", [[0], [0, 5, 10, 15]])
def test_holes_are_closed(same_by_threads, seen):
    """What is seen stays where it was, and has an inside, in box and color as well; for any number of threads."""
    views = [ball(index) for index in seen]
    found = [array.numpy() for array in same_by_threads(lambda: closed(views))]
    mesh, opened = (trimesh.Trimesh(*each[:2], process=False) for each in (found, surface(views)))
    assert mesh.is_watertight and not opened.is_watertight and mesh.volume > 4
    assert trimesh.proximity.ProximityQuery(mesh).vertex(opened.vertices)[0].max() < VOXEL
    np.testing.assert_allclose(found[2], np.float32([[0.2, 0.5, 0.8]]).repeat(len(mesh.vertices), 0), atol=1e-5)


def test_a_wrong_depth_bores_into_nothing_solid():
    """Of one view, in the middle of a ball."""
    views = [ball(index) for index in range(VIEWS)]
    views[0].depth[20:40, 30:50] = DISTANCE
    found = closed(views)
    mesh = trimesh.Trimesh(found.vertices, found.faces, process=False)
    assert mesh.volume == pytest.approx(4 / 3 * np.pi, rel=0.03) and np.linalg.norm(found.vertices, axis=1).min() > 0.9


def test_the_rim_of_a_mask_is_no_texture():
    """Of a photograph of four times a view's pixels."""
    camera, picture = replace(camera_at(0), width=1024, height=1024), np.full((1024, 1024, 3), 230, np.uint8)
    y, x = np.ogrid[:1024, :1024]
    shown = SimpleNamespace(picture=picture, mask=((x - 500) ** 2 + (y - 500) ** 2 > 300**2).astype(np.uint8))
    gray = _small(Drawn(camera, torch.ones(1024, 1024), torch.zeros(1024, 1024, 3)), shown).image
    assert 0.5 < (gray > 0).float().mean() < 0.8 and (gray < 0).any()
    assert (torch.where(gray < 0, 230 / 255, gray) - 230 / 255).abs().max() < 1e-6 and gray.min() == -1


@pytest.mark.parametrize(("subdivisions", "stays"), [((4, 0), False), ((7, 3), True)])
def test_islands(subdivisions, stays):
    """One of less than 1 % of the largest one's triangles, and one that has many of its own."""
    large, small = (trimesh.creation.icosphere(count) for count in subdivisions)
    both = trimesh.util.concatenate([large, small.apply_translation([5, 0, 0])])
    found, wanted = without_islands(Surface(both.vertices, both.faces, np.zeros_like(both.vertices))), [large, both]
    assert len(found.faces) == len(wanted[stays].faces)
    assert len(found.vertices) == len(found.colors) == len(wanted[stays].vertices)


def test_a_smoothed_ball_is_as_large_and_its_hole_stays():
    ball = trimesh.creation.icosphere(5)
    ball.update_faces((ball.triangles[..., 2] < 0.5).all(1))
    ball.remove_unreferenced_vertices()
    rough = ball.vertices * np.random.default_rng(0).normal(1, 0.01, (len(ball.vertices), 1))
    found = smoothed(Surface(rough, ball.faces, np.zeros_like(rough))).vertices
    edge = np.unique(ball.edges[trimesh.grouping.group_rows(ball.edges_sorted, require_count=1)])
    np.testing.assert_array_equal(found[edge], rough[edge])
    before, after = (np.delete(np.linalg.norm(vertices, axis=1), edge) - 1 for vertices in (rough, found))
    assert len(edge) > 50 and np.std(after) < 0.5 * np.std(before) and abs(after.mean()) < 0.001


def test_colors_are_those_of_photographs_in_the_mean_exposure():
    """Where there is no mask. A photograph of another size, exposed by an affine map, and what is not exposed alike."""
    random = np.random.default_rng(0)
    image, camera = random.uniform(0.2, 0.7, (6, 8, 3)).astype(np.float32), camera_at(0).resized(8, 6)
    turn = np.eye(3) * 0.8 + 0.05
    numbers = np.float32([*(turn - np.eye(3)), [0.1] * 3]).ravel()
    exposures = Exposures("affine", 0.0, np.zeros(2, np.float32), {"a": numbers})
    exposed = as_photographed(exposures, torch.from_numpy(image), "a").numpy()
    taken = np.rint(255 * exposed.repeat(3, 0).repeat(3, 1)).astype(np.uint8)
    taken[:, 12:] += 20
    mask = np.ones(taken.shape[:2], np.uint8)
    mask[9:] = 0
    view = View("a", camera.resized(24, 18), Decoded(taken, None, mask), camera)
    found = photographed(torch.from_numpy(image), view, exposures).numpy() - image
    assert np.abs(found[:3, :4]).max() < 0.003 and not found[3:].any()
    assert np.abs(found[:3, 4:] - 20 / 255).max() < 0.003 and np.abs(exposed - image).max() > 0.01
    bright = np.full_like(taken, 255)
    brighter = exposures._replace(maps={"a": np.float32([*np.eye(3), [0.0] * 3]).ravel()})
    white = photographed(torch.full((6, 8, 3), 0.9), replace(view, photograph=Decoded(bright)), brighter)
    np.testing.assert_allclose(white, 0.9, atol=1e-6)  # not 0.1: a photograph saturates
    bent = replace(view, camera=replace(camera, lens=Lens("OPENCV", (0.1, 0.0, 0.0, 0.0))))
    assert not (photographed(torch.from_numpy(image), bent, exposures).numpy() - image).any()


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """Flat Gaussians on a ball that the embedded scene's cameras look at."""
    count, radius, center = 4000, 0.5, np.array([0, 0, 0.9])
    out = on_sphere(np.arange(count), count)
    turns = [Rotation.align_vectors([normal], [[0, 0, 1]])[0].as_quat(scalar_first=True) for normal in out]
    splats = SplatArrays(
        means=(center + radius * out).astype(np.float32),
        sh=np.ones((count, 1, 3), np.float32),
        opacities=np.full(count, 4, np.float32),
        scales=np.log(np.broadcast_to([0.02, 0.02, 0.002], (count, 3))).astype(np.float32),
        quats=np.array(turns, np.float32),
    )
    path = tmp_path_factory.mktemp("ball") / "ball.ply"
    save_gaussians(path, SplatFile(splats), lambda _: None)
    return path, radius, center


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Cameras of the embedded scene, with small gray photographs, which tell nothing."""
    folder = tmp_path_factory.mktemp("gray")
    made = json.loads(Path("assets/still_life/transforms.json").read_text())
    made |= {name: made[name] / 2 for name in ("fl_x", "fl_y", "cx", "cy")} | {"w": 132, "h": 124}
    del made["ply_file_path"]
    made["frames"] = made["frames"][::2]
    for frame in made["frames"]:
        write_image(folder / frame["file_path"], np.full((made["h"], made["w"], 3), 99, np.uint8))
    (folder / "transforms.json").write_text(json.dumps(made))
    return str(folder)


@pytest.fixture
def in_coarse_voxels(monkeypatch):
    """V-HACD takes ten seconds for two pieces at the resolution of its own."""
    pytest.importorskip("vhacdx", reason="no vhacdx: pip install 'warp-splat[mesh]'")
    coarse = functools.partialmethod(trimesh.Trimesh.convex_decomposition, resolution=10_000)
    monkeypatch.setattr(trimesh.Trimesh, "convex_decomposition", coarse)


@pytest.fixture
def meshed(model, scene, tmp_path, ran):
    """Runs the command with these options; the mesh, and what was said."""

    def run(ending, options):
        output = tmp_path / f"ball{ending}"
        said = ran("mesh", model[0], output, "-s", scene, *options.split())
        return trimesh.load(output, force="mesh"), said

    return run


@pytest.mark.parametrize("ending", [".ply", ".glb", ".obj"])
def test_the_command(model, meshed, ending):
    _, radius, center = model
    mesh, said = meshed(ending, "--voxel 0.04 --triangles 900")
    vertices = mesh.vertices * ([-1, -1, 1] if ending == ".glb" else [1, 1, 1])
    assert np.abs(np.linalg.norm(vertices - center, axis=1) - radius).max() < 0.04
    assert len(mesh.faces) <= 900 and mesh.visual.vertex_colors.shape == (len(vertices), 4)
    wanted = 255 * from_srgb(np.array(99 / 255), np.where) if ending == ".glb" else 99.0  # glTF's are in linear light
    assert np.abs(mesh.visual.vertex_colors[:, :3] - wanted).max() <= 1  # the photographs', not the model's
    assert "triangles" in said


def test_the_command_closes_holes(meshed, monkeypatch):
    """The ball has one below, where no camera is. Where it is in the world, a mesh does not tell."""
    monkeypatch.setattr(Opened, "placed", lambda self: self.file._replace(coordinates={"origin": [1.0, 2.0, 3.0]}))
    mesh, said = meshed(".ply", "--voxel 0.04 --watertight")
    assert mesh.is_watertight and "lost: where they are in the world" in said


@pytest.mark.parametrize("options", ["--triangles 200", "--watertight"])
def test_nothing_lies_outside_of_a_crop(model, meshed, options):
    low, high = np.array([-np.inf, -0.1, 0.7]), np.array([0.2, np.inf, 1.2])
    vertices = meshed(".glb", f"--voxel 0.04 {options} --crop -inf -0.1 0.7 0.2 inf 1.2")[0].vertices * [-1, -1, 1]
    assert (vertices >= low - 1e-6).all() and (vertices <= high + 1e-6).all() and len(vertices) > 50
    inner = ((vertices > low + 0.05) & (vertices < high - 0.05)).all(1)  # through the cut, cameras look at its back
    assert np.abs(np.linalg.norm(vertices[inner] - model[2], axis=1) - model[1]).max() < 0.05


def test_fewer_triangles_than_there_can_be(meshed):
    assert "triangles, the fewest that simplifying comes to" in meshed(".ply", "--voxel 0.1 --triangles 1")[1]


@pytest.mark.slow
@pytest.mark.parametrize("ending", [".obj", ".ply", ".glb"])
@pytest.mark.usefixtures("in_coarse_voxels")
def test_convex_pieces(model, meshed, tmp_path, ending):
    meshed(ending, "--triangles 400 --collision 2")
    pieces = trimesh.load(tmp_path / f"ball_collision{ending}", force="mesh").split()
    assert 1 <= len(pieces) <= 2 and all(piece.is_convex for piece in pieces)
    volume = sum(piece.volume for piece in pieces)
    assert volume == pytest.approx(4 / 3 * np.pi * model[1] ** 3, rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("full", ["ball.ply", "ball_collision.ply"])
@pytest.mark.usefixtures("in_coarse_voxels")
def test_a_full_disk_loses_no_surface(model, scene, tmp_path, monkeypatch, full):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    write = lambda path, data: (no_space if path == tmp_path / full else write_bytes)(path, data)  # noqa: E731
    monkeypatch.setattr("warp_splat.meshing.command.write_bytes", write)
    arguments = [str(model[0]), str(tmp_path / "ball.ply"), "-s", scene, "--triangles", "400", "--collision", "2"]
    assert main(["mesh", *arguments]) == 1
    assert {path.name for path in tmp_path.rglob("*.ply")} == {"ball.ply", "ball_collision.ply"}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["link.ply"], "link.ply: expected another file than the model"),
        (["ball.stl"], "expected a name that ends in .ply, .glb, .obj"),
        (["/"], "expected a name that ends in .ply, .glb, .obj"),
        (["file/ball.ply"], "expected a folder that can be written"),
        (["ball.ply", "--collision", "9999999999999999999"], "--collision: expected 0 to 1000000"),
        (["ball.ply", "--collision", "2"], "ball_collision.ply: expected the name of a file to write, found a folder"),
        (["ball.ply", "--voxel", "-1"], "--voxel: expected a finite number"),
        (["ball.ply", "--voxel", "0.005", "--memory", "0.15"], "raise it, or --memory"),
        (["ball.ply", "--watertight", "--triangles", "9"], "--triangles: simplifying would open what"),
        (["ball.ply", "--voxel", "0.0001"], "--voxel 0.0001: nothing is seen at this size"),
        (["ball.ply", "--voxel", "9", "--watertight"], "--voxel 9: nothing is seen at this size"),
        (["mesh.ply", "--memory", "1e-9"], "expected views of 16 px and more, found 0; train on larger photographs"),
    ],
)
def test_sentences(model, scene, fails, monkeypatch, tmp_path, arguments, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ball_collision.ply").mkdir()
    (tmp_path / "file").touch()
    (tmp_path / "link.ply").symlink_to(model[0])
    monkeypatch.delattr("warp_splat.meshing.command.filled")  # said before photographs are compared, which takes long
    assert said in fails("mesh", model[0], *arguments, "-s", scene)
