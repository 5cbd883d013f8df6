"""Scenes from strangers: whatever the bytes of one file, there is a finite scene or one sentence, in little memory.

COLMAP models, transforms.json, images and masks are changed as tests/test_hostile_files.py changes files of Gaussians.
"""

import json
import resource
import shutil

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scene_files import (
    load,
    texture,
    write_blender,
    write_colmap,
    write_floats,
    write_image,
    write_model,
    write_transforms,
)
from test_hostile_files import changed, changed_json
from test_inputs import light

from warp_splat.errors import InputError

QUICK, LONG = 60, 1_000  # examples for each kind
MEMORY = 2**30  # bytes that all examples of a kind may add to the process: one is decoded at a time
MODEL = ("rigs.bin", "cameras.bin", "frames.bin", "images.bin", "points3D.bin")
OLD_MODEL = ("cameras.bin", "images.bin", "points3D.bin")
TEXT_MODEL = ("cameras.txt", "images.txt", "points3D.txt")


def colmap(root, files, binary=True):
    write_colmap(root, binary=binary)
    for path in (root / "sparse" / "0").iterdir():
        if path.name not in files:
            path.unlink()
    return [root / "sparse" / "0" / name for name in files]


def with_image(root, name):
    write_model(root / "sparse" / "0", [name])
    path = root / "images" / name
    if path.suffix == ".exr":
        write_floats(path, light())
    else:
        write_image(path, texture(channels=4 if path.suffix == ".png" else 3))
    return [path]


def with_mask(root):
    write_colmap(root)
    write_image(root / "masks" / "b.png", texture(channels=1))
    return [root / "masks" / "b.png"]


def with_points(root):
    write_transforms(root)
    return [root / "points.ply"]


#: Each makes a scene, and returns the files to change.
KINDS = {
    "model": lambda root: colmap(root, MODEL),
    "old model": lambda root: colmap(root, OLD_MODEL),
    "text model": lambda root: colmap(root, TEXT_MODEL, binary=False),
    "transforms": lambda root: [write_transforms(root, camera_model="OPENCV", k1=0.0) / "transforms.json"],
    "nerf-synthetic": lambda root: [write_blender(root, test=0) / "transforms_train.json"],
    "points": with_points,
    "png": lambda root: with_image(root, "a.png"),
    "jpg": lambda root: with_image(root, "a.jpg"),
    "tif": lambda root: with_image(root, "a.tif"),
    "exr": lambda root: with_image(root, "a.exr"),
    "mask": with_mask,
}


def survive(root):
    """Load the scene; whether it was read at all."""
    try:
        scene, lines = load(root)
    except InputError as error:
        message = str(error)
        assert "\n" not in message and len(message) < 1000 + 3 * len(str(root)), message
        return False
    assert all("\n" not in line for line in lines)
    assert np.isfinite(scene.points).all() and len(scene.points) == len(scene.colors) > 0
    for view in scene.train:
        assert np.isfinite(view.image).all() and view.image.shape == (view.camera.height, view.camera.width, 3)
        assert np.isfinite(view.camera.rotation).all() and np.isfinite(view.camera.translation).all()
        assert view.mask is None or view.mask.shape == view.image.shape[:2]
    return True


@st.composite
def hostile(draw, files):
    """One of the files, and bytes for it."""
    path, data = draw(st.sampled_from(sorted(files.items())))
    how = draw(st.sampled_from(["random", "changed", "changed", "inside", "inside"]))
    if how == "random":
        return path, data[: draw(st.integers(0, 40))] + draw(st.binary(max_size=300))
    if how == "inside" and path.suffix == ".json":
        return path, json.dumps(changed_json(draw, json.loads(data))).encode()
    return path, changed(draw, data)


def attack(kind, root, examples, seeded=False):
    shutil.rmtree(root, ignore_errors=True)
    files = {path: path.read_bytes() for path in KINDS[kind](root)}
    assert survive(root)
    before, found = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, [0, 0]

    @settings(
        max_examples=examples,
        deadline=None,
        database=None,
        derandomize=not seeded,
        suppress_health_check=list(HealthCheck),
    )
    @given(change=hostile(files))
    def run(change):
        path, data = change
        path.write_bytes(data)
        try:
            found[survive(root)] += 1
        finally:
            path.write_bytes(files[path])

    run()
    assert 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) < MEMORY
    print(f"{kind}: {found[0]} inputs refused, {found[1]} read")


@pytest.mark.parametrize("kind", KINDS)
def test_hostile_scenes(tmp_path, kind):
    attack(kind, tmp_path / "scene", QUICK)


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_hostile_scenes_for_long(tmp_path, kind, pytestconfig):
    attack(kind, tmp_path / "scene", LONG, pytestconfig.getoption("--hypothesis-seed") is not None)


@pytest.mark.parametrize("name", MODEL)
def test_every_cut_of_a_model_is_refused(tmp_path, name):
    colmap(tmp_path, MODEL)
    path = tmp_path / "sparse" / "0" / name
    data = path.read_bytes()
    for length in range(0, len(data), 1 + len(data) // 60):
        path.write_bytes(data[:length])
        assert not survive(tmp_path), f"{length} of {len(data)} bytes were taken for a model"


@pytest.mark.parametrize("name", MODEL)
@pytest.mark.parametrize("count", [10**12, 2**32 - 1, 2**63, 2**64 - 1])
def test_lies_about_counts_are_refused_at_once(tmp_path, name, count):
    colmap(tmp_path, MODEL)
    path = tmp_path / "sparse" / "0" / name
    path.write_bytes(count.to_bytes(8, "little") + path.read_bytes()[8:])
    with pytest.raises(InputError, match=rf"{name}.*cut short or damaged"):
        load(tmp_path)


def test_bytes_in_a_file_that_are_no_text(tmp_path):
    """OpenImageIO names the attribute that it refuses."""
    (path,) = with_image(tmp_path, "a.exr")
    data = path.read_bytes()
    assert b"channels\0chlist" in data
    path.write_bytes(data.replace(b"channels\0chlist", b"chann\x80ls\0chlist"))
    with pytest.raises(InputError, match=r"a\.exr: expected a complete image file"):
        load(tmp_path)


def test_a_model_whose_frames_name_images_that_it_lacks(tmp_path):
    """pycolmap reads it, and raises when such an image is asked for."""
    colmap(tmp_path, MODEL)
    (tmp_path / "sparse" / "0" / "images.bin").write_bytes(bytes(8))
    with pytest.raises(InputError, match="image 1 in frame 1 does not exist"):
        load(tmp_path)


def test_all_that_a_library_complains_of_is_cut_to_a_sentence(tmp_path):
    """OpenEXR lists what follows from a name that stands there twice."""
    (path,) = with_image(tmp_path, "a.exr")
    data = path.read_bytes()
    path.write_bytes(data.replace(b"screenWindowCenter\0", b"screenWindowCenter\0screenWindowCenter\0"))
    with pytest.raises(InputError, match=r"a\.exr: .* \.\.\.\); replace it\.$"):
        load(tmp_path)


def test_a_png_that_lies_about_its_size_allocates_nothing(tmp_path):
    """A header of 14,000 x 14,000 pixels on a file of some kilobytes."""
    (path,) = with_image(tmp_path, "a.png")
    data = bytearray(path.read_bytes())
    data[16:24] = (14_000).to_bytes(4, "big") * 2
    path.write_bytes(data)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match=r"a\.png"):
        load(tmp_path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000
