"""Cameras in JSON, and lenses: against formulas that share nothing with the loader."""

import json

import numpy as np
import pytest
import scene_files
from hostile import refusal
from scene_files import HEIGHT, LENS, POINTS, WIDTH, change_json, fisheye, load, project, radial, write_transforms

from warp_splat import Lens
from warp_splat.cli import main
from warp_splat.inspect.subject import read_subject
from warp_splat.inspect.verdicts import check_loading


def test_transforms_cameras_points_and_axes(tmp_path):
    scene, lines = load(write_transforms(tmp_path, applied_transform=np.eye(4)[[1, 0, 2]].tolist()))
    assert [view.name for view in scene.train] == ["images/a.png", "images/b.png"] and not lines
    camera = scene.train[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (40, 44, 22.5, 17.25)
    np.testing.assert_allclose(camera.center, (4.0, -1.0, 1.5))  # as in the file: applied_transform is not undone
    np.testing.assert_allclose(project(camera, [(0, 0, 0)]), [(22.5, 17.25)], atol=1e-9)
    assert project(camera, [(0, 0, 0.5)])[0, 1] < 15  # the world's z is up
    np.testing.assert_array_equal(scene.points, POINTS.astype(np.float32))
    np.testing.assert_array_equal(scene.colors, scene_files.COLORS)


def test_transforms_intrinsics_of_frames_go_before_those_of_the_file(tmp_path):
    root = write_transforms(tmp_path, frame=lambda index: {"fl_x": 50.0, "fl_y": 51.0, "cx": 20} if index else {})
    cameras = [view.camera for view in load(root)[0].train]
    assert [(c.fx, c.fy, c.cx, c.cy) for c in cameras] == [(40, 44, 22.5, 17.25), (50, 51, 20, 17.25)]


def test_a_frame_with_a_focal_length_of_its_own_takes_none_of_the_file(tmp_path):
    """That of y none of y."""
    own = [{}, {"camera_angle_x": 1.0}, {"fl_x": 50.0}, {"fl_y": 50.0}, {"fl_x": None, "latlong": None}]
    own.append({"camera_angle_y": 0.5})  # beside a focal length of x, that of y counts
    names = [f"{name}.png" for name in "abcdef"]
    scene, _ = load(write_transforms(tmp_path, names, frame=lambda index: own[index], p1=None, train_filenames=None))
    found = [value for view in scene.train for value in (view.camera.fx, view.camera.fy)]
    assert found == pytest.approx([40, 44, *[0.5 * WIDTH / np.tan(0.5)] * 2, 50, 50, 40, 50, 40, 44, 40, 44])


@pytest.mark.parametrize("fisheye", [True, 1])
def test_a_fisheye_of_instant_ngp(tmp_path, fisheye):
    (view, *_) = load(write_transforms(tmp_path, is_fisheye=fisheye), lens="native")[0].train
    assert view.camera.lens.model == "OPENCV_FISHEYE"


def test_transforms_angles_of_both_axes(tmp_path):
    root = write_transforms(tmp_path, camera_angle_x=1.0, camera_angle_y=0.8)
    content = json.loads((root / "transforms.json").read_text())
    for known, fy in (({"fl_x": 50.0, "fl_y": 51.0}, 51.0), ({"fl_x": 50.0}, 50.0), ({}, 0.5 * HEIGHT / np.tan(0.4))):
        kept = {key: value for key, value in content.items() if not key.startswith("fl_")}
        (root / "transforms.json").write_text(json.dumps(kept | known))
        camera = load(root)[0].train[0].camera
        assert (camera.fx, camera.fy) == pytest.approx((known.get("fl_x", 0.5 * WIDTH / np.tan(0.5)), fy))


def test_transforms_sizes_twice_those_of_the_files(tmp_path):
    camera = load(write_transforms(tmp_path, w=2 * WIDTH, h=2 * HEIGHT))[0].train[0].camera
    assert (camera.width, camera.fx, camera.fy, camera.cx, camera.cy) == (WIDTH, 20, 22, 11.25, 8.625)


def test_transforms_with_a_byte_order_mark(tmp_path):
    path = write_transforms(tmp_path) / "transforms.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert len(load(tmp_path)[0].train) == 2


def test_a_frame_has_its_own_distortion(tmp_path):
    shared = [-0.1, 0.02, 0, 0, 0.001, -0.002]
    of_frame = lambda index: {"k1": 0.05, "k2": 0, "p1": 0, "p2": 0} if index else {}  # noqa: E731
    views = load(write_transforms(tmp_path, frame=of_frame, distortion_params=shared), lens="native")[0].train
    lenses = [view.camera.lens for view in views]
    assert lenses == [Lens("OPENCV", (-0.1, 0.02, 0.001, -0.002)), Lens("OPENCV", (0.05, 0, 0, 0))]


def test_transforms_with_lists_of_names(tmp_path):
    names = [f"images/{name}.png" for name in "abcde"]
    root = write_transforms(tmp_path, names, train_filenames=[names[3], f"./{names[0]}"], val_filenames=[names[1]])
    scene, lines = load(root, eval=True)
    assert [view.name for view in scene.train] == [names[0], names[3]]
    assert [view.name for view in scene.test] == [names[1]]
    assert lines == ["Leaving out 2 of 5 images that transforms.json neither trains nor tests on."]
    assert [view.name for view in load(root)[0].train] == [names[0], names[3], names[1]]
    root = write_transforms(tmp_path, names, test_filenames=names[2:4], val_filenames=names[:1])
    scene, lines = load(root, eval=True)
    assert [view.name for view in scene.train] == [names[0], names[1], names[4]] and not lines
    assert [view.name for view in scene.test] == names[2:4]


K = ("k1", "k2", "p1", "p2", "k3")


@pytest.mark.parametrize(
    ("model", "distort", "params", "keys"),
    [
        ("OPENCV", radial, (-0.15, 0.04, 0.002, -0.003), K[:4]),
        ("OPENCV", radial, (-0.1, 0.03, 0.002, 0.001, -0.01), K),
        ("OPENCV_FISHEYE", fisheye, (0.02, -0.01, 0.003, 0.0), ("k1", "k2", "k3", "k4")),
    ],
)
def test_transforms_with_distortion(tmp_path, model, distort, params, keys):
    lens = (160, 120, 150, 156, 83.2, 58.6)
    values = dict(zip((*LENS, *keys), (*lens, *params), strict=True)) | {"camera_model": model}
    pixels = scene_files.distorted_picture(distort, params, *lens)
    scene, lines = load(write_transforms(tmp_path, ["a.png"], pixels, **values))
    scene_files.check_ideal(scene.train[0])
    assert len(lines) == 1 and "Undistorting 1 of 1" in lines[0]


FEW = {"camera_model": "OPENCV_FISHEYE", "k1": 0.02, "k2": -0.01, "k3": 0.003}


@pytest.mark.parametrize(
    ("values", "lens"),
    [
        ({"k1": -0.15, "k2": 0.04, "p1": 0.002, "p2": -0.003}, Lens("OPENCV", (-0.15, 0.04, 0.002, -0.003))),
        ({"distortion_params": [-0.15, 0.04, 0, 0, 0.002, -0.003]}, Lens("OPENCV", (-0.15, 0.04, 0.002, -0.003))),
        (FEW, Lens("OPENCV_FISHEYE", (0.02, -0.01, 0.003, 0))),
        ({"camera_model": "EQUIRECTANGULAR", "w": 64, "h": 32}, Lens("EQUIRECTANGULAR")),
    ],
)
def test_native_lenses_keep_the_pixels(tmp_path, values, lens):
    width, height = values.get("w", WIDTH), values.get("h", HEIGHT)
    pixels = scene_files.texture(width, height)
    scene, lines = load(write_transforms(tmp_path, ["a.png"], pixels, **{**LENS, **values}), lens="native")
    camera = scene.train[0].camera
    assert camera.lens == lens and (camera.width, camera.height) == (width, height)
    np.testing.assert_array_equal(scene.train[0].image, pixels)
    assert lines[0].startswith(f"Keeping 1 of 1 images as their lenses show them (models: {lens.model})")
    model = ["-m", str(tmp_path / "model")]
    assert main(["train", "-s", str(tmp_path), *model, "--lens", "native", "--iterations", "2", "--quiet"]) == 0
    assert main(["render", *model]) == 0


def test_a_photograph_with_two_frames_counts_once(tmp_path):
    names = [f"images/{letter}.png" for letter in "abcdefghi"]
    root = write_transforms(tmp_path / "a", names)
    again = lambda frames: frames.extend([{**frames[1], "file_path": "./images/a"}, frames[8]])  # noqa: E731
    change_json(root, lambda content: again(content["frames"]), "transforms.json")
    scene, lines = load(root, eval=True)
    assert [view.name for view in scene.test] == [names[0], names[8]]
    assert [view.name for view in scene.train] == names[1:8]
    assert lines[0] == "Leaving out 2 of 11 frames, whose photographs had one before: images/a, images/i.png."
    found = [finding.text for finding in check_loading(read_subject(root, "images")[0])]
    assert found == ["training would accept this scene.", lines[0]]


def broken(change=lambda content: None, **values):
    """Makes a scene, and changes its JSON."""

    def make(root):
        write_transforms(root, **values)
        change_json(root, change, "transforms.json")

    return make


def frame(index, **values):
    """A change: of one frame."""
    return broken(lambda content: content["frames"][index].update(values))


def text(content):
    """In place of a scene."""
    return lambda root: (root / "transforms.json").write_text(content)


BAD = {
    "k4": (broken(k1=0.1, k4=0.1), ["frame 0", "OPENCV", "k4 = 0.1"]),
    "fisheye-opencv": (broken(camera_model="OPENCV", is_fisheye=True), ["frame 0", "'OPENCV', is_fisheye True"]),
    "params": (broken(distortion_params=[0.1]), ["frame 0", "as a list of k1, k2, k3, k4, p1, p2, got [0.1]"]),
    "fisheye-p1": (broken(camera_model="OPENCV_FISHEYE", p1=0.1), ["frame 0", "p1 = 0.1"]),
    "model": (broken(camera_model="EQUIRECTANGULAR"), ["frame 0", "EQUIRECTANGULAR"]),
    "fisheye-text": (broken(is_fisheye="true"), ["frame 0: expected is_fisheye as true or false, got 'true'"]),
    "ftheta": (broken(ftheta_p0=0.0), ["frame 0: expected a lens without ftheta_p0, got 0.0"]),
    "latlong": (broken(latlong=True), ["frame 0: expected a lens without latlong, got True"]),
    "model-list": (broken(camera_model=[1]), ["frame 0", "camera_model"]),
    "focal": (broken(fl_x="wide"), ["frame 0: expected fl_x as a number between", "'wide'"]),
    "focal-0": (broken(fl_x=0), ["fx", "positive"]),
    "focal-large": (broken(fl_x=10**400), ["frame 0: expected fl_x", "1e+09"]),
    "size-large": (broken(w=10**9), ["frame 0: expected w as a number between -1e+09 and 1e+09, got 1000000000"]),
    "no-focal": (broken(lambda c: c.pop("fl_x")), ["frame 0", "the key fl_x or camera_angle_x"]),
    "size": (broken(w=32, h=48), ["a.png", "32 x 48", f"{WIDTH} x {HEIGHT}"]),
    "size-half": (broken(w=1.5), ["frame 0", "w and h"]),
    "frame": (broken(lambda c: c["frames"].append(5)), ["frame 2", "file_path"]),
    "outside": (frame(0, file_path="../a.png"), ["in this folder", "'../a.png'"]),
    "absolute": (frame(0, file_path="/etc/hostname"), ["'/etc/hostname'"]),
    "long": (frame(0, file_path="x" * 5000), ["1 of them cannot be found"]),
    "nul": (frame(0, file_path="a\0b/c"), ["1 of them cannot be found"]),
    "list": (broken(test_filenames=["images/c.png"]), ["'images/c.png' has no frame or is in two"]),
    "list-twice": (broken(train_filenames=["images/a.png"], val_filenames=["images/a.png"]), ["'images/a.png'"]),
    "list-all": (broken(val_filenames=["images/a.png", "images/b.png"]), ["none is left to train on"]),
    "list-odd": (broken(train_filenames="images/a.png"), ["train_filenames as a list of names", "'images/a.png'"]),
    "points": (broken(lambda c: c.update(ply_file_path="b.ply")), ["'b.ply'", "no such file"]),
    "points-outside": (broken(lambda c: c.update(ply_file_path="../b.ply")), ["in this folder"]),
    "points-number": (broken(lambda c: c.update(ply_file_path=3)), ["string as ply_file_path"]),
    "mask": (frame(1, mask_path="m.png"), ["frame 1", "the mask 'm.png'"]),
    "matrix-large": (frame(1, transform_matrix=[[10**400] * 4] * 4), ["frame 1", "4 x 4 finite"]),
    "deep": (text("[" * 100_000), ["transforms.json", "cannot be parsed"]),
    "huge": (text("[" + "[]," * 6_000_000 + "[]]"), ["transforms.json", "at most 16777216 bytes"]),
}


@pytest.mark.parametrize(("make", "parts"), BAD.values(), ids=BAD.keys())
def test_bad_transforms_are_one_sentence(tmp_path, make, parts):
    make(tmp_path)
    message = refusal(lambda: load(tmp_path), *parts)
    assert message.count("transforms.json") <= 1 and len(message) < 700 + 2 * len(str(tmp_path)), message
