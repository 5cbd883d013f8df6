"""The page that this package exports."""

from pathlib import Path

from warp_splat.audit.program import screenshot, stored
from warp_splat.export_html.command import make_page
from warp_splat.export_html.pack import shown

OPTIONS = {"ANTIALIASED": False, "ELLIPSOID": False, "LINEAR": False, "BACKGROUND": 0.0}


def draw(means, quats, scales, opacities, sh, camera, background):
    """As this package's exported page."""
    page = make_page("audit", shown(stored(means, quats, scales, opacities, sh).splats), [("00000", camera)], OPTIONS)
    write = lambda folder: (folder / "own.html").write_text(page, encoding="utf-8")  # noqa: E731
    return screenshot(Path(__file__).with_suffix(".html"), camera, write, "own.html")[0]
