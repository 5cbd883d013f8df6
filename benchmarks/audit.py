"""Which renderer draws what the file says? Every renderer of the table that is there, in small scenes, against float64.

A renderer that was measured before and is not named keeps its row, and so does one that is not there. Minutes for each;
those in a browser take longer.

    python benchmarks/audit.py [TARGET ...] [--scenes one two] [--more] [--pictures 401] [--out docs/benchmarks]
    python benchmarks/audit.py TARGET --more --scenes   # of a row that is there, the camera alone
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from audit_targets import OTHERS, OURS

from warp_splat.audit.command import side_by_side, tell_rules, worst_gradient
from warp_splat.audit.judged import RUNS, measure
from warp_splat.audit.probes import GREEN, NEARLY_ROUND, probe_camera
from warp_splat.audit.renderer import Renderer, RendererFailed, function_of
from warp_splat.audit.rules import find_rules
from warp_splat.audit.small_scenes import REPEATED, SCENES, balls
from warp_splat.camera import Camera
from warp_splat.errors import InputError
from warp_splat.formats.files import write_json, write_text
from warp_splat.formats.png import save_png
from warp_splat.text import table_of

ALL = {**OURS, **OTHERS}
NEARLY = 0.03  # eight levels of a screen
# Of three Gaussians. What they move by is a lattice of a prime's fractions, over which rounding cancels: of colors to 8
# bits (1e-3 px in a single picture), of corners to 1/16 px (1e-2 px).
PICTURES, LATTICE = 101, np.array([1, 39])  # another number of pictures should be a prime, too
DISK = 0.51  # alpha at which the opaque disks of Newton end


def along_rays(arrays: dict[str, np.ndarray], camera: Camera) -> np.ndarray:
    """The cover [H, W] of Gaussians that are not turned, seen along rays: each by its largest alpha along the ray."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)[..., None, :]
    scales = arrays["scales"] * NEARLY_ROUND
    rays, centers = rays / scales, arrays["means"] / scales
    distances = (centers**2).sum(-1) - (rays * centers).sum(-1) ** 2 / (rays**2).sum(-1)  # squared, in deviations
    return 1 - np.prod(1 - arrays["opacities"] * np.exp(-0.5 * distances), -1)


def camera_error(renderer: Renderer, degree: int, pictures: int = PICTURES) -> list[float]:
    """How far three small Gaussians are from their places, and the standard error: px, the worst of six numbers.

    The picture around each is a share of float64's, and shares of its derivatives by the principal point, by least
    squares; if the Gaussians moved instead, their shapes would change. What rays see is compared with rays, since the
    ellipse of an outline has its middle 0.05 px beside the peak, and an opaque disk with disks a pixel apart.
    """
    try:
        prober = find_rules(renderer.draw, degree, ("background", "camera"))
    except RendererFailed:
        return []
    camera, y, x, found = probe_camera(), *np.mgrid[:47, :63] + 0.5, []
    prober.shift *= 0
    for number in range(pictures):
        wiggle = number * LATTICE % pictures / pictures - 0.5
        places = np.array([[12.5, 10.25], [33.0, 24.75], [52.25, 38.5]]) + wiggle
        arrays = balls(camera, places, [3.0, 3.5, 4.0], 2.0, 0.9, GREEN)
        try:
            seen = prober.cover_of(arrays)
        except RendererFailed:  # a busy browser now and then; one of many is little
            continue
        cover, step = lambda *given: prober.exact(*given).alpha.numpy(), 0.01
        if np.isin(seen.round(6), (0, 1)).all():
            cover, step = lambda *given: np.float64(along_rays(*given) > DISK), 1.0
        elif prober.options["projection"] == "ellipsoid":
            cover = along_rays
        moves = step * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        here, right, left, down, up = (
            cover(arrays, replace(camera, cx=camera.cx + a, cy=camera.cy + b)) for a, b in moves
        )
        images = np.stack([here, (right - left) / (2 * step), (down - up) / (2 * step)], -1)
        near = [np.maximum(abs(x - a), abs(y - b)) < 8 for a, b in places]
        shares = [np.linalg.lstsq(images[part], seen[part], rcond=None)[0] for part in near]
        found.append([share[1:] / share[0] for share in shares])
    if not found:
        return []
    offsets, noise = np.mean(found, 0), np.std(found, 0) / np.sqrt(len(found))
    worst = np.unravel_index(np.abs(offsets).argmax(), offsets.shape)
    return [round(float(number), 9) for number in (np.abs(offsets[worst]), noise[worst])]  # below: rounding of the fit


def measured(name: str, scenes: list[str], out: Path, more: bool, pictures: int) -> None:
    """A target's file, written after each scene, and the picture of its worst one."""
    target, file = ALL[name], out / "audit" / f"{name}.json"
    try:
        function_of(target.place)
    except InputError as error:
        print(f"{name}: left out. {error}")
        return
    renderer = Renderer(target.place, limit=120.0)
    facts = json.loads(file.read_text()) if more and file.exists() else {}
    if facts.get("version") != target.version or "worst" not in facts:
        facts = tell_rules(renderer, name, target.degree)
        facts |= {"version": target.version, "settings": target.settings, "worst": ["", 0.0], "scenes": []}
    facts["scenes"] = [row for row in facts["scenes"] if row["largest"] is not None or row["scene"] not in scenes]
    known = {row["scene"] for row in facts["scenes"]}
    left = tuple(scene for scene in scenes if scene not in known)
    for row in measure(renderer, facts["options"], target.degree, tuple(facts["background"]), left):
        print(f"  {row.scene}: {row.verdict}", flush=True)
        if row.pictures and row.off > 0 and row.mean > facts["worst"][1]:
            facts["worst"] = [row.scene, row.mean]
            save_png(out / "audit" / f"{name}.png", side_by_side(*row.pictures))
        facts["scenes"].append(row.record())
        write_json(file, facts)
    if facts.get("pictures") != pictures or not scenes:
        facts |= {"camera": camera_error(renderer, target.degree, pictures), "pictures": pictures}
        write_json(file, facts)
    renderer.close()


def summary(facts: dict) -> dict:
    rows = facts["scenes"]
    drawn = [row for row in rows if row["largest"] is not None]
    repeated = [row for row in drawn if row.get("runs", RUNS if row["scene"] in REPEATED else 1) == RUNS]
    gradients = {
        row["scene"]: max(value for value in row["gradients"].values() if value is not None)
        for row in drawn
        if any(value is not None for value in row["gradients"].values())
    }
    return facts | {
        "right": f"{sum(row['off'] == 0 for row in drawn)} of {len(rows)}",
        "near": sum(row["largest"] <= NEARLY for row in drawn),
        "by_rules": sum(row["own"] == 0 for row in drawn),
        "failed": len(rows) - len(drawn),
        "mean": float(np.mean([row["mean"] for row in drawn])) if drawn else None,
        "gradient": float(np.median(list(gradients.values()))) if gradients else None,
        "worst": worst_gradient({"gradients": gradients}),
        "camera": "{:.0e} ± {:.0e}".format(*facts["camera"]) if facts.get("camera") else "-",
        "same": f"{sum(row['same'] for row in repeated)} of {len(repeated)}",
    }


def write_summary(out: Path) -> None:
    files = [out / "audit" / f"{name}.json" for name in ALL]
    records = [summary(json.loads(path.read_text())) for path in files if path.exists()]
    if not records:
        raise SystemExit("Nothing was measured, here or before.")
    columns = {
        "target": "{target}",
        "version": "{version}",
        "SH": "{degree}",
        "scenes right": "{right}",
        "within 3 %": "{near}",
        "by its own rules": "{by_rules}",
        "mean error": "{mean:.1e}",
        "gradients, median": "{gradient:.1e}",
        "worst gradient": "{worst}",
        "same bits": "{same}",
        "camera, px": "{camera}",
        "failed": "{failed}",
        "date": "{date}",
        "settings": "{settings}",
    }
    note = f"Measured by `benchmarks/audit.py` on {records[0]['machine']}."
    write_text(out / "audit.md", f"{table_of(records, columns)}\n\n{note}\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", default=list(ALL))
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=SCENES, metavar="SCENE")
    parser.add_argument("--more", action="store_true", help="keep what was measured of the same version, add the rest")
    parser.add_argument("--pictures", type=int, default=PICTURES, help="of three Gaussians, for the camera")
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks"))
    arguments = parser.parse_args()
    if unknown := [name for name in arguments.targets if name not in ALL]:
        parser.error(f"expected targets among {', '.join(ALL)}, found {', '.join(unknown)}")
    if arguments.pictures < 2:
        parser.error(f"--pictures: expected 2 or more, found {arguments.pictures}")
    for name in arguments.targets:
        measured(name, arguments.scenes, arguments.out, arguments.more, arguments.pictures)
    write_summary(arguments.out)


if __name__ == "__main__":
    main()
