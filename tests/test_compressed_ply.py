"""Compressed PLY files, decoded word by word as their authors' programs do."""

import numpy as np
import pytest
from scenes import C0
from splat_files import sigmoid, silent, some_file

from warp_splat.errors import InputError
from warp_splat.formats.exchange import load_gaussians, save_gaussians

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
def test_bytes_are_those_that_other_programs_read(tmp_path, coefficients):
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
    np.testing.assert_array_equal(
        found.sh[:, 1:][np.abs(written.sh[:, 1:]) >= 4], np.clip(written.sh, -4, 4)[np.abs(written.sh) >= 4]
    )
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


def test_no_gaussians(tmp_path):
    save_gaussians(tmp_path / "a.compressed.ply", some_file(0), report=silent)
    assert len(load_gaussians(tmp_path / "a.compressed.ply", report=silent).splats.means) == 0


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
    with pytest.raises(InputError, match=sentence):
        load_gaussians(tmp_path / "b.ply")
