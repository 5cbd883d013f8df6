"""``warp-splat export-html``: one file with the Gaussians, the cameras and the program that draws them."""

import base64
import hashlib
import json
from html import escape
from importlib import resources
from pathlib import Path
from string import Template

import numpy as np

from warp_splat import config as constants
from warp_splat.camera import Camera, mean_up
from warp_splat.color import TOE
from warp_splat.config import ExportHtmlConfig
from warp_splat.errors import InputError
from warp_splat.export_html import pack
from warp_splat.export_html.merge import merged
from warp_splat.formats import model_folder
from warp_splat.formats.coordinates import UP, read_coordinates
from warp_splat.formats.exposures import read_exposures
from warp_splat.formats.files import write_text
from warp_splat.formats.splats import SplatArrays
from warp_splat.kernels import falloff, harmonics
from warp_splat.rendering.camera_paths import overview

SHADERS = ("screen.glsl", "project.glsl", "outline.glsl", "blend.glsl", "resolve.glsl")
HARMONICS = ("C0", "C1", "C2A", "C2B", "C2C", "C3A", "C3B", "C3C", "C3D", "C3E")
STEPS = ("LOG_STEPS", "ROTATION_STEPS", "COLOR_STEPS", "HARMONIC_STEPS")
SCRIPTS = ("camera.js", "renderer.js", "viewer.js")
LONGEST = 2**29  # characters of Gaussians in a page: none larger was ever tried
MOST_MOVING = 3 * pack.CHUNK  # Gaussians drawn as they are while the camera moves
LARGE = 100  # MB: a page above it is called large


def export_html(config: ExportHtmlConfig) -> int:
    """Write the page as ``config`` says; returns the process's exit code.

    Raises:
        InputError: if the model cannot be read, is too large for browsers, or the page cannot be written.
    """
    path = Path(config.page)
    model_folder.check_output(path, endings=(".html", ".htm"))
    iteration, file, trained = model_folder.open_model(config.model, crop=config.crop)
    cameras = [*model_folder.read_refined(config.model, iteration).items()]
    cameras = cameras or model_folder.read_cameras(model_folder.folder_of(config.model))
    kept = pack.shown(file.splats, config.max_gaussians)
    up = UP if read_coordinates(model_folder.folder_of(config.model)) or file.coordinates else None
    options = {
        "ANTIALIASED": bool(trained.get("antialiasing")),
        "ELLIPSOID": trained.get("projection") == "ellipsoid",
        "LINEAR": bool(trained.get("linear_light")),
        "BACKGROUND": float(bool(trained.get("white_background"))),
    }
    behind, exposures = (read(config.model, iteration) for read in (model_folder.read_environment, read_exposures))
    page = make_page(
        Path(config.model).resolve().name, kept, cameras or [("start", overview(kept.means)[0])], options, up
    )
    write_text(path, page)
    size, total = len(page) / 1e6, len(file.splats.means)
    print(f"{path}: {len(kept.means)} of {total} Gaussians, {len(cameras)} cameras, {size:.1f} MB; for any browser")
    if behind is not None:
        color = "white" if options["BACKGROUND"] else "black"
        print(f"  The page does not have what was learned behind the Gaussians (--parts sky): it is {color} there.")
    if exposures:
        print("  The page shows the mean exposure, not that of each photograph (--parts exposure).")
    if trained.get("projection") == "unscented":
        print("  The page draws by the affine projection, not by the unscented one of the training: it differs.")
    if bent := sum(camera.lens is not None for _, camera in cameras):
        print(f"  {bent} cameras have lenses with distortion; the page shows what pinholes would see from there.")
    if rolling := sum(camera.shutter is not None for _, camera in cameras):
        print(f"  {rolling} cameras have rolling shutters; the page shows what they see when their middle row is read.")
    if size > LARGE:
        print("  This is large, and phones lack the memory; --max_gaussians N keeps the N that matter most.")
    return 0


def make_page(
    name: str,
    splats: SplatArrays,
    cameras: list[tuple[str, Camera]],
    options: dict[str, object],
    up: np.ndarray | None = None,
) -> str:
    """The page's text.

    Args:
        name: its title.
        splats: finite Gaussians.
        cameras: names and cameras, at least one; the first is where the page starts.
        options: how to render: ANTIALIASED, ELLIPSOID, LINEAR (bool; the last: colors are in linear light), BACKGROUND
            (float: 0.0 black, 1.0 white).
        up: [3], away from the ground; by default the mean of the cameras.

    Raises:
        InputError: if there are more Gaussians than browsers take.
    """
    origin = np.median(splats.means, axis=0).astype(np.float64) if len(splats.means) else np.zeros(3)
    count, coarse, starts = len(splats.means), None, np.arange(0)
    if count > pack.CHUNK:
        splats, coarse, starts = merged(splats, pack.CHUNK, [camera for _, camera in cameras])
    parts = {id: base64.b64encode(data).decode() for id, data in pack.parts(splats, origin, coarse).items()}
    if (size := sum(map(len, parts.values()))) > LONGEST:
        raise InputError(
            f"{name}: {count} Gaussians make a page of {size / 1e6:.0f} MB, expected at most "
            f"{LONGEST / 1e6:.0f} MB, which browsers can read; use --max_gaussians."
        )
    before = len(parts) if coarse is None else 1
    texels = pack.texels(splats.sh.shape[1])
    scene = {
        "count": count,
        "chunk": pack.CHUNK,
        "coarse": len(starts),
        # of those, how many are replaced once so many parts of the others are there
        "replaced": np.searchsorted(starts, [*range(0, count, pack.CHUNK), count]).tolist(),
        "moving": MOST_MOVING,
        "harmonics": texels,
        "parts": list(parts),
        "before": before,
        "near": constants.NEAR,
        "origin": origin.tolist(),
        "up": (mean_up([camera for _, camera in cameras]) if up is None else up).tolist(),
        "cameras": [{"name": name, **model_folder.camera_entry(camera)} for name, camera in cameras],
    }
    blocks = {file: _source(file) for file in (*SHADERS, "sort.js")}
    blocks["constants.glsl"] = _constants({"HARMONICS": texels, **options})
    blocks["scene"] = json.dumps(scene, allow_nan=False).replace("<", "\\u003c")
    blocks |= dict(list(parts.items())[:before])
    # no module: those wait for the whole page
    script = "\n".join(["(async () => {", '"use strict";', *map(_source, SCRIPTS), "})();"])
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return Template(_source("viewer.html")).substitute(
        # no other script runs, and nothing is fetched, even if a stranger's file holds one in a name
        policy=f"default-src 'none'; script-src 'sha256-{digest}'; worker-src blob:; style-src 'unsafe-inline'",
        title=escape(name),
        background="#fff" if options["BACKGROUND"] else "#000",
        blocks=_blocks(blocks),
        script=script,
        rest=_blocks(dict(list(parts.items())[before:])),
    )


def _blocks(texts: dict[str, str]) -> str:
    """What the program reads, by id."""
    return "\n".join(f'<script type="text/plain" id="{id}">{text}</script>' for id, text in texts.items())


def _source(name: str) -> str:
    return resources.files("warp_splat.export_html").joinpath(name).read_text(encoding="utf-8")


def _constants(options: dict[str, object]) -> str:
    """The renderer's constants and the options as declarations of GLSL."""
    names = ("ALPHA_MIN", "ALPHA_MAX", "NEAR", "BLUR", "COMPENSATION_MIN", "FRUSTUM_MARGIN", "OUTLINE", "OUTLINE_REACH")
    values = {name: getattr(constants, name) for name in names}
    values |= {name: getattr(harmonics, name) for name in HARMONICS}
    values |= {name: float(getattr(pack, name)) for name in STEPS}
    values |= {"LOG2_E": float(falloff.LOG2_E), "TOE": TOE, **options}
    return "\n".join(f"const {type(value).__name__} {name} = {str(value).lower()};" for name, value in values.items())
