"""PLY files: bytes against the documented layout, other writers' files, damaged files, and full disks."""

import struct

import numpy as np
import pytest
from hostile import refusal, replace
from splat_files import some_splats

from warp_splat.errors import InputError
from warp_splat.formats.files import atomic_write
from warp_splat.formats.ply import load_ply, load_points, save_ply, save_points
from warp_splat.formats.splats import SplatFile

REST = {1: 0, 4: 9, 9: 24, 16: 45}


def reference_names(coefficients):
    rest = [f"f_rest_{index}" for index in range(REST[coefficients])]
    dc = ["f_dc_0", "f_dc_1", "f_dc_2"]
    tail = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    return ["x", "y", "z", "nx", "ny", "nz", *dc, *rest, *tail]


def packed(means, sh, opacities, scales, quats, comments=()):
    """The file as the documentation of the format describes it, one value after the other."""
    names = reference_names(sh.shape[1])
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    header += [f"element vertex {len(means)}", *(f"property float {name}" for name in names), "end_header", ""]
    data = "\n".join(header).encode()
    for row in range(len(means)):
        values = [*means[row], 0, 0, 0, *sh[row, 0]]
        for channel in range(3):
            values += [sh[row, k, channel] for k in range(1, sh.shape[1])]
        values += [opacities[row], *scales[row], *quats[row]]
        data += struct.pack(f"<{len(names)}f", *values)
    return data


@pytest.mark.parametrize("coefficients", REST)
@pytest.mark.parametrize("count", [0, 1, 7])
def test_bytes_are_the_documented_layout(tmp_path, count, coefficients):
    splats = some_splats(count, coefficients)
    save_ply(tmp_path / "a.ply", SplatFile(splats, antialiased=True))
    assert (tmp_path / "a.ply").read_bytes() == packed(*splats, comments=("SplatRenderMode: mip",))
    for before, after in zip(splats, load_ply(tmp_path / "a.ply").splats, strict=True):
        assert after.dtype == np.float32
        np.testing.assert_array_equal(before, after)


def named(means, sh, opacities, scales, quats):
    """The values of each Gaussian by property name, without normals."""
    for row in range(len(means)):
        rest = [sh[row, k, channel] for channel in range(3) for k in range(1, sh.shape[1])]
        values = [*means[row], *sh[row, 0], *rest, opacities[row], *scales[row], *quats[row]]
        names = [name for name in reference_names(sh.shape[1]) if name[0] != "n"]
        yield dict(zip(names, map(float, values), strict=True))


def foreign(kind, splats, first="", end="\n"):
    """Another writer's file: doubles in another order, a label among them, and the rows of ``first`` before them."""
    rows = list(named(*splats))
    names = list(rows[0])
    np.random.default_rng(1).shuffle(names)
    header = ["ply", f"format {kind} 1.0", "comment caf\xe9", "obj_info a tool"]
    header += ["element camera 2", "property int32 id", "property uint8 kind"] if first else []
    header += [f"element vertex {len(rows)}", f"property float64 {names[0]}", "property uchar label"]
    header += [f"property double {name}" for name in names[1:]]
    header += ["element face 1", "property list uchar int vertex_indices", "end_header", ""]
    data = end.join(header).encode("latin-1")
    table = [(row[names[0]], 7, *(row[name] for name in names[1:])) for row in rows]
    if kind == "ascii":
        lines = (["-1 2", "3 4"] if first else []) + [" ".join(map(repr, row)) for row in table] + ["3 0 1 2"]
        return data + end.join(lines).encode()
    order = "<" if kind == "binary_little_endian" else ">"
    data += struct.pack(f"{order}iBiB", -1, 2, 3, 4) if first else b""
    data += b"".join(struct.pack(f"{order}dB{len(names) - 1}d", *row) for row in table)
    return data + struct.pack(f"{order}B3i", 3, 0, 1, 2)


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("first", ["", "camera"])
@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_reads_by_name_in_any_order_without_normals(tmp_path, kind, first, end):
    splats = some_splats(5, 4)
    (tmp_path / "b.ply").write_bytes(foreign(kind, splats, first, end))
    for before, after in zip(splats, load_ply(tmp_path / "b.ply").splats, strict=True):
        assert after.dtype == np.float32 and after.dtype.isnative
        np.testing.assert_array_equal(before, after)


def ascii_splats(rows, count=None):
    names = reference_names(1)
    header = ["ply", "format ascii 1.0", f"element vertex {len(rows) if count is None else count}"]
    return "\n".join([*header, *(f"property float {name}" for name in names), "end_header", *rows])


def test_text_without_rows_or_with_numbers_that_do_not_fit(tmp_path):
    path = tmp_path / "a.ply"
    path.write_text(ascii_splats(["", ""], 0))
    assert len(load_ply(path).splats.means) == 0
    path.write_text(ascii_splats(["1 " * 17, "1 " * 16 + "1e300", "nan " * 17, "-inf " * 17, "2 " * 17]))
    lines = []
    np.testing.assert_array_equal(load_ply(path, report=lines.append).splats.means[:, 0], [1, 2])
    assert len(lines) == 1 and "3 of 5" in lines[0]


@pytest.mark.parametrize(
    "rows",
    [
        ["1 " * 17, "1 " * 16],
        ["1 " * 17, "1 " * 18],
        ["1 " * 17, ""],
        ["1 " * 17, " " * 40],
        ["1 " * 40],
        ["1 " * 17, "1 " * 16 + "one"],
        ["1 " * 17, "1 " * 16 + "\x00"],
    ],
)
def test_bad_rows_of_a_text(tmp_path, rows):
    (tmp_path / "a.ply").write_text(ascii_splats(rows, 2))
    refusal(lambda: load_ply(tmp_path / "a.ply"), "a.ply: the file is damaged or cut short")


def test_rows_that_are_not_finite_are_left_out_and_counted(tmp_path):
    splats, lines = some_splats(6, 4), []
    splats.sh[1, 3, 2], splats.scales[4] = np.nan, np.float32(2.0)
    splats.quats[4] = 0.0
    save_ply(tmp_path / "a.ply", SplatFile(splats))
    loaded = load_ply(tmp_path / "a.ply", report=lines.append)
    np.testing.assert_array_equal(loaded.splats.means, splats.means[[0, 2, 3, 5]])
    assert len(lines) == 1 and "2 of 6" in lines[0]


def test_points_are_as_the_reference_writes_them(tmp_path):
    points = np.array([[1.5, -2, 3], [4, 5, 6]])
    colors = np.array([[0, 128, 255], [1, 2, 3]], np.uint8)
    save_points(tmp_path / "input.ply", points, colors)
    names = [f"float {name}" for name in "x y z nx ny nz".split()] + ["uchar red", "uchar green", "uchar blue"]
    header = ["ply", "format binary_little_endian 1.0", "element vertex 2", *(f"property {name}" for name in names)]
    rows = b"".join(struct.pack("<6f3B", *point, 0, 0, 0, *color) for point, color in zip(points, colors, strict=True))
    assert (tmp_path / "input.ply").read_bytes() == "\n".join([*header, "end_header", ""]).encode() + rows


def test_points_that_are_not_finite_are_left_out_and_counted(tmp_path):
    points, lines = np.array([[1.5, -2, 3], [np.nan, 5, 6]]), []
    save_points(tmp_path / "a.ply", points, np.full((2, 3), 7, np.uint8))
    found, colors = load_points(tmp_path / "a.ply", report=lines.append)
    np.testing.assert_array_equal(found, points[:1])
    assert colors.tolist() == [[7] * 3] and len(lines) == 1 and "1 of 2 points that are not finite" in lines[0]


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (b"property float opacity\n", b"property float alpha\n", "properties opacity are missing"),
        (b"property float scale_2\n", b"", "scale_2"),
        (b"property float f_rest_8\n", b"", "0, 9, 24 or 45"),
        (b"f_rest_8\n", b"f_rest_9\n", "f_rest_8"),
        (b"element vertex 3", b"element point 3", "'vertex', found none"),
        (b"element vertex 3", b"element vertex 4", "cut short"),
        (b"element vertex 3", b"element vertex 1000000000000", "cut short .1000000000000 rows of 'vertex' need"),
        (b"element vertex 3", b"element vertex 99999999999999", "cut short"),
        (b"element vertex 3", b"element vertex " + b"9" * 5000, "the header line 'element vertex 999"),
        (b"element vertex 3", b"element vertex -1", "a.ply"),
        (b"element vertex 3", b"element vertex x", "expected a PLY file"),
        (b"element vertex 3", b"element camera 1000000000000\nproperty int id\nelement vertex 3", "cut short"),
        (b"element vertex 3", b"element face 1\nproperty list uchar int i\nelement vertex 3", "a list property"),
        (b"element vertex 3", b"element vertex 3\nelement point 3", "a.ply"),
        (b"element vertex 3\n", b"", "the header line 'property float x'"),
        (b"property float x\n", b"property list uchar float x\n", "a list property"),
        (b"property float x\n", b"property float x\n" * 2, "the header line 'property float x'"),
        (b"element vertex 3\n", b"\n", "the header line ''"),
        (b"ply\n", b"png\n", "expected a PLY file"),
        (b"format binary_little_endian 1.0\n", b"", "no line 'format'"),
        (b"format binary_little_endian", b"format binary_middle_endian", "expected a PLY file"),
        (b"format binary_little_endian", b"format ascii", "damaged or cut short"),
        (b"property float x\n", b"property \xff x\n", "expected a PLY file"),
        (b"end_header\n", b"comment\n" * 10**6, "no line 'end_header' within"),
        (b"end_header\n", b"comment " * 10**6, "no line 'end_header' within"),
    ],
)
def test_bad_headers(tmp_path, old, new, sentence):
    save_ply(tmp_path / "a.ply", SplatFile(some_splats(3, 4)))
    replace(tmp_path / "a.ply", old, new)
    refusal(lambda: load_ply(tmp_path / "a.ply"), match=sentence)


@pytest.mark.parametrize("count", [10**12, 10**15 - 1])
def test_a_count_that_lies_fails_at_once_in_a_text(tmp_path, count):
    (tmp_path / "a.ply").write_text(ascii_splats(["1 " * 17], count))
    refusal(lambda: load_ply(tmp_path / "a.ply"), match=rf"a\.ply.*cut short .{count} rows of 'vertex' need")


def test_missing_file_and_folder(tmp_path):
    refusal(lambda: load_ply(tmp_path / "none.ply"), "no such file")
    refusal(lambda: load_ply(tmp_path), "could not be read")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda s: s._replace(opacities=s.opacities[:, None]), "opacities: expected shape"),
        (lambda s: s._replace(sh=s.sh[:, :5]), "sh: expected shape"),
    ],
)
def test_shapes_are_checked(tmp_path, change, sentence):
    refusal(lambda: save_ply(tmp_path / "a.ply", SplatFile(change(some_splats()))), match=sentence)
    refusal(lambda: save_points(tmp_path / "a.ply", some_splats().means, some_splats().means[:2]), "points, colors")
    assert not list(tmp_path.iterdir())


def test_atomic_write_refuses_a_folder_before_anything_is_written(tmp_path):
    (tmp_path / "a.gltf").mkdir()
    with pytest.raises(InputError, match="could not be written"), atomic_write(tmp_path / "a.gltf"):
        (tmp_path / "a.bin").touch()
    assert [path.name for path in tmp_path.iterdir()] == ["a.gltf"]


def test_atomic_write_replaces_a_link_to_a_folder(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "a.txt").symlink_to(tmp_path / "folder")
    with atomic_write(tmp_path / "a.txt") as temporary:
        temporary.write_text("text")
    assert (tmp_path / "a.txt").read_text() == "text" and not list((tmp_path / "folder").iterdir())


def test_atomic_write_reports_a_file_in_the_way(tmp_path):
    (tmp_path / "file").write_text("a file, not a folder")
    refused = pytest.raises(InputError, match="could not be written")
    with refused, atomic_write(tmp_path / "file" / "a.txt") as temporary:
        temporary.write_text("text")
    assert (tmp_path / "file").read_text() == "a file, not a folder"
