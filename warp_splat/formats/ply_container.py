"""What a PLY file is made of: a header in words, and tables of numbers with names, binary or as text.

Own code, since no permissively licensed reader of arbitrary properties is well kept.
"""

import os
from collections.abc import Iterable, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from warp_splat.formats.files import Unexpected, atomic_write

HEADER_BYTES = 64 * 1024  # forty times the longest header of the reference: no damaged file is searched to its end
COUNT_DIGITS = 15  # more rows than any disk holds, and sums of such counts stay below 2**63
BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
TYPES |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
TYPES |= {"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"}
LIST = "list"  # in place of a NumPy type
ANTIALIASED = "SplatRenderMode: mip"  # the comment that Brush and splat-transform write and read
TYPES_WRITTEN = {"f4": "float", "u1": "uchar", "u4": "uint"}


def write_tables(path: str | Path, tables: Mapping[str, np.ndarray], comments: Sequence[str] = ()) -> None:
    """Write tables by the names of their elements, structured arrays of little-endian numbers, binary.

    Raises:
        InputError: if the file cannot be written.
    """
    write_parts(path, {name: (len(rows), rows.dtype) for name, rows in tables.items()}, tables.values(), comments)


def write_parts(
    path: str | Path, tables: Mapping[str, tuple[int, np.dtype]], parts: Iterable[np.ndarray], comments: Sequence[str]
) -> None:
    """:func:`write_tables` of which one knows the rows and the types, and whose rows come in ``parts``."""
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    for element, (count, dtype) in tables.items():
        header += [f"element {element} {count}"]
        header += [f"property {TYPES_WRITTEN[code[1:]]} {name}" for name, code, *_ in dtype.descr]
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join([*header, "end_header", ""]).encode("ascii"))
        for rows in parts:
            file.write(rows.data)


def columns_of(rows: np.ndarray, names: Sequence[str], dtype: str = "f4") -> np.ndarray:
    """Some columns of a table as [N, len(names)]."""
    table = np.empty((len(rows), len(names)), dtype)
    for place, name in enumerate(names):
        table[:, place] = rows[name]
    return table


class Element(NamedTuple):
    """A table of the file, as the header announces it."""

    rows: int
    properties: dict[str, str]  # from names to NumPy types without byte order, or LIST

    def least_bytes(self, text: bool) -> int:
        """Size of the rows; of a text, if each number has one digit and one separator."""
        return self.rows * sum(2 if text else int(code[1]) for code in self.properties.values())


class PlyTables:
    """An opened PLY file; errors are those that :func:`reading` turns into a sentence.

    Attributes:
        elements: its tables in their order, by name.
        comments: of the header.
    """

    def __init__(self, file: BinaryIO):
        self.file = file
        self.byte_order = None  # "" for a text
        self.comments: list[str] = []
        self.elements: dict[str, Element] = {}
        if self._header_line() != "ply":
            raise Unexpected("another first line than 'ply'")
        last = None
        while (line := self._header_line()) != "end_header":
            match line.split():
                case ["comment" | "obj_info", *words]:
                    self.comments.append(" ".join(words))
                case ["format", name, "1.0"] if name in BYTE_ORDERS:
                    self.byte_order = BYTE_ORDERS[name]
                case ["element", name, count] if (
                    count.isdecimal() and len(count) <= COUNT_DIGITS and name not in self.elements
                ):
                    last = self.elements[name] = Element(int(count), {})
                case ["property", code, name] if last and code in TYPES and name not in last.properties:
                    last.properties[name] = TYPES[code]
                case ["property", "list", _, _, name] if last and name not in last.properties:
                    last.properties[name] = LIST
                case _:
                    raise Unexpected(f"the header line {line[:80]!r}")
        if self.byte_order is None:
            raise Unexpected("no line 'format'")
        self.start = file.tell()

    def rows(self, name: str) -> np.ndarray:
        """The rows of an element, one field for each property.

        Nothing is allocated before the file is known to be long enough for them.
        """
        if name not in self.elements:
            raise Unexpected("none")
        names = list(self.elements)
        *before, element = (self.elements[other] for other in names[: names.index(name) + 1])
        if any(LIST in each.properties.values() for each in (*before, element)):
            raise Unexpected("a list property in it or before it; export one number for each property")
        text = self.byte_order == ""
        skipped = sum(each.least_bytes(text) for each in before)
        needed = skipped + element.least_bytes(text)
        found = os.fstat(self.file.fileno()).st_size - self.start
        if needed > found + text:  # the last line of a text may lack its end
            raise ValueError(f"{element.rows} rows of {name!r:.40} need at least {needed} bytes, found {found}")
        dtype = np.dtype([(each, f"{self.byte_order}{code}") for each, code in element.properties.items()])
        if text:
            self.file.seek(self.start)
            first = sum(each.rows for each in before)
            lines = islice(self.file, first, first + element.rows)
            rows = np.fromiter((tuple(line.split()) for line in lines), dtype)
        else:
            self.file.seek(self.start + skipped)
            rows = np.fromfile(self.file, dtype, element.rows)
        if len(rows) < element.rows:
            raise ValueError(f"found {len(rows)} of {element.rows} rows of {name!r:.40}")
        return rows

    def _header_line(self) -> str:
        if not (line := self.file.readline(HEADER_BYTES - self.file.tell())).endswith(b"\n"):
            raise Unexpected(f"no line 'end_header' within the first {HEADER_BYTES} bytes")
        return line.decode("latin-1").strip()  # any byte is a character; comments may hold them
