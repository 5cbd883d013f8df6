"""``warp-splat audit``: a table, JSON and a page on a renderer, or the smallest scene that shows a finding."""

import sys
from contextlib import closing
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from warp_splat.audit.judged import LEVEL, SceneRow, exact_image, in_eight_bits, measure, smallest
from warp_splat.audit.program import draw_by_program, stored, write_files
from warp_splat.audit.renderer import Renderer, RendererFailed, function_of
from warp_splat.audit.rules import find_rules
from warp_splat.audit.small_scenes import SCENES, on_all_pixels
from warp_splat.config import AuditConfig
from warp_splat.errors import InputError
from warp_splat.evaluation.report import machine
from warp_splat.formats.files import write_array, write_json
from warp_splat.formats.model_folder import prepare_folder
from warp_splat.formats.png import save_png
from warp_splat.inspect.page import address_of, write_page
from warp_splat.inspect.subject import Finding
from warp_splat.text import table_of

ZOOM = 4
SHOWN = 12  # pictures of a page


def audit(config: AuditConfig) -> int:
    """Audit as ``config`` says; returns the process's exit code: 1 if something is wrong.

    Raises:
        InputError: for a target, scene or command that there is not.
    """
    sys.path.append("")  # modules of the folder where one stands, which an installed command does not see otherwise
    place = config.program or config.target
    if config.program or place.endswith(".html"):
        draw_by_program(place) if config.program else function_of(place)
    if config.case and config.case not in SCENES:
        raise InputError(f"--case {config.case}: expected one of {', '.join(SCENES)}.")
    with closing(Renderer(place, config.limit)) as renderer:
        try:  # in a process of its own, as modules of others change defaults, hang, or exit
            renderer.start()
        except RendererFailed as error:
            raise InputError(f"{place}: the renderer {error}.") from error
        out = prepare_folder(config.out)
        if config.case:
            return _write_case(renderer, config.degree, config.case, out)
        facts, rows = tell_rules(renderer, config.target, config.degree), []
        try:
            rows.extend(measure(renderer, facts["options"], config.degree, facts["background"]))
        finally:  # Ctrl-C, too, loses no row
            if rows:
                write_audit(out, facts, rows)
    return int(any(row.level in ("warning", "error") for row in rows))


def tell_rules(renderer: Renderer, name: str, degree: int = 3) -> dict[str, Any]:
    """What is known of a renderer, with the rules that were found; prints those."""
    print(name)
    rules = find_rules(renderer.draw, degree)
    for rule, sentence in rules.sentences.items():
        print(f"  {rule:13s} {sentence}")
    facts = {"target": name, "date": date.today().isoformat(), "machine": machine(), "degree": degree}
    return facts | {"rules": rules.sentences, "options": rules.options, "background": rules.background}


def worst_gradient(record) -> str:
    """The largest relative error of a gradient, and whose it is."""
    found = {name: value for name, value in record["gradients"].items() if value == value}
    worst = max(found, key=found.__getitem__, default="")
    return f"{found[worst]:.0e} {worst}" if worst else "-"


def write_audit(out: Path, facts: dict[str, Any], rows: list[SceneRow]) -> None:
    """Print the table. ``audit.json`` and ``audit.html`` in ``out``, and the worst scene as ``worst.png``."""
    columns = {"scene": "{scene}", "largest": "{largest:.1g}", "mean": "{mean:.1g}", "off": "{off:.1%}"}
    columns |= {"by its rules": "{own:.1%}", "gradients": worst_gradient, "verdict": "{verdict}"}
    print(table_of([row.record() for row in rows], columns))
    write_json(out / "audit.json", facts | {"scenes": [row.record() for row in rows]})
    findings = [Finding(rule, "note", sentence) for rule, sentence in facts["rules"].items()]
    findings += [Finding(row.scene, row.level, f"{row.shows}: {row.verdict}") for row in rows]
    drawn = sorted((row for row in rows if row.pictures), key=lambda row: (-row.own, -row.off, -row.largest))
    pictures = []
    for row in drawn[:SHOWN]:
        address = address_of("png", partial(Image.fromarray(side_by_side(*row.pictures)).save, format="png"))
        pictures.append((f"{row.scene}: expected, found, difference (10 times)", address))
    if drawn:
        save_png(out / "worst.png", side_by_side(*drawn[0].pictures))
    off = sum(row.level in ("warning", "error") for row in rows)
    verdict = f"{off} of {len(rows)} scenes are off, {len(SCENES) - len(rows)} were not drawn; {facts['date']}."
    write_page(out / "audit.html", f"Audit of {facts['target']}", verdict, findings, pictures)
    print(f"{verdict}\n  page {out / 'audit.html'}")


def side_by_side(expected: np.ndarray, found: np.ndarray) -> np.ndarray:
    """What was expected, what came, and ten times the difference, [H, 3 W, 3] uint8, enlarged."""
    found = np.nan_to_num(found, nan=1.0, posinf=1.0, neginf=0.0)
    strip = np.concatenate([expected, found, 10 * np.abs(expected - found)], 1)
    return (in_eight_bits(strip) * 255).astype(np.uint8).repeat(ZOOM, 0).repeat(ZOOM, 1)


def _write_case(renderer: Renderer, degree: int, name: str, out: Path) -> int:
    """The smallest scene that shows what a renderer does to ``name``: files, what was expected, what came."""
    background = find_rules(renderer.draw, degree, ("background",)).background
    workload = on_all_pixels(name, SCENES[name][1](), background, degree)
    try:
        workload, answer = smallest(renderer, workload)
    except RendererFailed as error:
        print(f"{name}: the renderer {error}.")
        answer = None
    write_files(out, stored(*workload.gaussians[:4], workload.gaussians.sh), workload.camera)
    expected = exact_image(workload)
    write_array(out / "expected.npy", expected)
    save_png(out / "expected.png", (in_eight_bits(expected) * 255).astype(np.uint8))
    count = f"{name}: {(many := len(workload.gaussians.means))} Gaussian{'s' * (many > 1)} on {background}"
    if answer is None:
        for old in ("found.npy", "found.png"):  # of another scene
            (out / old).unlink(missing_ok=True)
        return 1
    write_array(out / "found.npy", answer.image)
    save_png(out / "found.png", (in_eight_bits(np.nan_to_num(answer.image)) * 255).astype(np.uint8))
    error = float(np.abs(np.nan_to_num(answer.image - expected, nan=np.inf)).max())
    print(f"{count}, off by {error:.3g} at most; expected and found in {out}.")
    return int(error > 1.01 * LEVEL)
