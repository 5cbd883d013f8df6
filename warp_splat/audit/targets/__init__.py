"""The renderers that have a name: an adapter is a file of this folder and a line of this table."""

from __future__ import annotations

from importlib import metadata
from typing import NamedTuple


class NamedRenderer(NamedTuple):
    """How a renderer is called, and what it claims."""

    place: str  # MODULE:function, of this folder unless it has dots
    package: str = "warp-splat"  # whose version the table tells
    settings: str = ""
    degree: int = 3  # of harmonics, the highest that it claims
    background: bool = True  # whether one can be asked for

    @property
    def version(self) -> str:
        """Of its package: what is installed by pip, or named after an @, by npm."""
        if "@" in self.package:
            return self.package.rsplit("@", 1)[1]
        try:
            return metadata.version(self.package)
        except metadata.PackageNotFoundError:
            return "?"


TARGETS = {
    "manual": NamedRenderer("own:manual", settings="adjoint by hand"),
    "stepwise": NamedRenderer("own:stepwise", settings="adjoint stepwise"),
    "reversible": NamedRenderer("own:reversible", settings="adjoint reversible"),
    "stored": NamedRenderer("own:stored", settings="adjoint stored"),
    "tape": NamedRenderer("own:on_tape", settings="on Warp's tape"),
    "gsplat-function": NamedRenderer("own:as_gsplat", settings="warp_splat.gsplat.rasterization"),
    "page": NamedRenderer("web:own_page", settings="export-html, WebGL in software", background=False),
    "newton": NamedRenderer("simulators:newton", "newton", "SensorCamera as it is delivered", 0, False),
    "spark": NamedRenderer("web:spark", "spark@2.2.0", "three.js 0.187.0, WebGL in software", background=False),
}
