"""Files of Gaussians by the endings of their names: the one place that knows all formats."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from warp_splat.errors import InputError
from warp_splat.formats.compressed_ply import save_compressed_ply
from warp_splat.formats.gltf import load_gltf, save_gltf
from warp_splat.formats.ply import load_ply, save_ply
from warp_splat.formats.sog import load_sog, save_sog
from warp_splat.formats.splat32 import load_splat, save_splat
from warp_splat.formats.splats import SplatFile, check_shapes, finite_rows
from warp_splat.formats.spz import load_spz, save_spz
from warp_splat.formats.usd import load_usd, save_usd
from warp_splat.text import Report


class Format(NamedTuple):
    """How a kind of file is read and written."""

    load: Callable[[str | Path, Report], SplatFile]
    save: Callable[[str | Path, SplatFile, Report], None]
    marks: tuple[str, ...]  # those of MARKS that it has room for
    along_curve: bool = False  # written in an order in which near Gaussians follow each other
    empty: bool = True  # can say that there are no Gaussians
    harmonics: bool = True  # beyond degree 0


#: What a file may say of all its Gaussians, and how to say that it is lost.
MARKS = {
    "antialiased": "the mark that the Gaussians are antialiased",
    "coordinates": "where they are in the world (coordinates.json)",
    "linear": "that their colors are in linear light",
}
BOTH = ("antialiased", "coordinates")
FORMATS = {
    ".ply": Format(load_ply, save_ply, BOTH),
    ".compressed.ply": Format(load_ply, save_compressed_ply, BOTH, along_curve=True),
    ".splat": Format(load_splat, save_splat, (), empty=False, harmonics=False),
    ".spz": Format(load_spz, save_spz, BOTH[:1]),
    ".sog": Format(load_sog, save_sog, BOTH[:1], along_curve=True, empty=False),
    **dict.fromkeys((".glb", ".gltf"), Format(load_gltf, save_gltf, tuple(MARKS), empty=False)),
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), Format(load_usd, save_usd, BOTH)),
}


def format_of(path: str | Path) -> Format:
    """How a file of this name is read and written.

    Raises:
        InputError: if its ending is not one of FORMATS.
    """
    if not (endings := [ending for ending in FORMATS if Path(path).name.lower().endswith(ending)]):
        found = Path(path).suffix or "no ending"
        raise InputError(f"{path}: expected a name that ends in {', '.join(FORMATS)}, found {found!r}.")
    return FORMATS[max(endings, key=len)]


def load_gaussians(path: str | Path, report: Report = print) -> SplatFile:
    """Read Gaussians of any format, in the frame of their training, but those not finite and those without a rotation.

    Args:
        path: a file of one of FORMATS.
        report: called with a line for each thing that the user should know: values left out, ...

    Raises:
        InputError: if the file is missing, damaged, or of another format than its name says.
    """
    file = format_of(path).load(path, report)
    return file._replace(splats=finite_rows(file.splats, path, report))


def save_gaussians(path: str | Path, file: SplatFile, report: Report = print) -> SplatFile:
    """Write Gaussians in the format that the name asks for.

    Args:
        path: the file to write.
        file: the Gaussians, finite and with rotations.
        report: called with a part of a sentence for each kind of value that the format cannot hold, and each of MARKS.

    Returns:
        The Gaussians in the order in which they were written.

    Raises:
        InputError: if the ending is unknown, a shape disagrees with the others, there are no Gaussians and the format
            cannot say so, or the file cannot be written.
    """
    check_shapes(file.splats)
    if not ((form := format_of(path)).empty or len(file.splats.means)):
        raise InputError(f"{path}: there are no Gaussians, and such a file cannot say so; choose another format.")
    if form.along_curve:
        from warp_splat.formats.curve import arranged  # noqa: PLC0415 - torch takes seconds to load

        file = file._replace(splats=arranged(file.splats))
    form.save(path, file, report)
    for mark, lost in MARKS.items():
        if getattr(file, mark) and mark not in form.marks:
            report(lost)
    return file
