"""Scenes from strangers: whatever the bytes of one file, there is a finite scene or one sentence, in little memory.

COLMAP models, transforms.json, images and masks are changed as tests/test_hostile_files.py changes files of Gaussians.
"""

import json
import resource

import numpy as np
import pytest
import scene_files
from hostile import changed, changed_json, one_sentence, refusal, replace, tried
from hypothesis import strategies as st
from scene_files import load, texture, write_blender, write_colmap, write_floats, write_image, write_transforms
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
    scene_files.write_model(root / "sparse" / "0", [name])
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


#: Each makes a scene, and returns the files to change.
KINDS = {
    "model": lambda root: colmap(root, MODEL),
    "old model": lambda root: colmap(root, OLD_MODEL),
    "text model": lambda root: colmap(root, TEXT_MODEL, binary=False),
    "transforms": lambda root: [write_transforms(root, camera_model="OPENCV", k1=0.0) / "transforms.json"],
    "nerf-synthetic": lambda root: [write_blender(root, test=0) / "transforms_train.json"],
    "points": lambda root: [write_transforms(root) / "points.ply"],
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
        one_sentence(error, "", 1000 + 3 * len(str(root)))
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


def resident():
    """Bytes of this process, at most so far."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


@pytest.mark.parametrize("examples", [QUICK, pytest.param(LONG, marks=pytest.mark.long)])
@pytest.mark.parametrize("kind", KINDS)
def test_hostile_scenes(tmp_path, kind, examples, pytestconfig):
    files = {path: path.read_bytes() for path in KINDS[kind](tmp_path)}
    assert survive(tmp_path)
    before = resident()

    def run(change):
        path, data = change
        path.write_bytes(data)
        try:
            survive(tmp_path)
        finally:
            path.write_bytes(files[path])

    seeded = examples == LONG and pytestconfig.getoption("--hypothesis-seed") is not None
    tried(examples, hostile(files), run, seeded)
    assert resident() - before < MEMORY


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
    refusal(lambda: load(tmp_path), match=rf"{name}.*cut short or damaged")


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (b"channels\0chlist", b"chann\x80ls\0chlist", "expected a complete image file"),  # a name that is no text
        (b"screenWindowCenter\0", b"screenWindowCenter\0" * 2, r".* \.\.\.\); replace it\.$"),  # a long list follows
    ],
)
def test_what_a_library_complains_of_is_cut_to_a_sentence(tmp_path, old, new, sentence):
    (path,) = with_image(tmp_path, "a.exr")
    replace(path, old, new)
    refusal(lambda: load(tmp_path), match=rf"a\.exr: {sentence}")


def test_a_model_whose_frames_name_images_that_it_lacks(tmp_path):
    """pycolmap reads it, and raises when such an image is asked for."""
    colmap(tmp_path, MODEL)
    (tmp_path / "sparse" / "0" / "images.bin").write_bytes(bytes(8))
    refusal(lambda: load(tmp_path), "image 1 in frame 1 does not exist")


def test_a_png_that_lies_about_its_size_allocates_nothing(tmp_path):
    """A header of 14,000 x 14,000 pixels on a file of some kilobytes."""
    (path,) = with_image(tmp_path, "a.png")
    data = bytearray(path.read_bytes())
    data[16:24] = (14_000).to_bytes(4, "big") * 2
    path.write_bytes(data)
    before = resident()
    refusal(lambda: load(tmp_path), "a.png")
    assert resident() - before < 100_000 * 1024
