"""A program that reads files: Gaussians as PLY, cameras as the reference writes them; it writes PNG or EXR."""

import json
import shlex
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import torch

from warp_splat.errors import InputError
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
        InputError: if the command names no output, has other braces, or a quote without its end.
    """
    try:
        parts = [part.format(**dict.fromkeys(PLACES, "")) for part in shlex.split(command)]
    except (KeyError, IndexError, ValueError):
        parts = []
    if not parts or not ("{out}" in command or "{exr}" in command):
        raise InputError(f"--command: expected {{ply}}, {{cameras}} and {{out}} (or {{exr}}) in it, found {command!r}.")

    def draw(means, quats, scales, opacities, sh, camera, background):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            ply, cameras = write_files(folder, stored(means, quats, scales, opacities, sh), camera)
            places = {"ply": ply, "cameras": cameras, "out": folder / "out.png", "exr": folder / "out.exr"}
            places["background"] = ",".join(f"{value:g}" for value in background.tolist())
            done = subprocess.run([part.format(**places) for part in shlex.split(command)], capture_output=True)  # noqa: PLW1510
            if done.returncode:
                raise RuntimeError(f"exit code {done.returncode}: {done.stderr.decode(errors='replace')[-200:]}")
            if places["out"].exists():
                return load_png(places["out"])
            if not places["exr"].exists():
                raise RuntimeError("it ended well and wrote no picture")
            import OpenImageIO as oiio  # noqa: PLC0415 - seldom needed

            return np.asarray(oiio.ImageBuf(str(places["exr"])).get_pixels(oiio.FLOAT))[..., :3]

    return draw
