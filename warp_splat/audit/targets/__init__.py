"""The renderers that have a name: an adapter is a file of this folder and a line of this table."""

from __future__ import annotations

from importlib import metadata
from typing import NamedTuple


class NamedRenderer(NamedTuple):
    """How a renderer is called, and what it claims."""

    place: str  # MODULE:function, a page or a command line
    package: str = "warp-splat"  # whose version the table tells
    settings: str = ""
    degree: int = 3  # of harmonics, the highest that it claims

    @property
    def version(self) -> str:
        """Of its package: what is installed by pip, or named after an @, by npm."""
        if "@" in self.package:
            return self.package.rsplit("@", 1)[1]
        try:
            return metadata.version(self.package)
        except metadata.PackageNotFoundError:
            return "?"


OWN = "warp_splat.audit.targets"
TARGETS = {
    "manual": NamedRenderer(f"{OWN}.own:manual", settings="adjoint by hand"),
    "stepwise": NamedRenderer(f"{OWN}.own:stepwise", settings="adjoint stepwise"),
    "reversible": NamedRenderer(f"{OWN}.own:reversible", settings="adjoint reversible"),
    "stored": NamedRenderer(f"{OWN}.own:stored", settings="adjoint stored"),
    "tape": NamedRenderer(f"{OWN}.own:on_tape", settings="on Warp's tape"),
    "gsplat-function": NamedRenderer(f"{OWN}.own:as_gsplat", settings="warp_splat.gsplat.rasterization"),
    "page": NamedRenderer(f"{OWN}.pages:as_page", settings="export-html, WebGL in software"),
}
