"""Bad scenes: every mistake of a user gets one sentence that names the file."""

import os
from pathlib import Path

import numpy as np
import pytest
import scene_files
from commands import SCENE
from hostile import refusal, replace
from scene_files import HEIGHT, WIDTH, load, pose, scale_axes, texture, write_blender, write_colmap, write_image

from warp_splat.scene.images import read_size, same_shape


def cut(path, keep):
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])


def colmap_case(change=lambda root: None, options=None, **written):
    """Makes a COLMAP scene, and changes it; the options that it is loaded with."""

    def make(root):
        write_colmap(root, **written)
        change(root)
        return root, options or {}

    return make


def model_case(file, change):
    return colmap_case(lambda root: change(root / "sparse" / "0" / file), binary=file.endswith("bin"))


def image_case(change, names=("a.png", "b.png", "c.png")):
    """The last of the photographs is changed."""
    return colmap_case(lambda root: change(root / "images" / names[-1]), names=names)


def file_case(name, text, source=""):
    """A folder with one file that is text."""

    def make(root):
        (root / name).write_text(text)
        return root / source, {}

    return make


def folder_case(name):
    """A folder with one that is empty."""
    return lambda root: ((root / name).mkdir() or root, {})


def plain_photos(root):
    write_image(root / "images" / "a.png", texture())
    return root, {}


def blender_case(change):
    def make(root):
        scene_files.change_json(write_blender(root), change)
        return root, {}

    return make


def frame_case(**values):
    """Values of the second frame; None removes one."""

    def change(content):
        frame = content["frames"][1]
        content["frames"][1] = {k: v for k, v in (frame | values).items() if v is not None}

    return blender_case(change)


def blind_blender(content):
    for frame in content["frames"]:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag((1, -1, -1, 1))).tolist()


def unknown_binary_model(path):
    data = bytearray(path.read_bytes())
    data[12:16] = (99).to_bytes(4, "little")
    path.write_bytes(data)


#: The axes of OpenGL in a COLMAP model: all points are behind the cameras.
BEHIND = -2 * np.array([pose(i)[0].T @ pose(i)[1] for i in range(3)])
BAD = {
    "no-source": (lambda root: (root / "nowhere", {}), ["nowhere", "found nothing"]),
    "source-is-file": (file_case("scene.txt", "x", "scene.txt"), ["scene.txt", "found a file"]),
    "plain-photos": (
        plain_photos,
        ["model (sparse/), transforms_train.json or transforms.json", "1 photographs alone", "warp-splat sfm"],
    ),
    "photos-of-phones": (
        file_case("a.heic", "x"),
        ["found none of these and no photographs", "convert its 1 files such as 'a.heic' to JPEG or PNG"],
    ),
    "model": (folder_case("point_cloud"), ["found a trained model", "folder of its scene"]),
    "resolution-0": (colmap_case(options={"resolution": 0}), ["resolution", "got 0"]),
    "resolution-absurd": (colmap_case(options={"resolution": 1_000_000}), [".png", "1000000", "-r"]),
    "eval-one-image": (
        colmap_case(options={"eval": True}, names=["only.png"]),
        ["at least 2 images", "found 1", "--eval"],
    ),
    "empty-sparse": (folder_case("sparse"), ["sparse", "found none"]),
    "no-images": (
        model_case("images.txt", lambda path: path.write_text("# none\n")),
        ["sparse/0", "registered images"],
    ),
    "missing-file": (model_case("points3D.bin", Path.unlink), ["sparse/0", "pycolmap cannot read"]),
    "missing-images": (
        colmap_case(lambda root: [(root / "images" / name).unlink() for name in ("b.png", "c.png")]),
        ["images", "2 of them cannot be found", "'b.png'"],
    ),
    "no-image-folder": (
        colmap_case(options={"images": "images_4"}),
        ["images_4", "3 of them cannot be found", "--images"],
    ),
    "cut-image": (image_case(lambda path: cut(path, 0.5)), ["c.png", "complete image"]),
    "cut-jpeg": (image_case(lambda path: cut(path, 0.7), ["a.jpg"]), ["a.jpg", "complete image", "Premature end"]),
    "empty-image": (image_case(lambda path: cut(path, 0)), ["c.png", "complete image"]),
    "not-an-image": (image_case(lambda path: path.write_text("hello")), ["c.png", "PNG"]),
    "size": (
        image_case(lambda path: write_image(path, texture(HEIGHT, WIDTH))),
        ["c.png", f"{WIDTH} x {HEIGHT}", f"{HEIGHT} x {WIDTH}"],
    ),
    "opengl-axes": (colmap_case(points=BEHIND), ["none of the 3 training cameras", "axes are probably mixed up"]),
    "empty-points": (model_case("points3D.bin", lambda path: cut(path, 0)), ["points3D.bin", "0 bytes"]),
    "garbage-text": (model_case("points3D.txt", lambda path: path.write_text("hello you\n")), ["sparse/0", "pycolmap"]),
    "unknown-model": (
        model_case("cameras.txt", lambda path: replace(path, b"PINHOLE", b"WIDE_EYE")),
        ["sparse/0", "Camera model does not exist"],
    ),
    "unknown-model-binary": (
        model_case("cameras.bin", unknown_binary_model),
        ["sparse/0", "Camera model does not exist"],
    ),
    "panorama": (
        colmap_case(camera=f"EQUIRECTANGULAR {WIDTH} {HEIGHT} {WIDTH} {HEIGHT}"),
        ["a.png", "EQUIRECTANGULAR"],
    ),
    "focal": (colmap_case(camera=f"PINHOLE {WIDTH} {HEIGHT} 40 -44 20 15"), ["a.png", "fy", "-44"]),
    "json": (file_case("transforms_train.json", '{"frames": '), ["transforms_train.json", "expected JSON"]),
    "json-list": (file_case("transforms_train.json", "[1]"), ["transforms_train.json", "key frames"]),
    "angle-missing": (blender_case(lambda content: content.pop("camera_angle_x")), ["train.json", "camera_angle_x"]),
    "angle": (blender_case(lambda content: content.update(camera_angle_x=0)), ["train.json", "between 0 and pi"]),
    "frames-missing": (blender_case(lambda content: content.pop("frames")), ["train.json", "key frames"]),
    "frames-empty": (blender_case(lambda content: content.update(frames=[])), ["train.json", "at least one frame"]),
    "path-missing": (frame_case(file_path=None), ["frame 1", "file_path"]),
    "path-number": (frame_case(file_path=3), ["frame 1", "string as file_path"]),
    "path-nowhere": (frame_case(file_path="train/r_9"), ["train.json", "1 of them cannot", "'train/r_9'"]),
    "matrix-missing": (frame_case(transform_matrix=None), ["train.json", "frame 1", "transform_matrix"]),
    "matrix-3x4": (frame_case(transform_matrix=np.eye(4)[:3].tolist()), ["frame 1", "4 x 4"]),
    "matrix-ragged": (frame_case(transform_matrix=[[1, 2], [3]]), ["frame 1", "4 x 4"]),
    "matrix-nan": (frame_case(transform_matrix=np.full((4, 4), np.nan).tolist()), ["frame 1", "finite"]),
    "matrix-sheared": (blender_case(lambda c: scale_axes(c, (1, 1, 1.2))), ["frame 0", "rotation"]),
    "matrix-mirrored": (blender_case(lambda c: scale_axes(c, (-1, 1, 1))), ["frame 0", "rotation"]),
    "matrix-zero": (blender_case(lambda c: scale_axes(c, (0, 0, 0))), ["frame 0", "rotation"]),
    "blender-opencv-axes": (blender_case(blind_blender), ["axes are probably mixed up"]),
}


@pytest.mark.parametrize(("make", "parts"), BAD.values(), ids=BAD.keys())
def test_bad_input_is_one_sentence_that_names_the_file(tmp_path, make, parts):
    source, options = make(tmp_path)
    if "transforms_test.json" in {path.name for path in tmp_path.iterdir()}:
        (tmp_path / "transforms_test.json").unlink()
    assert ". " not in refusal(lambda: load(source, **options), *parts).replace(str(tmp_path), "")


@pytest.mark.parametrize("place", [8 + 4, 8 + 4 + 32], ids=["rotation", "translation"])
def test_pose_that_is_not_finite_names_the_image(tmp_path, place):
    root = write_colmap(tmp_path, ["only.png"], binary=True)
    (root / "sparse" / "0" / "rigs.bin").unlink()  # as older COLMAPs write it: poses in images.bin
    (root / "sparse" / "0" / "frames.bin").unlink()
    path = root / "sparse" / "0" / "images.bin"
    data = bytearray(path.read_bytes())
    data[place : place + 8] = np.float64(np.nan).tobytes()
    path.write_bytes(data)
    refusal(lambda: load(root), match=r"only\.png: Camera (rotation|translation): expected finite numbers")


def test_a_name_that_is_no_utf_8_gets_a_sentence(tmp_path):
    """As in an old archive; OpenImageIO takes none."""
    refusal(lambda: read_size(tmp_path / os.fsdecode(b"caf\xe9.png")), r"caf\udce9.png", "rename the file")


def test_a_photograph_of_a_pixel_is_no_smaller_copy():
    assert same_shape((5, 8), (266, 474)) and not same_shape((1, 1), (266, 474))
    assert same_shape((4, 3), (400, 300)) and same_shape((1, 1), (3, 3))  # a mask of a few pixels


@pytest.mark.parametrize("words", [("train", "-m", "new", "-s"), ("inspect",), ("sfm", SCENE / "images")])
def test_a_loop_of_links_gets_a_sentence(tmp_path, monkeypatch, fails, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop").symlink_to("loop")
    assert "loop" in fails(*words, "loop")
