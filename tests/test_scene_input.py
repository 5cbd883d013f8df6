"""Bad scenes: every mistake of a user gets one sentence that names the file."""

from pathlib import Path

import numpy as np
import pytest
from scene_files import (
    HEIGHT,
    WIDTH,
    change_json,
    load,
    pose,
    scale_axes,
    texture,
    write_blender,
    write_colmap,
    write_image,
    write_model,
)

from warp_splat.errors import InputError


def cut(path, keep):
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])


def replace(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def colmap_case(change, binary=False, **options):
    def make(root):
        write_colmap(root, binary=binary)
        change(root)
        return root, options

    return make


def model_case(file, change, binary=False):
    return colmap_case(lambda root: change(root / "sparse" / "0" / file), binary)


def camera_case(camera):
    def make(root):
        return write_colmap(root, camera=camera), {}

    return make


def blender_case(change):
    def make(root):
        change_json(write_blender(root), change)
        return root, {}

    return make


def frame_case(**values):
    return blender_case(lambda content: content["frames"][1].update(values))


def plain_photos(root):
    write_image(root / "images" / "a.png", texture())
    return root, {}


def cut_jpeg(root):
    write_model(root / "sparse" / "0", ["a.jpg"])
    write_image(root / "images" / "a.jpg", texture())
    cut(root / "images" / "a.jpg", 0.7)
    return root, {}


def source_is_file(root):
    (root / "scene.txt").write_text("x")
    return root / "scene.txt", {}


def blind_cameras(root):
    """The axes of OpenGL in a COLMAP model: all points are behind the cameras."""
    write_colmap(root, points=-2 * np.array([pose(i)[0].T @ pose(i)[1] for i in range(3)]))
    return root, {}


def blind_blender(content):
    for frame in content["frames"]:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag((1, -1, -1, 1))).tolist()


def no_test_left(root):
    return write_colmap(root, ["only.png"]), {"eval": True}


def trained_model(root):
    (root / "point_cloud").mkdir()
    return root, {}


def unknown_binary_model(path):
    data = bytearray(path.read_bytes())
    data[12:16] = (99).to_bytes(4, "little")
    path.write_bytes(data)


def image_only(path):
    path.write_text("# no images\n")


BAD = {
    "no-source": (lambda root: (root / "nowhere", {}), ["nowhere", "found nothing"]),
    "source-is-file": (source_is_file, ["scene.txt", "found a file"]),
    "plain-photos": (
        plain_photos,
        ["model (sparse/), transforms_train.json or transforms.json", "1 photographs alone", "warp-splat sfm"],
    ),
    "model": (trained_model, ["found a trained model", "folder of its scene"]),
    "resolution-0": (colmap_case(lambda root: None, resolution=0), ["resolution", "got 0"]),
    "resolution-absurd": (colmap_case(lambda root: None, resolution=1_000_000), [".png", "1000000", "-r"]),
    "resolution-negative": (colmap_case(lambda root: None, resolution=-2), ["resolution", "got -2"]),
    "eval-one-image": (no_test_left, ["at least 2 images", "found 1", "--eval"]),
    "empty-sparse": (lambda root: ((root / "sparse").mkdir() or root, {}), ["sparse", "found none"]),
    "no-images": (model_case("images.txt", image_only), ["sparse/0", "registered images"]),
    "missing-file": (model_case("points3D.bin", Path.unlink, binary=True), ["sparse/0", "pycolmap cannot read"]),
    "missing-images": (
        colmap_case(lambda root: [(root / "images" / name).unlink() for name in ("b.png", "c.png")]),
        ["images", "2 of them cannot be found", "'b.png'"],
    ),
    "no-image-folder": (
        colmap_case(lambda root: None, images="images_4"),
        ["images_4", "3 of them cannot be found", "--images"],
    ),
    "cut-image": (colmap_case(lambda root: cut(root / "images" / "b.png", 0.5)), ["b.png", "complete image"]),
    "cut-jpeg": (cut_jpeg, ["a.jpg", "complete image", "Premature end"]),
    "empty-image": (colmap_case(lambda root: cut(root / "images" / "b.png", 0)), ["b.png", "complete image"]),
    "not-an-image": (colmap_case(lambda root: (root / "images" / "b.png").write_text("hello")), ["b.png", "PNG"]),
    "size": (
        colmap_case(lambda root: write_image(root / "images" / "b.png", texture(HEIGHT, WIDTH))),
        ["b.png", f"{WIDTH} x {HEIGHT}", f"{HEIGHT} x {WIDTH}"],
    ),
    "opengl-axes": (blind_cameras, ["none of the 3 training cameras", "axes are probably mixed up"]),
    "cut-points": (model_case("points3D.bin", lambda path: cut(path, 0.7), binary=True), ["points3D.bin", "cut short"]),
    "empty-points": (model_case("points3D.bin", lambda path: cut(path, 0), binary=True), ["points3D.bin", "0 bytes"]),
    "cut-images": (model_case("images.bin", lambda path: cut(path, 0.7), binary=True), ["images.bin", "cut short"]),
    "cut-cameras": (model_case("cameras.bin", lambda path: cut(path, 0.7), binary=True), ["cameras.bin", "cut short"]),
    "cut-frames": (model_case("frames.bin", lambda path: cut(path, 0.7), binary=True), ["frames.bin", "cut short"]),
    "garbage-points": (
        model_case("points3D.bin", lambda path: path.write_bytes(texture().tobytes()), binary=True),
        ["points3D.bin", "damaged"],
    ),
    "garbage-text": (model_case("points3D.txt", lambda path: path.write_text("hello you\n")), ["sparse/0", "pycolmap"]),
    "unknown-model": (
        model_case("cameras.txt", lambda path: replace(path, "PINHOLE", "WIDE_EYE")),
        ["sparse/0", "Camera model does not exist"],
    ),
    "unknown-model-binary": (
        model_case("cameras.bin", unknown_binary_model, binary=True),
        ["sparse/0", "Camera model does not exist"],
    ),
    "panorama": (camera_case(f"EQUIRECTANGULAR {WIDTH} {HEIGHT} {WIDTH} {HEIGHT}"), ["a.png", "EQUIRECTANGULAR"]),
    "focal": (camera_case(f"PINHOLE {WIDTH} {HEIGHT} 40 -44 20 15"), ["a.png", "fy", "-44"]),
    "json": (
        lambda root: ((root / "transforms_train.json").write_text('{"frames": ') and root, {}),
        ["transforms_train.json", "expected JSON"],
    ),
    "json-list": (
        lambda root: ((root / "transforms_train.json").write_text("[1]") and root, {}),
        ["transforms_train.json", "key frames"],
    ),
    "angle-missing": (blender_case(lambda content: content.pop("camera_angle_x")), ["train.json", "camera_angle_x"]),
    "angle": (blender_case(lambda content: content.update(camera_angle_x=0)), ["train.json", "between 0 and pi"]),
    "frames-missing": (blender_case(lambda content: content.pop("frames")), ["train.json", "key frames"]),
    "frames-empty": (blender_case(lambda content: content.update(frames=[])), ["train.json", "at least one frame"]),
    "path-missing": (blender_case(lambda content: content["frames"][1].pop("file_path")), ["frame 1", "file_path"]),
    "path-number": (frame_case(file_path=3), ["frame 1", "string as file_path"]),
    "path-nowhere": (frame_case(file_path="train/r_9"), ["train.json", "1 of them cannot", "'train/r_9'"]),
    "matrix-missing": (
        blender_case(lambda content: content["frames"][0].pop("transform_matrix")),
        ["train.json", "frame 0", "transform_matrix"],
    ),
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
    with pytest.raises(InputError) as caught:
        load(source, **options)
    message = str(caught.value)
    assert all(part in message for part in parts), message
    assert "\n" not in message and message.endswith(".")
    assert ". " not in message.replace(str(tmp_path), "")


@pytest.mark.parametrize("place", [8 + 4, 8 + 4 + 32], ids=["rotation", "translation"])
def test_pose_that_is_not_finite_names_the_image(tmp_path, place):
    root = write_colmap(tmp_path, ["only.png"], binary=True)
    (root / "sparse" / "0" / "rigs.bin").unlink()  # as older COLMAPs write it: poses in images.bin
    (root / "sparse" / "0" / "frames.bin").unlink()
    path = root / "sparse" / "0" / "images.bin"
    data = bytearray(path.read_bytes())
    data[place : place + 8] = np.float64(np.nan).tobytes()
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"only\.png: Camera (rotation|translation): expected finite numbers"):
        load(root)
