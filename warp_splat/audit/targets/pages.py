"""Pages that show a file of Gaussians from a camera: anyone's, and this package's own."""

from __future__ import annotations

import functools
import tempfile
from pathlib import Path

from warp_splat.audit.targets.program import stored, write_files
from warp_splat.audit.targets.web import screenshot
from warp_splat.errors import InputError
from warp_splat.export_html.command import make_page
from warp_splat.export_html.pack import shown


def draw_by_page(page: str):
    """A function that draws with a page whose ``window.show(camera, address)`` shows a PLY file from a camera.

    The camera is as ``cameras.json`` has it. The page stands beside its scripts, and asks for packages of npm by
    ``<meta name="npm" content="three@0.187.0">``: they are installed, and served as ``/node_modules``.

    Raises:
        InputError: if there is no such page.
    """
    if not Path(page).is_file():
        raise InputError(f"{page}: expected a page with a function window.show(camera, address), found none.")

    def draw(means, quats, scales, opacities, sh, camera, background):
        file = stored(means, quats, scales, opacities, sh)
        return screenshot(Path(page), camera, lambda folder: write_files(folder, file, camera))[0]

    return draw


#: The exported page's own function, by the name that the browser calls; its buttons would be in the picture.
SHOW = """<script>window.show = async (camera) => {
  while (!window.warpSplat) await new Promise((resolve) => setTimeout(resolve, 20));
  for (const part of document.querySelectorAll("div, button")) part.style.display = "none";
  await window.warpSplat.setCamera(camera);
};</script>"""
OPTIONS = {"ANTIALIASED": False, "ELLIPSOID": False, "LINEAR": False, "BACKGROUND": 0.0}


@functools.cache
def _folder() -> Path:
    return Path(tempfile.mkdtemp())


def as_page(means, quats, scales, opacities, sh, camera, background):
    """As this package's exported page."""
    splats = stored(means, quats, scales, opacities, sh).splats
    page = _folder() / "own.html"
    page.write_text(make_page("audit", shown(splats), [("00000", camera)], OPTIONS) + SHOW, encoding="utf-8")
    return screenshot(page, camera)[0]
