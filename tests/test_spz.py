"""SPZ of versions 2, 3 and 4, decoded as the description of the format says."""

import gzip
import struct

import numpy as np
import pytest
from splat_files import covariances, seen_colors, sigmoid, silent, some_file, some_splats, spz2, spz4

from warp_splat.errors import InputError
from warp_splat.formats.exchange import load_gaussians, save_gaussians
from warp_splat.formats.splats import SplatFile, turned


def spz_rows(data, version, count, degree):
    """Decode as the format's description says, one number after the other: axes right, up, back."""
    per_row = {"means": 9, "alpha": 1, "color": 3, "scale": 3, "quat": 3 if version == 2 else 4, "sh": 45}
    per_row["sh"] = 3 * ((degree + 1) ** 2 - 1)
    place, parts = 0, {}
    for name, size in per_row.items():
        parts[name] = [data[place + row * size :][:size] for row in range(count)]
        place += count * size
    assert place == len(data)
    for row in range(count):
        fixed = [int.from_bytes(parts["means"][row][3 * i :][:3], "little", signed=True) for i in range(3)]
        yield fixed, parts["alpha"][row][0], *(list(parts[name][row]) for name in ("color", "scale", "quat", "sh"))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spz_bytes_are_the_documented_layout(tmp_path, degree):
    splats = some_splats(9, (degree + 1) ** 2)
    save_gaussians(tmp_path / "a.spz", SplatFile(splats, True), report=silent)
    data = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert struct.unpack("<4sIIBBBB", data[:16]) == (b"NGSP", 3, 9, degree, 12, 1, 0)
    wanted = turned(splats, np.diag([1.0, -1.0, -1.0]))
    for row, (fixed, alpha, color, scale, quat, sh) in enumerate(spz_rows(data[16:], 3, 9, degree)):
        np.testing.assert_allclose(fixed, 4096 * wanted.means[row], atol=0.51)
        assert abs(alpha - 255 * sigmoid(splats.opacities[row])) < 0.51
        np.testing.assert_allclose(color, 255 * (0.15 * splats.sh[row, 0] + 0.5), atol=0.51)
        np.testing.assert_allclose(scale, 16 * (splats.scales[row] + 10), atol=0.51)
        np.testing.assert_allclose(sh, (128 * wanted.sh[row, 1:] + 128).ravel(), atol=0.51)
        bits = f"{int.from_bytes(bytes(quat), 'little'):032b}"
        largest, rest = int(bits[:2], 2), [bits[2:12], bits[12:22], bits[22:]]
        found = [(-1) ** int(text[0]) * int(text[1:], 2) / 511 / np.sqrt(2) for text in rest]
        found.insert(largest, np.sqrt(1 - np.square(found).sum()))
        unit = (wanted.quats[row] / np.linalg.norm(wanted.quats[row]))[[1, 2, 3, 0]]
        np.testing.assert_allclose(np.array(found), unit * np.sign(unit[largest]), atol=0.003)


def test_spz_version_2(tmp_path):
    spz2(tmp_path / "a.spz")
    splats, antialiased, _ = load_gaussians(tmp_path / "a.spz", report=silent)
    np.testing.assert_array_equal(splats.means, [[1, -2, -3]])
    np.testing.assert_array_equal(splats.scales, [[0, 0, 1]])
    np.testing.assert_allclose(splats.sh[0, 0], [-0.5 / 0.15, 0.002 / 0.15, 0.5 / 0.15], atol=0.001)
    assert not antialiased and abs(sigmoid(splats.opacities[0]) - 128 / 255) < 1e-6
    np.testing.assert_allclose(covariances(splats)[0], np.diag([1, 1, np.e**2]), atol=0.2)  # half a turn about x


@pytest.mark.parametrize("degree", [0, 3])
def test_spz_version_4_holds_the_same(tmp_path, degree):
    save_gaussians(tmp_path / "a.spz", some_file(30, (degree + 1) ** 2, antialiased=True), report=silent)
    before = load_gaussians(tmp_path / "a.spz", report=silent)
    spz4(tmp_path / "a.spz")
    after = load_gaussians(tmp_path / "a.spz", report=silent)
    assert after.antialiased
    for old, new in zip(before.splats, after.splats, strict=True):
        np.testing.assert_array_equal(old, new)


@pytest.mark.parametrize(("number", "signs"), [(0, [1, -1, -1]), (6, [1, 1, 1]), (7, [-1, -1, 1]), (3, [-1, -1, -1])])
def test_spz_axes_by_extension(tmp_path, number, signs):
    """6 is RDF, ours; 7 is LUF; 3 is LUB, a mirror."""
    save_gaussians(tmp_path / "a.spz", some_file(30), report=silent)
    stored = turned(load_gaussians(tmp_path / "a.spz").splats, np.diag([1.0, -1, -1]))
    spz4(tmp_path / "a.spz", number)
    found = load_gaussians(tmp_path / "a.spz", report=silent).splats
    np.testing.assert_array_equal(found.means, stored.means * np.float32(signs))
    mirror = np.diag(np.float64(signs))
    np.testing.assert_allclose(covariances(found), mirror @ covariances(stored) @ mirror, rtol=1e-3, atol=1e-5)
    directions = np.random.default_rng(1).normal(size=(30, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(seen_colors(found, directions @ mirror), seen_colors(stored, directions), atol=1e-5)


@pytest.mark.parametrize(("number", "sentence"), [(9, "LFD"), (17, "number 17"), (2**32 - 1, "number 4294967295")])
def test_spz_axes_that_nobody_agrees_on(tmp_path, number, sentence):
    save_gaussians(tmp_path / "a.spz", some_file(3), report=silent)
    spz4(tmp_path / "a.spz", number)
    with pytest.raises(InputError, match=f"axes {sentence}"):
        load_gaussians(tmp_path / "a.spz")


@pytest.mark.parametrize(("widest", "bits"), [(2000.0, 12), (3000.0, 11), (1e6, 3), (1e9, 0)])
def test_spz_takes_as_many_fractional_bits_as_fit(tmp_path, widest, bits):
    file = some_file(3)
    file.splats.means[0, 1] = widest
    notes = []
    save_gaussians(tmp_path / "a.spz", file, report=notes.append)
    assert gzip.decompress((tmp_path / "a.spz").read_bytes())[13] == bits
    found = load_gaussians(tmp_path / "a.spz").splats.means
    assert (np.abs(found - file.splats.means)[1:] <= 0.5001 / 2**bits).all()
    assert notes == ([] if widest < 2**23 else ["position of 1 of 3 Gaussians moved into -8.389e+06..8.389e+06"])
