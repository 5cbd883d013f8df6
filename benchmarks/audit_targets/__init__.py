"""Renderers that have a name: an adapter is a file of this folder and a line of this table."""

from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from warp_splat.config import ADJOINTS


class NamedRenderer(NamedTuple):
    """How a renderer is called, and what it claims."""

    place: str  # MODULE:function, or a page
    package: str = "warp-splat"  # whose version the table tells
    settings: str = ""
    degree: int = 3  # of harmonics, the highest that it claims

    @property
    def version(self) -> str:
        """Its package and that one's version: what is installed by pip, or named after an @, by npm."""
        return self.package.replace("@", " ") if "@" in self.package else f"{self.package} {self._installed}"

    @property
    def _installed(self) -> str:
        try:
            return metadata.version(self.package)
        except metadata.PackageNotFoundError:
            return "?"


FOLDER, WEBGL = Path(__file__).parent, "WebGL in software"
OURS = {
    "manual": NamedRenderer("audit_targets.own:manual", settings="adjoint by hand"),
    "stepwise": NamedRenderer("audit_targets.own:stepwise", settings="adjoint stepwise"),
    "reversible": NamedRenderer("audit_targets.own:reversible", settings="adjoint reversible"),
    "stored": NamedRenderer("audit_targets.own:stored", settings="adjoint stored"),
    "tape": NamedRenderer("audit_targets.own:on_tape", settings="on Warp's tape"),
    "gsplat-function": NamedRenderer("audit_targets.own:as_gsplat", settings="warp_splat.gsplat.rasterization"),
    "page": NamedRenderer("audit_targets.own_page:draw", settings=f"export-html, {WEBGL}"),
}
OTHERS = {
    "gsplat-torch": NamedRenderer(
        "audit_targets.gsplat_torch:reference", "gsplat", "_torch_impl.py; its loop over pixels by us"
    ),
    "newton": NamedRenderer("audit_targets.newton:newton", "newton", "SensorCamera as it is delivered", 0),
    "newton-blended": NamedRenderer(
        "audit_targets.newton:newton_blended", "newton", "QUALITY, min_response 1/255, transmittance 1", 0
    ),
    "mujoco-warp": NamedRenderer("audit_targets.mujoco:draw", "mujoco-warp", "a scene of splats alone", 0),
    "playcanvas": NamedRenderer(f"{FOLDER}/playcanvas.html", "playcanvas@2.23.3", WEBGL),
    "spark": NamedRenderer(f"{FOLDER}/spark.html", "spark@2.2.0", f"three.js 0.187.0, {WEBGL}"),
    "babylon": NamedRenderer(f"{FOLDER}/babylon.html", "babylonjs@9.35.0", WEBGL),
    "mkkellogg": NamedRenderer(f"{FOLDER}/mkkellogg.html", "gaussian-splats-3d@0.4.7", f"three.js 0.187.0, {WEBGL}", 2),
    "gsplat-js": NamedRenderer(f"{FOLDER}/gsplat_js.html", "gsplat@1.2.9", f"no fading in, {WEBGL}", 0),
    "gsplat-js-padded": NamedRenderer(
        f"{FOLDER}/gsplat_js_padded.html", "gsplat@1.2.9", f"1,024 Gaussians without opacity added, {WEBGL}", 0
    ),
    "splat-transform": NamedRenderer(
        "audit_targets.splat_transform:draw", "splat-transform@2.7.1", "a .webp by WebGPU in software (SwiftShader)"
    ),
    **{
        f"{mode}-cuda": NamedRenderer(f"audit_targets.own_cuda:{mode}", settings=f"adjoint {mode}, on a GPU")
        for mode in ADJOINTS
    },
    "gsplat-cuda": NamedRenderer("audit_targets.gsplat_cuda:draw", "gsplat", "rasterization"),
    "diff-gaussian": NamedRenderer("audit_targets.diff_gaussian:draw", "diff-gaussian-rasterization"),
    "fvdb": NamedRenderer("audit_targets.fvdb_cuda:draw", "fvdb-core", "render_images"),
}
