"""SOG of version 2, decoded as the description of the format says; its codebooks and palettes against brute force."""

import zipfile

import numpy as np
import pytest
from hostile import refusal, value_at
from scipy.spatial import KDTree
from splat_files import covariances, sigmoid, silent, sog_bytes, sog_parts, some_file, some_splats, webp_bytes

from warp_splat.formats.exchange import load_gaussians, save_gaussians
from warp_splat.formats.palettes import codebook, palette
from warp_splat.formats.splats import SplatFile
from warp_splat.rendering.changes import losses


def sog_rows(path):
    """Decode as the format's description says, one Gaussian after the other."""
    meta, images = sog_parts(path)
    width = images["means_l.webp"].shape[1]
    for index in range(meta["count"]):
        place = index // width, index % width
        pixel = {name: image[place] for name, image in images.items() if "centroids" not in name}
        means = []
        for axis, (low, high) in enumerate(zip(meta["means"]["mins"], meta["means"]["maxs"], strict=True)):
            step = int(pixel["means_l.webp"][axis]) + 256 * int(pixel["means_u.webp"][axis])
            log = low + (high - low) * step / 65535
            means.append(np.sign(log) * (np.exp(abs(log)) - 1))
        quat = list((pixel["quats.webp"][:3] / 255 - 0.5) * 2 / np.sqrt(2))
        quat.insert(pixel["quats.webp"][3] - 252, np.sqrt(1 - np.square(quat).sum()))
        scales = [meta["scales"]["codebook"][byte] for byte in pixel["scales.webp"][:3]]
        color = [meta["sh0"]["codebook"][byte] for byte in pixel["sh0.webp"][:3]]
        harmonics = []
        if "shN" in meta:
            label = int(pixel["shN_labels.webp"][0]) + 256 * int(pixel["shN_labels.webp"][1])
            each = {1: 3, 2: 8, 3: 15}[meta["shN"]["bands"]]
            x, y = label % 64 * each, label // 64
            bytes_ = images["shN_centroids.webp"][y, x : x + each, :3]
            assert label < meta["shN"]["count"] and images["shN_centroids.webp"].shape[1] == 64 * each
            harmonics = np.float32(meta["shN"]["codebook"])[bytes_]
        yield means, quat, scales, color, pixel["sh0.webp"][3] / 255, harmonics


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_sog_bytes_are_the_documented_layout(tmp_path, degree):
    file = some_file(37, (degree + 1) ** 2, antialiased=True)
    splats, *_ = save_gaussians(tmp_path / "a.sog", file, report=silent)
    meta, images = sog_parts(tmp_path / "a.sog")
    assert (meta["version"], meta["count"], meta["antialias"], meta["model"]) == (2, 37, True, "antialiased")
    assert {image.shape for name, image in images.items() if "centroids" not in name} == {(8, 8, 4)}
    assert ("shN" in meta) == (degree > 0)
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        assert all(info.compress_type == zipfile.ZIP_STORED for info in archive.infolist())
    for row, (means, quat, scales, color, alpha, harmonics) in enumerate(sog_rows(tmp_path / "a.sog")):
        np.testing.assert_allclose(means, splats.means[row], atol=1e-3)
        np.testing.assert_array_equal(np.float32(scales), splats.scales[row])  # no more of them than entries
        np.testing.assert_array_equal(np.float32(color), splats.sh[row, 0])
        assert abs(alpha - sigmoid(splats.opacities[row])) < 0.51 / 255
        unit = splats.quats[row] / np.linalg.norm(splats.quats[row])
        np.testing.assert_allclose(np.abs(np.dot(quat, unit)), 1, atol=1e-4)
        if degree:
            np.testing.assert_allclose(harmonics, splats.sh[row, 1:], atol=0.02)


def test_near_gaussians_become_near_pixels(tmp_path):
    before = some_file(2000, 1)
    splats, *_ = save_gaussians(tmp_path / "a.sog", before, report=silent)
    place = KDTree(before.splats.means).query(splats.means)[1]
    assert sorted(place) == list(range(2000))  # all of them, each with its own values
    np.testing.assert_equal(before.splats.take(place), splats)
    steps = [np.linalg.norm(np.diff(means, axis=0), axis=1).mean() for means in (before.splats.means, splats.means)]
    assert steps[1] < 0.4 * steps[0]


def test_a_palette_stands_for_many_harmonics(tmp_path):
    rng = np.random.default_rng(0)
    kinds = rng.normal(scale=0.2, size=(300, 15, 3))
    splats = some_splats(12_000)
    splats.sh[:, 1:] = kinds[rng.integers(0, 300, 12_000)] + rng.normal(scale=0.003, size=(12_000, 15, 3))
    written, *_ = save_gaussians(tmp_path / "a.sog", SplatFile(splats), report=silent)
    read = load_gaussians(tmp_path / "a.sog", report=silent).splats
    assert sog_parts(tmp_path / "a.sog")[0]["shN"]["count"] <= 1500
    error = (read.sh[:, 1:] - written.sh[:, 1:]).std()
    assert error < 0.006  # that of their scatter, and of a byte
    assert np.abs(covariances(read) - covariances(written)).max() < 0.05 * np.abs(covariances(written)).max()
    again = save_gaussians(tmp_path / "b.sog", SplatFile(read), report=silent)
    lost = losses(again.splats, load_gaussians(tmp_path / "b.sog").splats)
    assert "harmonics" not in str(lost)  # a second time costs nothing


def test_equal_gaussians_give_equal_bytes(tmp_path):
    for name in ("a.sog", "b.sog"):
        save_gaussians(tmp_path / name, some_file(3000, 4), report=silent)
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


@pytest.mark.parametrize("kind", ["normal", "tails", "two lumps", "few", "one"])
def test_codebook_is_near_the_best(kind):
    """Against k-means from many starts would be slow: against the bound of Panter and Dite for smooth densities."""
    rng = np.random.default_rng(1)
    values = {
        "normal": rng.normal(size=20_000),
        "tails": rng.standard_t(2, size=20_000),
        "two lumps": np.concatenate([rng.normal(size=10_000), 50 + 0.1 * rng.normal(size=10_000)]),
        "few": np.repeat(rng.normal(size=200), 10),
        "one": np.full(5, 0.25),
    }[kind].astype(np.float32)
    entries, labels = codebook(values.reshape(-1, 5))
    assert entries.shape == (256,) and entries.dtype == np.float32 and (np.diff(entries) >= 0).all()
    assert labels.dtype == np.uint8 and labels.shape == (len(values) // 5, 5)
    nearest = np.abs(values[:, None] - entries).min(axis=1)
    found = np.abs(entries[labels].ravel() - values)
    np.testing.assert_allclose(found, nearest, atol=1e-6)
    if kind in ("few", "one"):
        assert (found == 0).all()
    elif kind == "normal":
        bound = 6 * np.sqrt(3) * np.pi / 12 / 256**2  # mean squared error of the best for a unit normal density
        assert np.mean(found**2) < 1.1 * bound


def test_palette_labels_are_of_near_entries():
    vectors = np.random.default_rng(2).normal(size=(5000, 9)).astype(np.float32)
    entries, labels = palette(vectors, 700)
    assert 600 < len(entries) <= 700 and set(labels) == set(range(len(entries)))
    for entry in (0, 17, len(entries) - 1):
        np.testing.assert_allclose(entries[entry], vectors[labels == entry].mean(axis=0), atol=1e-5)
    best = KDTree(entries).query(vectors)[0] ** 2
    assert ((entries[labels] - vectors) ** 2).sum(axis=1).mean() < 1.25 * best.mean()  # two levels: not all are nearest
    everything, labels = palette(vectors, 5000)
    np.testing.assert_array_equal(everything[labels], vectors)


def parts(tmp_path):
    """The meta.json and the files of a small valid file."""
    save_gaussians(tmp_path / "a.sog", some_file(20, 4), report=silent)
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    files.pop("meta.json")
    return sog_parts(tmp_path / "a.sog")[0], files


@pytest.mark.parametrize(
    ("way", "value", "sentence"),
    [
        ("version", 1, "found version 1; save it with splat-transform"),
        ("version", None, "found version None"),
        ("version", 3, "found version 3"),
        ("count", 21000, "an image 'sh0.webp' of 8x4 pixels, expected those of 21000 Gaussians"),
        ("count", 2**31, "2147483648 Gaussians expand to 62277025792 bytes, over"),
        ("count", "20", "count '20', which is no whole number"),
        ("means", [], "no object 'means' in its meta.json"),
        ("means.files", ["means_l.webp"], "no name of image 1 of 'means'"),
        ("means.files", ["means_l.webp", "none.webp"], "no file 'none.webp' in it"),
        (
            "means.files",
            ["means_l.webp", "shN_centroids.webp"],
            "an image 'shN_centroids.webp' of 192x1 pixels|broadcast",
        ),
        ("means.mins", [0, 1], "mins that are not 3 numbers"),
        ("means.mins", [0, 1, 10**400], "too large"),
        ("scales.codebook", [0.0] * 255, "codebook that are not 256 numbers"),
        ("scales.codebook", [0.0] * 255 + ["a"], "codebook that are not 256 numbers"),
        ("quats.files", ["sh0.webp"], "a rotation marked"),
        ("shN.bands", 4, "bands 4, at most 3"),
        ("shN.bands", 2, "an image 'shN_centroids.webp' of 192x1 pixels, expected 512x1"),
        ("shN.count", 3, "into a palette of 3"),
        ("shN.count", 70000, "count of the palette 70000, at most 65536"),
    ],
)
def test_what_meta_json_says_is_checked(tmp_path, way, value, sentence):
    meta, files = parts(tmp_path)
    *keys, last = way.split(".")
    value_at(meta, keys)[last] = value
    (tmp_path / "b.sog").write_bytes(sog_bytes(meta, files))
    refusal(lambda: load_gaussians(tmp_path / "b.sog"), match=sentence)


def scales(*shape, **options):
    """An image in place of the scales'."""
    return "scales.webp", webp_bytes(np.zeros(shape, np.uint8), **options)


@pytest.mark.parametrize(
    ("name", "data", "sentence"),
    [
        ("scales.webp", None, "no file 'scales.webp' in it"),
        ("scales.webp", b"", "an image 'scales.webp' that is no WebP"),
        ("scales.webp", scales(8, 4, 3)[1][:-9], "image 'scales.webp'"),
        (*scales(4, 4, 3), "an image 'scales.webp' of 4x4 pixels, expected 8x4"),
        (*scales(4, 8, 3, lossless=False), "whose compression changes values"),
        (*scales(4, 8, 4, lossless=False), "whose compression changes values"),
        (*scales(9000, 9000, 3), "of 9000x9000 pixels, expected 8x4"),
        ("meta.json", b"[]", "JSON that is no object"),
        ("meta.json", b"{", "damaged"),
        ("meta.json", b" " * 2**21, "'meta.json' expands to more than 1048576 bytes"),
    ],
)
@pytest.mark.parametrize("compression", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_what_the_archive_holds_is_checked(tmp_path, name, data, sentence, compression):
    meta, files = parts(tmp_path)
    meta, changed = (data, {}) if name == "meta.json" else (meta, {name: data})
    files = {name: data for name, data in (files | changed).items() if data is not None}
    (tmp_path / "b.sog").write_bytes(sog_bytes(meta, files, compression))
    refusal(lambda: load_gaussians(tmp_path / "b.sog"), match=sentence)


def test_archives_of_others_are_read(tmp_path):
    """Deflated, with images in another order and of another size, and a folder's entry."""
    meta, files = parts(tmp_path)
    before = load_gaussians(tmp_path / "a.sog", report=silent).splats
    for name in ("means_l.webp", "means_u.webp", "scales.webp", "quats.webp", "sh0.webp", "shN_labels.webp"):
        rows = sog_parts(tmp_path / "a.sog")[1][name].reshape(-1, 4)[:20]
        files[name] = webp_bytes(np.pad(rows, ((0, 15), (0, 0))).reshape(7, 5, 4))
    data = sog_bytes(meta, dict(reversed(files.items())), zipfile.ZIP_DEFLATED)
    (tmp_path / "b.sog").write_bytes(data)
    np.testing.assert_equal(before, load_gaussians(tmp_path / "b.sog", report=silent).splats)
    (tmp_path / "b.sog").write_bytes(sog_bytes(meta, files, zipfile.ZIP_BZIP2))
    refusal(lambda: load_gaussians(tmp_path / "b.sog"), "in another compression than deflate")
