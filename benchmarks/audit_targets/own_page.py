"""The page that this package exports."""

import functools
import tempfile
from pathlib import Path

from warp_splat.audit.program import screenshot, stored
from warp_splat.export_html.command import make_page
from warp_splat.export_html.pack import shown

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


def draw(means, quats, scales, opacities, sh, camera, background):
    """As this package's exported page."""
    splats = stored(means, quats, scales, opacities, sh).splats
    page = _folder() / "own.html"
    page.write_text(make_page("audit", shown(splats), [("00000", camera)], OPTIONS) + SHOW, encoding="utf-8")
    return screenshot(page, camera, lambda folder: None)[0]
