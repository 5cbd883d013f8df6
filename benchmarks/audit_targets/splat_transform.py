"""The renderer of splat-transform, a program of npm: pictures by WebGPU.

Without a GPU it draws with SwiftShader, which Chromium brings along, or with Mesa's lavapipe (25.0; 22.3 is refused):
``VK_ICD_FILENAMES`` tells where ``vk_swiftshader_icd.json`` or ``lvp_icd.json`` is, ``LD_LIBRARY_PATH`` where the
libraries are.
"""

import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from warp_splat.audit.program import CACHE, stored, write_files

PACKAGE, PROGRAM = "@playcanvas/splat-transform@2.7.1", CACHE / "node_modules/.bin/splat-transform"
TURNED = np.array([-1.0, -1.0, 1.0])  # its world is turned by half around z against that of the file

if shutil.which("npm") is None:
    raise ImportError("it needs npm")


def draw(means, quats, scales, opacities, sh, camera, background):
    """Larger than asked, so that the middle is the principal point, and cut out."""
    if not np.isclose(camera.fx, camera.fy):
        raise ValueError("its camera has one focal length")
    if not PROGRAM.exists():
        subprocess.run(["npm", "install", "--no-audit", "--no-fund", "--prefix", str(CACHE), PACKAGE], check=True)
    width, height = (2 * max(c, size - c) for c, size in ((camera.cx, camera.width), (camera.cy, camera.height)))
    width, height = round(width), round(height)
    left, top = round(width / 2 - camera.cx), round(height / 2 - camera.cy)
    position, down, forward = camera.center * TURNED, camera.rotation[1] * TURNED, camera.rotation[2] * TURNED
    options = {"camera": position, "look-at": position + forward * max(1.0, np.abs(position).max()), "up": -down}
    options |= {"background": background.tolist(), "fov": [np.degrees(2 * np.arctan(height / 2 / camera.fy))]}
    with tempfile.TemporaryDirectory() as name:
        ply, _ = write_files(Path(name), stored(means, quats, scales, opacities, sh), camera)
        given = [f"--{key}={','.join(f'{value:.17g}' for value in values)}" for key, values in options.items()]
        command = [str(PROGRAM), "-q", *given, f"--resolution={width}x{height}", str(ply), f"{name}/out.webp"]
        done = subprocess.run(command, capture_output=True, text=True)  # noqa: PLW1510
        if done.returncode or not Path(f"{name}/out.webp").exists():
            raise RuntimeError(f"exit code {done.returncode}: {done.stderr[-200:]}")
        picture = np.asarray(Image.open(f"{name}/out.webp").convert("RGB"))
    return picture[top : top + camera.height, left : left + camera.width]
