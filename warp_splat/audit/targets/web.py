"""Viewers in a headless Chromium: a page of this folder for each, which shows a PLY file from a camera."""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import tempfile
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path

from warp_splat.audit.targets.program import stored, write_files
from warp_splat.errors import InputError
from warp_splat.export_html.command import make_page
from warp_splat.export_html.pack import shown
from warp_splat.formats.model_folder import camera_entry
from warp_splat.formats.png import load_png

FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
CACHE = Path.home() / ".cache" / "warp_splat" / "web"  # where npm puts what it is asked for
#: A viewer's page has ``show``; our own has buttons, which would be in the picture.
SHOW = """async (camera) => {
  while (!window.show && !window.warpSplat) await new Promise((resolve) => setTimeout(resolve, 20));
  if (!window.show) for (const part of document.querySelectorAll("div, button")) part.style.display = "none";
  await (window.show ?? window.warpSplat.setCamera)(camera);
}"""
OPTIONS = {"ANTIALIASED": False, "ELLIPSOID": False, "LINEAR": False, "BACKGROUND": 0.0}


class _Handler(SimpleHTTPRequestHandler):
    """Says nothing, and lets nothing be kept: the next scene has the same name, maybe within the same second."""

    def end_headers(self):
        self.send_header("Cache-Control", "no-store")
        super().end_headers()

    def log_message(self, *_):
        pass


@functools.cache
def _browser(packages: tuple[str, ...]):
    """A page of playwright's, the folder that is served, and its address; what the viewer needs is installed."""
    try:
        from playwright.sync_api import sync_playwright  # noqa: PLC0415 - seldom there
    except ImportError as error:
        raise InputError("playwright: it drives the browser, and is not there; pip install playwright.") from error
    folder = Path(tempfile.mkdtemp())
    missing = [name for name in packages if not (CACHE / "node_modules" / name.rsplit("@", 1)[0]).exists()]
    if missing:
        CACHE.mkdir(parents=True, exist_ok=True)
        subprocess.run(["npm", "install", "--no-audit", "--no-fund", "--prefix", str(CACHE), *missing], check=True)
    (folder / "node_modules").symlink_to(CACHE / "node_modules")
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Handler, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    found = os.environ.get("WARP_SPLAT_CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    browser = sync_playwright().start().chromium.launch(executable_path=found, args=FLAGS)
    return browser.new_page(), folder, f"http://127.0.0.1:{server.server_port}"


def _screenshot(packages: tuple[str, ...], name: str, camera, write) -> object:
    """What the page shows after ``write`` put its files into the folder, [H, W, 3] uint8."""
    page, folder, address = _browser(packages)
    write(folder)
    page.set_viewport_size({"width": camera.width, "height": camera.height})
    page.goto(f"{address}/{name}.html")
    page.evaluate(SHOW, camera_entry(camera))
    page.screenshot(path=folder / "screen.png")
    return load_png(folder / "screen.png")


def own_page(means, quats, scales, opacities, sh, camera, background):
    """This package's exported page."""
    splats = stored(means, quats, scales, opacities, sh).splats

    def write(folder: Path) -> None:
        text = make_page("audit", shown(splats), [("00000", camera)], OPTIONS)
        (folder / "own.html").write_text(text, encoding="utf-8")

    return _screenshot((), "own", camera, write)


def _viewer(name: str, packages: tuple[str, ...], *given):
    *gaussians, camera, _ = given

    def write(folder: Path) -> None:
        write_files(folder, stored(*gaussians), camera)
        for file in (f"{name}.html", "camera.js"):
            page = resources.files("warp_splat.audit.targets").joinpath(file)
            (folder / file).write_bytes(page.read_bytes())

    return _screenshot(packages, name, camera, write)


spark = partial(_viewer, "spark", ("three@0.187.0", "@sparkjsdev/spark@2.2.0"))
