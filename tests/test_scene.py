"""Scene loading against files written by hand, analytic patterns and formulas that share nothing with the loader."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
import scene_files
from commands import FOX, python
from scene_files import HEIGHT, POINTS, WIDTH, distorted_picture, load, texture, thin_prism, write_blender, write_colmap

from warp_splat import Camera, InputError
from warp_splat.scene.images import read_pixels, target_size
from warp_splat.scene.types import Scene, visible

FOX_TEST = ["0001.jpg", "0012.jpg", "0027.jpg", "0042.jpg", "0073.jpg", "0089.jpg", "0110.jpg"]


# COLMAP ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
def test_colmap_cameras_points_and_pixels(tmp_path, binary):
    scene, lines = load(write_colmap(tmp_path, ["c.png", "a.png", "b.png"], binary=binary))
    assert [view.name for view in scene.train] == ["a.png", "b.png", "c.png"]
    assert not scene.test
    assert not lines
    for view, index in zip(scene.train, (1, 2, 0), strict=True):
        camera = view.camera
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (40, 44, 22.5, 17.25)
        rotation, translation = scene_files.pose(index)
        np.testing.assert_allclose(camera.rotation, rotation, atol=1e-12)
        np.testing.assert_allclose(camera.translation, translation, atol=1e-12)
        np.testing.assert_array_equal(view.image, texture())
        assert view.original.fx == camera.fx
    np.testing.assert_array_equal(scene.points, POINTS.astype(np.float32))
    np.testing.assert_array_equal(scene.colors, scene_files.COLORS)
    assert (scene.points.dtype, scene.colors.dtype) == (np.float32, np.uint8)


def test_tracks_are_free_of_the_lens(tmp_path):
    """Keypoints where a lens with radial distortion draws the points; what was not triangulated is no track."""
    root = write_colmap(tmp_path, ["a.png"], camera=f"SIMPLE_RADIAL {WIDTH} {HEIGHT} 40 22.5 17.25 0.1")
    rotation, translation = scene_files.pose(0)
    x, y, z = rotation @ POINTS[:3].T + translation[:, None]
    slopes = np.stack([x / z, y / z], axis=1)
    keypoints = 40 * slopes * (1 + 0.1 * (slopes**2).sum(1, keepdims=True)) + [22.5, 17.25]
    path = root / "sparse" / "0" / "images.txt"
    line = " ".join(f"{u!r} {v!r} {i}" for (u, v), i in zip(keypoints.tolist(), (1, 2, -1), strict=True))
    path.write_text(path.read_text().rstrip("\n") + f"\n{line}\n")
    path = path.with_name("points3D.txt")
    rows = path.read_text().splitlines()
    path.write_text("\n".join(f"{row} 1 {i}" if i < 2 else row for i, row in enumerate(rows)) + "\n")
    found = load(root)[0].tracks["a.png"]
    assert found.ids.tolist() == [1, 2]
    np.testing.assert_allclose(found.points, POINTS[:2], atol=1e-12)
    np.testing.assert_allclose(found.slopes, slopes[:2], atol=1e-9)


def test_scenes_without_observations_have_no_tracks(tmp_path):
    assert load(write_colmap(tmp_path / "colmap"))[0].tracks == {}
    assert load(write_blender(tmp_path / "blender"), eval=True)[0].tracks == {}


def test_simple_pinhole_and_model_directly_in_sparse(tmp_path):
    scene_files.write_model(tmp_path / "sparse", ["a.png"], camera=f"SIMPLE_PINHOLE {WIDTH} {HEIGHT} 41 20 15")
    scene_files.write_image(tmp_path / "images" / "a.png", texture())
    camera = load(tmp_path)[0].train[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (41, 41, 20, 15)


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
def test_names_with_spaces_and_folders(tmp_path, binary):
    names = ["left side/my photo 1.png", "right/x.png"]
    scene, _ = load(write_colmap(tmp_path, names, binary=binary))
    assert [view.name for view in scene.train] == names


def test_largest_of_several_models(tmp_path):
    names = [f"{index}.png" for index in range(4)]
    write_colmap(tmp_path, names)
    scene_files.write_model(tmp_path / "sparse" / "small", names[:3], binary=True)
    (tmp_path / "sparse" / "0").rename(tmp_path / "sparse" / "zz")
    scene, lines = load(tmp_path)
    assert len(scene.train) == 4
    assert len(lines) == 1 and "taking sparse/zz" in lines[0]


def test_points_that_are_not_finite_are_dropped(tmp_path):
    root = write_colmap(tmp_path, binary=True)
    path = root / "sparse" / "0" / "points3D.bin"
    data = bytearray(path.read_bytes())
    data[16:24] = np.float64(np.nan).tobytes()  # x of the first point: after the count and its id
    path.write_bytes(data)
    scene, lines = load(root)
    assert len(scene.points) == len(scene.colors) == len(POINTS) - 1
    assert np.isfinite(scene.points).all()
    assert "1 of 20 points" in lines[0]


def test_smaller_images_scale_the_cameras(tmp_path):
    root = write_colmap(tmp_path, images="images_2", pixels=texture(WIDTH // 2, HEIGHT // 2))
    scene, lines = load(root, images="images_2")
    camera = scene.train[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (20, 22, 11.25, 8.625)
    assert len(lines) == 1 and "images_2" in lines[0]


@pytest.mark.parametrize("count", [2, 8, 9, 17])
def test_eval_holds_out_every_eighth(tmp_path, count):
    names = [f"{index:02}.png" for index in range(count)]
    scene, _ = load(write_colmap(tmp_path, names[::-1]), eval=True)
    assert [view.name for view in scene.test] == names[::8]
    assert [view.name for view in scene.train] == [name for name in names if name not in names[::8]]


# undistortion ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("scale", "resolution"), [(1, 1), (2, 1), (1, 2)], ids=["same-size", "half-size", "halved"])
@pytest.mark.parametrize(
    ("model", "distort", "focal", "params"),
    [
        ("SIMPLE_RADIAL", scene_files.radial, (150, 150), (-0.12,)),
        ("RADIAL", scene_files.radial, (150, 150), (0.1, -0.03)),
        ("OPENCV", scene_files.radial, (150, 156), (-0.15, 0.04, 0.002, -0.003)),
        ("OPENCV_FISHEYE", scene_files.fisheye, (110, 112), (0.02, -0.01, 0.003, 0.0)),
        ("OPENCV_FISHEYE", scene_files.fisheye, (150, 156), (0.0, 0.0, 0.0, 0.0)),
        ("SIMPLE_RADIAL_FISHEYE", scene_files.fisheye, (150, 150), (0.0,)),
        ("FULL_OPENCV", scene_files.radial, (150, 156), (-0.1, 0.03, 0.002, 0.001, -0.01, 0.02, 0.01, 0.003)),
        ("SIMPLE_RADIAL_FISHEYE", scene_files.fisheye, (150, 150), (0.02,)),
        ("RADIAL_FISHEYE", scene_files.fisheye, (150, 150), (0.02, -0.01)),
        ("THIN_PRISM_FISHEYE", thin_prism, (150, 156), (0.02, -0.01, 0.002, 0.001, 0.003, 0.0, 0.004, -0.002)),
        ("FOV", scene_files.field_of_view, (150, 156), (0.4,)),
    ],
)
def test_undistorted_image_is_the_ideal_pinhole_image(tmp_path, model, distort, focal, params, scale, resolution):
    width, height, cx, cy = 160, 120, 83.2, 58.6
    numbers = (width, height, *(focal[:1] if "RADIAL" in model else focal), cx, cy, *params)
    pixels = distorted_picture(distort, params, width // scale, height // scale, *np.array((*focal, cx, cy)) / scale)
    root = write_colmap(tmp_path, ["a.png"], pixels, camera=" ".join(map(str, (model, *numbers))))
    scene, lines = load(root, resolution=resolution)
    scene_files.check_ideal(scene.train[0], 0.65 if resolution > 1 else 0.52)  # halved, it goes through two filters
    assert any(model in line for line in lines)


def test_a_lamp_stays_where_it_is_when_linear_light_is_undistorted(tmp_path):
    """No filter that rings reaches far around what is 100,000 times as bright."""
    pixels = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    pixels[15:17, 20:23] = 65504.0
    root = write_colmap(tmp_path, ["a.exr"], pixels, camera=f"SIMPLE_RADIAL {WIDTH} {HEIGHT} 40 22.5 17.25 -0.05")
    image = load(root)[0].train[0].image
    assert 0.5 * 65504 < image.max() <= 65504 and image.min() >= 0.5
    assert np.count_nonzero(np.abs(image - 0.5).max(2) > 1e-6) <= 5 * 6


@pytest.mark.parametrize("scale", [1, 2], ids=["same-size", "half-size"])
def test_native_lenses_see_points_where_colmap_does(tmp_path, scale):
    params = (40, 44, 22.5, 17.25, -0.15, 0.04, 0.002, -0.003)
    line = f"OPENCV {WIDTH} {HEIGHT} {' '.join(map(str, params))}"
    pixels = texture(WIDTH // scale, HEIGHT // scale)
    scene, lines = load(write_colmap(tmp_path, ["a.png"], pixels, camera=line), lens="native")
    camera, (rotation, translation) = scene.train[0].camera, scene_files.pose(0)
    np.testing.assert_array_equal(scene.train[0].image, pixels)
    colmap = pycolmap.Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=params)
    wanted = colmap.img_from_cam(POINTS @ rotation.T + translation)
    found = camera.lens.distorted(POINTS @ camera.rotation.T + camera.translation)
    found = found * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    np.testing.assert_allclose(found * scale, wanted, atol=1e-9)
    inside = ((wanted >= 0) & (wanted <= [WIDTH, HEIGHT])).all(1)
    np.testing.assert_array_equal(visible(camera, POINTS), inside)
    assert 3 < inside.sum() and "models: OPENCV" in lines[-1]


def test_native_lenses_that_fold_inside_the_picture_are_refused(tmp_path):
    line = f"OPENCV {WIDTH} {HEIGHT} 40 44 22.5 17.25 -1.5 0 0 0"
    with pytest.raises(InputError, match=r"a.png: Camera lens OPENCV: expected .* fold it \d+ degrees from the axis"):
        load(write_colmap(tmp_path, ["a.png"], camera=line), lens="native")


def test_zero_distortion_changes_nothing(tmp_path):
    root = write_colmap(tmp_path, camera=f"OPENCV {WIDTH} {HEIGHT} 40 44 22.5 17.25 0 0 0 0")
    scene, lines = load(root)
    np.testing.assert_array_equal(scene.train[0].image, texture())
    assert not lines


# images ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["png", "tif"])
@pytest.mark.parametrize("channels", [1, 3])
def test_sixteen_bits_and_gray(tmp_path, suffix, channels):
    pixels = texture(channels=channels, dtype=np.uint16)
    image = load(write_colmap(tmp_path, [f"a.{suffix}"], pixels))[0].train[0].image
    assert (image.dtype, image.shape) == (np.uint8, (HEIGHT, WIDTH, 3))
    np.testing.assert_array_equal(image, np.broadcast_to(np.rint(pixels / 257.0), image.shape))


def test_sixteen_bits_survive_until_after_the_resize(tmp_path):
    pixels = np.full((HEIGHT, WIDTH, 3), 100 * 257 + 120, np.uint16)  # 100.47 of 255, dithered by its neighbors
    pixels[:, ::2] += 20  # mean 100.506: rounds up only if no column was rounded before
    image = load(write_colmap(tmp_path, ["a.png"], pixels), resolution=2)[0].train[0].image
    assert (image[:, 2:-2] == 101).all()


def test_jpeg(tmp_path):
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    pixels = np.stack([x * 4, y * 6, 60 + x + y], axis=-1).astype(np.uint8)
    write_colmap(tmp_path, ["a.jpg"], pixels)
    scene_files.write_image(tmp_path / "images" / "a.jpg", pixels, [("Compression", "jpeg:98"), ("Orientation", 6)])
    image = load(tmp_path)[0].train[0].image
    assert image.shape == pixels.shape  # as stored: not rotated by the orientation tag
    assert np.abs(image.astype(int) - pixels).mean() < 3


@pytest.mark.parametrize("white", [False, True], ids=["black", "white"])
@pytest.mark.parametrize("suffix", ["png", "tif"])
@pytest.mark.parametrize("channels", [2, 4])
def test_alpha_is_composited_on_the_background(tmp_path, white, suffix, channels):
    pixels = texture(channels=channels)
    pixels[0, :, -1], pixels[1, :, -1] = 0, 255
    root = write_colmap(tmp_path, [f"a.{suffix}"], pixels)
    image = load(root, white_background=white)[0].train[0].image
    alpha = pixels[..., -1:] / 255.0
    expected = pixels[..., :-1] * alpha + 255.0 * white * (1 - alpha)
    assert np.abs(image - expected).max() <= 0.5 + 1e-3
    unrounded = read_pixels(root / "images" / f"a.{suffix}", float(white)).color * 255
    np.testing.assert_allclose(unrounded, np.broadcast_to(expected, image.shape), atol=1e-3)


@pytest.mark.parametrize(
    ("size", "resolution", "expected"),
    [
        ((540, 960), -1, (540, 960)),
        ((1600, 7), -1, (1600, 7)),
        ((3200, 1801), -1, (1600, 900)),
        ((541, 959), 1, (541, 959)),
        ((541, 959), 2, (270, 480)),  # Python rounds halves to even, and so does the reference
        ((541, 959), 4, (135, 240)),
        ((541, 959), 8, (68, 120)),
        ((540, 960), 270, (270, 480)),
        ((1000, 333), 500, (500, 166)),
        ((4, 3), 8, (1, 1)),
    ],
)
def test_resolution_rules(size, resolution, expected):
    assert target_size(*size, resolution) == expected


def test_resize_keeps_smooth_pictures_and_scales_k(tmp_path):
    def wave(width, height):
        y, x = (np.mgrid[:height, :width] + 0.5) / (height, width)[0]
        return np.stack([127 + 100 * np.sin(4 * x), 127 + 100 * np.cos(3 * y), 127 + 60 * np.sin(5 * x * y)], axis=-1)

    root = write_colmap(tmp_path, ["a.png"], np.rint(wave(WIDTH, HEIGHT)).astype(np.uint8))
    view = load(root, resolution=2)[0].train[0]
    assert np.abs(view.image - wave(WIDTH // 2, HEIGHT // 2))[2:-2, 2:-2].max() < 2
    assert (view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy) == (20, 22, 11.25, 8.625)
    assert (view.original.width, view.original.fx) == (WIDTH, 40)


def test_resize_does_not_wrap_around_at_sharp_edges(tmp_path):
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    pixels[:, WIDTH // 2 - 1 :] = 255
    image = load(write_colmap(tmp_path, ["a.png"], pixels), resolution=2)[0].train[0].image
    edge = WIDTH // 4 - 1  # this column averages both sides
    assert image[:, :edge].max() < 40  # an overshoot below 0 would become 2xx
    assert image[:, edge + 1 :].min() > 215


# Blender -----------------------------------------------------------------------------------------


def test_blender_axes_and_intrinsics(tmp_path):
    camera = load(write_blender(tmp_path, train=1, test=0))[0].train[0].camera
    focal = 0.5 * WIDTH / np.tan(0.35)
    np.testing.assert_allclose((camera.fx, camera.fy, camera.cx, camera.cy), (focal, focal, WIDTH / 2, HEIGHT / 2))
    center = np.array((4.0, -1.0, 1.5))
    np.testing.assert_allclose(camera.center, center)
    np.testing.assert_allclose(scene_files.project(camera, [(0, 0, 0)]), [(WIDTH / 2, HEIGHT / 2)], atol=1e-9)
    (above,) = scene_files.project(camera, [(0, 0, 0.5)])  # the world's z is up, so in the image it has a smaller y
    np.testing.assert_allclose(above[0], WIDTH / 2, atol=1e-9)
    assert above[1] < HEIGHT / 2 - 2
    right = np.cross(-center, (0, 0, 1))
    (beside,) = scene_files.project(camera, [0.5 * right / np.linalg.norm(right)])
    np.testing.assert_allclose(beside, (WIDTH / 2 + 0.5 * focal / np.linalg.norm(center), HEIGHT / 2), atol=1e-9)


def test_blender_splits(tmp_path):
    root = write_blender(tmp_path, train=3, test=2)
    names = [[f"{split}/r_{i}.png" for i in range(count)] for split, count in (("train", 3), ("test", 2))]
    scene, _ = load(root)
    assert [view.name for view in scene.train] == [*names[0], *names[1]] and not scene.test
    scene, _ = load(root, eval=True)
    assert [[view.name for view in views] for views in (scene.train, scene.test)] == names


def test_blender_with_training_photographs_in_its_test_file(tmp_path, fails):
    root = write_blender(tmp_path, train=3, test=2)
    (root / "transforms_test.json").write_bytes((root / "transforms_train.json").read_bytes())
    message = fails("train", "-s", root, "-m", tmp_path / "model", "--eval")
    assert "train/r_0.png is in two; mend" in message


def test_blender_without_test_file(tmp_path):
    root = write_blender(tmp_path, train=9, test=0)
    assert len(load(root)[0].train) == 9
    scene, lines = load(root, eval=True)
    assert [view.name for view in scene.test] == ["train/r_0.png", "train/r_8.png"] and len(lines) == 1


def test_blender_points_and_background(tmp_path):
    pixels = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    root = write_blender(tmp_path, pixels=pixels)
    scene, _ = load(root, white_background=True)
    assert (scene.train[0].image == 255).all()
    assert scene.points.shape == scene.colors.shape == (100_000, 3)
    assert np.abs(scene.points).max() <= 1.3
    np.testing.assert_allclose(scene.points.mean(0), 0, atol=0.02)
    assert np.abs(scene.colors.astype(int) - 127).max() <= 1
    np.testing.assert_array_equal(scene.points, load(root)[0].points)


def test_blender_pose_with_uniform_scale(tmp_path):
    root = write_blender(tmp_path, train=1, test=0)
    expected = load(root)[0].train[0].camera
    scene_files.change_json(root, lambda content: scene_files.scale_axes(content, (1.7, 1.7, 1.7)))
    camera = load(root)[0].train[0].camera
    np.testing.assert_allclose(camera.rotation, expected.rotation, atol=1e-9)
    np.testing.assert_allclose(camera.center, expected.center, atol=1e-9)


# fox ---------------------------------------------------------------------------------------------


@pytest.mark.skipif(not (FOX / "sparse").is_dir(), reason="the fox scene is not here; WARP_SPLAT_FOX names its folder")
def test_fox():
    scene, _ = load(FOX, eval=True, resolution=4)
    assert [view.name for view in scene.test] == FOX_TEST
    assert len(scene.train) == 43
    assert scene.train[0].image.shape == (240, 135, 3)
    observations = pycolmap.Reconstruction(FOX / "sparse" / "0")
    for view in scene.train + scene.test:
        seen = [p for p in observations.find_image_with_name(view.name).points2D if p.has_point3D()]
        points = np.array([observations.point3D(p.point3D_id).xyz for p in seen])
        error = np.linalg.norm(scene_files.project(view.original, points) - [p.xy for p in seen], axis=1)
        assert error.mean() < 1


def test_import_stays_light():
    python("-c", "import sys, warp_splat.scene; sys.exit(not {'pycolmap', 'OpenImageIO'}.isdisjoint(sys.modules))")


@pytest.mark.parametrize(
    ("depth", "drawn", "expected"), [(2.0, False, 5.0 * 4.25**0.5), (20.0, False, 50.0), (2.0, True, 50.0)]
)
def test_the_extent_of_a_long_walk_is_that_of_what_it_passes(depth, drawn, expected):
    """Cameras 10 apart along x, each before a wall; what walls hide is far away, and a few points are too near.

    Each shows 2,000 points, of which the 20th nearest of the wall is 0.5 aside.
    """
    camera = Camera(100, 100, 50.0, 50.0, 50.0, 50.0, np.eye(3), np.zeros(3))
    places = np.linspace(0, 100, 11)
    views = [SimpleNamespace(camera=replace(camera, translation=np.array([-x, 0.0, 0.0]))) for x in places]
    wall = np.stack([*np.meshgrid(np.arange(-20, 120, 0.05), 0.0), np.full((1, 2800), depth)], -1).reshape(-1, 3)
    near = np.array([[x, 0.0, 0.1] for x in places])
    points = np.concatenate([wall, wall * (1, 1, 30), near]).astype(np.float32)
    scene = Scene(views, [], points, points.astype(np.uint8), random_points=drawn)
    assert scene.extent == pytest.approx(1.1 * expected, rel=1e-2)
    junk = np.repeat(near * (1, 1, 1e-5), 100, axis=0)  # right before the lens, where nothing is drawn
    crowded = replace(scene, points=np.concatenate([points, junk.astype(np.float32)]))
    assert crowded.extent == scene.extent
