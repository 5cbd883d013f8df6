"""SPZ and compressed PLY, decoded as the descriptions of the formats and their authors' programs say."""

import gzip
import struct

import numpy as np
import pytest
from commands import changes_told
from hostile import refusal
from scenes import C0
from splat_files import covariances, seen_colors, sigmoid, silent, small_splats, some_file, some_splats, spz2, spz4

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
    splats, antialiased, *_ = load_gaussians(tmp_path / "a.spz", report=silent)
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
    np.testing.assert_equal(before.splats, after.splats)


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
    refusal(lambda: load_gaussians(tmp_path / "a.spz"), match=f"axes {sentence}")


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


CHUNK_BYTES, WORD_BYTES = 18 * 4, 4 * 4


def tables(path, count, coefficients):
    """The header, chunks [C, 18], words [N, 4] and bytes of harmonics [N, ...]."""
    header, body = path.read_bytes().split(b"end_header\n", 1)
    chunks, rest = -(-count // 256), 3 * (coefficients - 1)
    assert len(body) == chunks * CHUNK_BYTES + count * (WORD_BYTES + rest)
    words = np.frombuffer(body, "<u4", 4 * count, chunks * CHUNK_BYTES).reshape(count, 4)
    harmonics = np.frombuffer(body, "u1", count * rest, chunks * CHUNK_BYTES + count * WORD_BYTES)
    return header.decode(), np.frombuffer(body, "<f4", 18 * chunks).reshape(-1, 18), words, harmonics


@pytest.mark.parametrize("coefficients", [1, 4, 16])
def test_compressed_ply_bytes_are_those_that_other_programs_read(tmp_path, coefficients):
    file = some_file(300, coefficients, antialiased=True)
    (means, sh, opacities, scales, quats), *_ = save_gaussians(tmp_path / "a.compressed.ply", file, report=silent)
    header, chunks, words, harmonics = tables(tmp_path / "a.compressed.ply", 300, coefficients)
    assert "comment SplatRenderMode: mip" in header and "element chunk 2" in header
    assert ("element sh 300" in header) == (coefficients > 1)
    for row, (position, rotation, scale, color) in enumerate(words):
        low, high = chunks[row // 256].reshape(3, 2, 3).swapaxes(0, 1).astype(float)
        for part, word, wanted in ((0, position, means[row]), (1, scale, scales[row])):
            bits = f"{word:032b}"
            shares = np.array([int(bits[:11], 2) / 2047, int(bits[11:21], 2) / 1023, int(bits[21:], 2) / 2047])
            step = (high[part] - low[part]) / [2047, 1023, 2047]
            assert (np.abs(low[part] + shares * (high[part] - low[part]) - wanted) <= 0.501 * step + 1e-6).all()
        red, green, blue, alpha = color.byteswap().tobytes()
        assert abs(alpha - 255 * sigmoid(opacities[row])) < 0.51
        found = low[2] + np.array([red, green, blue]) / 255 * (high[2] - low[2])
        assert (np.abs(found - 0.5 - C0 * sh[row, 0]) <= 0.501 * (high[2] - low[2]) / 255 + 1e-6).all()
        bits = f"{rotation:032b}"
        quat = [(int(bits[at : at + 10], 2) / 1023 - 0.5) * np.sqrt(2) for at in (2, 12, 22)]
        quat.insert(int(bits[:2], 2), np.sqrt(1 - np.square(quat).sum()))  # of w x y z
        assert abs(np.dot(quat, quats[row]) / np.linalg.norm(quats[row])) > 1 - 1e-5
    wanted = sh[:, 1:].swapaxes(1, 2).ravel()
    np.testing.assert_allclose((harmonics + 0.5 - 128) / 32, wanted, atol=0.5001 / 32)


def test_the_ends_of_every_range(tmp_path):
    file = some_file(20)
    file.splats.sh[0, 1:], file.splats.sh[1, 1:], file.splats.scales[2] = -4.0, 9.0, -30.0
    notes = []
    written, *_ = save_gaussians(tmp_path / "a.compressed.ply", file, report=notes.append)
    found = load_gaussians(tmp_path / "a.compressed.ply", report=silent).splats
    assert notes == [
        "log scale of 1 of 20 Gaussians moved into -20..20",
        "harmonics of 1 of 20 Gaussians moved into -4..4",
    ]
    beyond = np.abs(written.sh) >= 4
    np.testing.assert_array_equal(found.sh[beyond], np.clip(written.sh, -4, 4)[beyond])
    assert found.scales.min() == -20


def test_older_files_have_no_ranges_of_colors(tmp_path):
    splats, *_ = save_gaussians(tmp_path / "a.compressed.ply", some_file(300, 1), report=silent)
    _, chunks, words, _ = tables(tmp_path / "a.compressed.ply", 300, 1)
    header = (tmp_path / "a.compressed.ply").read_bytes().split(b"end_header\n")[0]
    for name in "rgb":
        for end in ("min", "max"):
            header = header.replace(f"property float {end}_{name}\n".encode(), b"")
    data = header + b"end_header\n" + chunks[:, :12].tobytes() + words.tobytes()
    (tmp_path / "b.ply").write_bytes(data)  # whatever it is called
    found = load_gaussians(tmp_path / "b.ply", report=silent).splats
    np.testing.assert_allclose(0.5 + C0 * found.sh[:, 0], (words[:, 3:] >> [24, 16, 8] & 255) / 255, atol=1e-6)
    np.testing.assert_allclose(found.means, splats.means, atol=0.02)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("element chunk 2", "element chunk 1", "1 chunks for 300 Gaussians"),
        ("element chunk 2", "element lump 2", "a compressed one without an element 'chunk'"),
        ("property float max_y\n", "", "whose chunk lacks max_y of type f4"),
        ("property uint packed_scale", "property float packed_scale", "whose vertex lacks packed_scale of type u4"),
        ("element sh 300", "element sh 299", "harmonics of 299 of 300 Gaussians"),
        ("property uchar f_rest_8\n", "", "8 properties of harmonics, not 9, 24 or 45"),
        ("property uchar f_rest_8", "property char f_rest_8", "whose sh lacks f_rest_8 of type u1"),
        ("element sh 300", "element sh 301", "301 rows of 'sh' need at least"),
    ],
)
def test_what_disagrees_is_refused(tmp_path, old, new, sentence):
    save_gaussians(tmp_path / "a.compressed.ply", some_file(300, 4), report=silent)
    data = (tmp_path / "a.compressed.ply").read_bytes()
    assert old.encode() in data
    (tmp_path / "b.ply").write_bytes(data.replace(old.encode(), new.encode(), 1))
    refusal(lambda: load_gaussians(tmp_path / "b.ply"), match=sentence)


@pytest.mark.parametrize("size", [1.0, 1e-3])
def test_pictures_of_small_models_are_compared(tmp_path, size, ran):
    """What is nearer than a fifth of a unit would not be drawn."""
    splats = small_splats(200)
    splats = splats._replace(means=size * splats.means, scales=splats.scales + np.float32(np.log(size)))
    save_gaussians(tmp_path / "a.ply", SplatFile(splats), silent)
    measured, bound = changes_told(ran("convert", tmp_path / "a.ply", tmp_path / "b.splat", "--bound"))
    assert 0.001 < measured <= bound
