"""Renderers that read files: Gaussians as PLY, cameras as the reference writes them.

A program writes PNG or EXR. A page, in a headless Chromium, shows the file from a camera.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Callable
from functools import cache, partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import torch

from warp_splat.errors import InputError, imported, reason_of
from warp_splat.formats.exchange import save_gaussians
from warp_splat.formats.model_folder import camera_entry
from warp_splat.formats.png import load_png
from warp_splat.formats.splats import SplatArrays, SplatFile

PLACES = ("ply", "cameras", "out", "exr", "background")
LOGIT_MOST = 16.0  # 1 - 1e-7: a file cannot say 1


def stored(means, quats, scales, opacities, sh) -> SplatFile:
    """Activated Gaussians, float32 tensors, as files hold them."""
    logits = torch.logit(opacities.detach().double()).clamp(-LOGIT_MOST, LOGIT_MOST)
    values = (means, sh, logits, scales.detach().double().log(), quats)
    return SplatFile(SplatArrays(*(value.detach().numpy().astype(np.float32) for value in values)))


def write_files(folder: Path, file: SplatFile, camera) -> tuple[Path, Path]:
    """``scene.ply`` and ``cameras.json`` in ``folder``."""
    ply, cameras = folder / "scene.ply", folder / "cameras.json"
    save_gaussians(ply, file)
    cameras.write_text(json.dumps([{"id": 0, "img_name": "00000", **camera_entry(camera)}]), encoding="utf-8")
    return ply, cameras


def draw_by_program(command: str):
    """A function that draws with ``prog {ply} {cameras} {out}``; also ``{background}``, as r,g,b, and ``{exr}``.

    Raises:
        InputError: if the command names no output or no program, has other braces, or a quote without its end.
    """
    try:
        parts = [part.format(**dict.fromkeys(PLACES, "")) for part in shlex.split(command)]
    except (LookupError, AttributeError, TypeError, ValueError):
        parts = []
    if not parts or not ("{out}" in command or "{exr}" in command):
        raise InputError(f"--command: expected {{ply}}, {{cameras}} and {{out}} (or {{exr}}) in it, found {command!r}.")

    if not shutil.which(parts[0]):
        raise InputError(f"--command: expected a program that can be run, found {parts[0]!r}; check its name.")

    def draw(means, quats, scales, opacities, sh, camera, background):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            ply, cameras = write_files(folder, stored(means, quats, scales, opacities, sh), camera)
            places = {"ply": ply, "cameras": cameras, "out": folder / "out.png", "exr": folder / "out.exr"}
            places["background"] = ",".join(f"{value:g}" for value in background.tolist())
            done = subprocess.run([part.format(**places) for part in shlex.split(command)], capture_output=True)  # noqa: PLW1510
            if done.returncode:
                said = reason_of(done.stderr.decode(errors="replace")[-200:])
                raise RuntimeError(f"exit code {done.returncode}: {said}")
            if places["out"].exists():
                return load_png(places["out"])
            if not places["exr"].exists():
                raise RuntimeError("it ended well and wrote no picture")
            import OpenImageIO as oiio  # noqa: PLC0415 - seldom needed

            return np.asarray(oiio.ImageBuf(str(places["exr"])).get_pixels(oiio.FLOAT))[..., :3]

    return draw


#: Without those of the second line, it draws a frame a second.
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
FLAGS += ["--disable-frame-rate-limit", "--disable-gpu-vsync"]
CACHE = Path.home() / ".cache" / "warp_splat" / "web"  # where npm puts what it is asked for
PACKAGES = re.compile(r'<meta name="npm" content="([^"]*)"')
SHOW = """async ([camera, file]) => {
  while (!window.show) await new Promise((resolve) => setTimeout(resolve, 20));
  return await window.show(camera, file);
}"""


class _Handler(SimpleHTTPRequestHandler):
    """Says nothing, and lets no scene be kept: the next has the same name, maybe within the same second."""

    def end_headers(self):
        self.send_header("Cache-Control", "max-age=3600" if self.path.startswith("/node_modules") else "no-store")
        super().end_headers()

    def log_message(self, *_):
        pass


@cache
def _playwright():
    """Started once: after a browser that could not be started, a second start would raise something else."""
    problem = "playwright: it drives the browser, and is not there; pip install playwright."
    return imported("playwright.sync_api", problem).sync_playwright().start()


@cache
def _browser():
    """Playwright's browser, the folder that is served, and its address."""
    started, folder = _playwright(), Path(tempfile.mkdtemp())
    (folder / "node_modules").symlink_to(CACHE / "node_modules")
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Handler, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    found = os.environ.get("WARP_SPLAT_CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    browser = started.chromium.launch(executable_path=found, args=FLAGS)
    return browser, folder, f"http://127.0.0.1:{server.server_port}"


def _missing(page: Path) -> list[str]:
    """The packages that a page asks for and that are not there."""
    packages = " ".join(PACKAGES.findall(page.read_text(encoding="utf-8", errors="replace"))).split()
    return [name for name in packages if not (CACHE / "node_modules" / name.rsplit("@", 1)[0]).exists()]


def screenshot(page: Path, camera, write: Callable[[Path], object], file: str = "scene.ply"):
    """What ``page`` shows of the ``file`` that ``write`` puts into a folder, [H, W, 3] uint8; what ``show`` returns.

    Raises:
        InputError: if there is no playwright.
    """
    if missing := _missing(page):
        CACHE.mkdir(parents=True, exist_ok=True)
        subprocess.run(["npm", "install", "--no-audit", "--no-fund", "--prefix", str(CACHE), *missing], check=True)
    browser, folder, address = _browser()
    (folder / "page").unlink(missing_ok=True)
    (folder / "page").symlink_to(page.parent.resolve())
    write(folder)
    with browser.new_page(viewport={"width": camera.width, "height": camera.height}) as tab:  # the last may hang
        tab.goto(f"{address}/page/{page.name}")
        returned = tab.evaluate(SHOW, [camera_entry(camera), f"/{file}"])
        tab.screenshot(path=folder / "screen.png")
    return load_png(folder / "screen.png"), returned


def draw_by_page(page: str):
    """A function that draws with a page whose ``window.show(camera, address)`` shows a PLY file from a camera.

    The camera is as ``cameras.json`` has it. The page stands beside its scripts, and asks for packages of npm by
    ``<meta name="npm" content="three@0.187.0">``: they are installed, and served as ``/node_modules``.

    Raises:
        InputError: if there is no such page, or no npm to fetch what it asks for.
    """
    if not Path(page).is_file():
        raise InputError(f"{page}: expected a page, found no such file; check the path.")
    if _missing(Path(page)) and not shutil.which("npm"):
        raise InputError(f"{page}: expected npm, which fetches {', '.join(_missing(Path(page)))}; install Node.js.")

    def draw(means, quats, scales, opacities, sh, camera, background):
        file = stored(means, quats, scales, opacities, sh)
        return screenshot(Path(page), camera, lambda folder: write_files(folder, file, camera))[0]

    return draw
