"""Round trips through another program: splat-transform (PlayCanvas, MIT), which shares no code with this package.

It is an npm package and not installed with this one. The tests find it as the command ``splat-transform``, or as what
WARP_SPLAT_TRANSFORM says ("node path/to/bin/cli.mjs"), and are skipped without it. Version 3.7 was used.

It reads and writes SPZ without turning the axes, as if they were the PLY file's: it is told to turn them.
"""

import os
import shlex
import shutil
import subprocess

import numpy as np
import pytest
from scipy.spatial import KDTree
from splat_files import covariances, glb_attributes, some_file

from warp_splat.formats.exchange import load_gaussians, save_gaussians
from warp_splat.formats.splats import SplatFile
from warp_splat.formats.stored import sigmoid

COMMAND = shlex.split(os.environ.get("WARP_SPLAT_TRANSFORM", "")) or [shutil.which("splat-transform") or ""]
HALF_TURN = ("-r", "180,0,0")
STEPS = (0.5 / 4096, 0.5 / 16, 0.5 / 255, 0.5 / 255 / 0.15)  # of SPZ: position, log scale, opacity, color

pytestmark = pytest.mark.skipif(
    not COMMAND[0],
    reason="splat-transform not found: npm install @playcanvas/splat-transform, set WARP_SPLAT_TRANSFORM",
)


def transform(source, target, *actions):
    subprocess.run([*COMMAND, "-q", "-w", source, *actions, target], check=True, capture_output=True, timeout=300)


def assert_same(found, wanted, steps=(0, 0, 0, 0, 0), shape=1e-3):
    """Equal within bounds: of position, log scale, opacity, color, harmonics, and (relative) covariances."""
    bounds = [1.01 * step + 1e-5 for step in steps]
    np.testing.assert_allclose(found.means, wanted.means, atol=bounds[0], rtol=1e-6)
    np.testing.assert_allclose(found.scales, wanted.scales, atol=bounds[1], rtol=0)
    np.testing.assert_allclose(sigmoid(found.opacities), sigmoid(wanted.opacities), atol=bounds[2], rtol=0)
    np.testing.assert_allclose(found.sh[:, :1], wanted.sh[:, :1], atol=bounds[3], rtol=0)
    np.testing.assert_allclose(found.sh[:, 1:], wanted.sh[:, 1:], atol=bounds[4], rtol=0)
    one, other = covariances(found), covariances(wanted)
    assert (np.abs(one - other).max(axis=(1, 2)) <= shape * np.abs(other).max(axis=(1, 2))).all()


@pytest.fixture
def file(tmp_path):
    """Gaussians in a .ply file that the other program can read."""
    file = some_file(300, antialiased=True)
    np.clip(file.splats.opacities, -5, 5, out=file.splats.opacities)  # of compressed PLY it drops what rounds to 0 or 1
    save_gaussians(tmp_path / "ours.ply", file)
    return file


@pytest.mark.parametrize(
    ("ending", "actions"), [(".ply", ()), (".compressed.ply", ()), (".splat", ()), (".spz", HALF_TURN)]
)
def test_it_reads_what_we_write(tmp_path, file, ending, actions):
    ours = tmp_path / f"a{ending}"
    save_gaussians(ours, file, report=lambda line: None)
    transform(ours, tmp_path / "theirs.ply", *actions)
    theirs, antialiased, *_ = load_gaussians(tmp_path / "theirs.ply")
    # it takes the bytes of a quaternion as 2 b / 255 - 1, where the first viewer has b / 128 - 1
    assert_same(theirs, load_gaussians(ours).splats, shape=0.05 if ending == ".splat" else 1e-3)
    assert antialiased == (ending != ".splat")


@pytest.mark.parametrize(("version", "actions"), [("3", HALF_TURN), ("4", HALF_TURN)])
def test_we_read_the_spz_that_it_writes(tmp_path, file, version, actions):
    transform(tmp_path / "ours.ply", tmp_path / "theirs.spz", *actions, "--spz-version", version)
    theirs, antialiased, *_ = load_gaussians(tmp_path / "theirs.spz")
    # of harmonics it rounds to 1/128 first and then to 1/16: off by 1/256 + 1/16 at most
    assert_same(theirs, file.splats, (*STEPS, 1 / 256 + 1 / 16), shape=0.2)
    assert antialiased


def test_we_read_the_compressed_ply_that_it_writes(tmp_path, file):
    transform(tmp_path / "ours.ply", tmp_path / "theirs.compressed.ply")
    theirs, antialiased, *_ = load_gaussians(tmp_path / "theirs.compressed.ply")
    order = KDTree(theirs.means).query(file.splats.means)[1]  # it has an order of its own
    theirs = theirs.take(order)
    ranges = np.ptp(file.splats.means, axis=0).max()  # of a chunk, at most
    assert_same(theirs, file.splats, (0.5 * ranges / 1023, 0.5 * 7 / 1023, 0.5 / 255, 0.01, 0.5 / 32), shape=0.1)
    assert antialiased


@pytest.mark.long
def test_sog_both_ways(tmp_path):
    """It clusters harmonics, too, by its own means: what both make of the same palette has to agree."""
    file = some_file(2000, antialiased=True)
    file.splats.sh[:, 1:] = file.splats.sh[np.random.default_rng(1).integers(0, 100, 2000), 1:]
    written, *_ = save_gaussians(tmp_path / "ours.sog", file, report=lambda line: None)
    transform(tmp_path / "ours.sog", tmp_path / "back.ply")
    theirs, antialiased, *_ = load_gaussians(tmp_path / "back.ply")
    ours = load_gaussians(tmp_path / "ours.sog").splats
    inside = np.abs(ours.opacities) < 13  # it moves opacities of 0 and 1 by a millionth
    assert_same(theirs.take(inside), ours.take(inside))
    assert antialiased and inside.mean() > 0.98
    save_gaussians(tmp_path / "ours.ply", SplatFile(written, True))
    transform(tmp_path / "ours.ply", tmp_path / "theirs.sog", "-g", "cpu")
    theirs, antialiased, *_ = load_gaussians(tmp_path / "theirs.sog")
    order = KDTree(theirs.means).query(written.means)[1]  # it has an order of its own
    assert sorted(order) == list(range(2000)) and antialiased
    rows = np.flatnonzero(sigmoid(written.opacities) > 1 / 255)  # its images lose the colors of those it writes as 0
    theirs, written = theirs.take(order[rows]), written.take(rows)
    # steps of its own: numbers are cut instead of rounded, codebooks have few entries in the tails
    assert_same(theirs, written, (2e-3, 0.1, 1 / 255, 0.05, 0.2), shape=0.3)
    assert np.abs(theirs.sh[:, 1:] - written.sh[:, 1:]).mean() < 0.02


def test_we_read_the_gltf_that_it_writes_and_ours_holds_the_same(tmp_path, file):
    transform(tmp_path / "ours.ply", tmp_path / "theirs.glb")
    assert_same(load_gaussians(tmp_path / "theirs.glb").splats, file.splats)
    save_gaussians(tmp_path / "ours.glb", file)
    ours, theirs = glb_attributes(tmp_path / "ours.glb"), glb_attributes(tmp_path / "theirs.glb")
    assert ours.keys() == theirs.keys()
    for name in ours.keys() - {"COLOR_0"}:  # that of ours is linear, as the extension says, that of theirs is not
        one, other = ours[name], theirs[name]
        if name.endswith("ROTATION"):
            other = other / np.linalg.norm(other, axis=1, keepdims=True)
            other = other * np.sign((one * other).sum(axis=1, keepdims=True))
        np.testing.assert_allclose(one, other, atol=1e-5, rtol=1e-5, err_msg=name)
