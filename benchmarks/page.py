"""What does a browser need for the page of a large model? Bytes and seconds to a first picture, frames, their quality.

Five minutes on two cores, for a million Gaussians of a trained model that was split, and a million made up. Needs
playwright and a Chromium, as the tests in a browser do (tests/browser.py); its WebGL runs in software.

    python benchmarks/page.py -m MODEL [--out docs/benchmarks]
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from common import option, parse, write_table
from made_up import make_gaussians
from scipy.spatial.transform import Rotation

from warp_splat.config import ExportHtmlConfig
from warp_splat.evaluation.metrics import psnr
from warp_splat.export_html.command import export_html
from warp_splat.formats import model_folder
from warp_splat.formats.exchange import save_gaussians
from warp_splat.formats.png import load_png
from warp_splat.formats.splats import SplatArrays, SplatFile, concatenated, sizes
from warp_splat.formats.stored import logit, sigmoid, unit_quats

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from browser import browser_page

MILLION = 1_000_000
WIDTH, HEIGHT, BAR = 1280, 720, 40  # px
PROGRAM = b"})();</script>"  # ends what the first picture needs
COLUMNS = {
    **{"model": "{name}", "Gaussians": "{count}", "page MB": "{size:.1f}", "MB to the first picture": "{begin:.1f}"},
    **{"s to it": "{first:.1f}", "s to all": "{all:.1f}", "drawn in motion": "{drawn}", "ms a frame": "{frame:.0f}"},
    **{"pixels in a row": "{detail:.2f}", "at rest: ms a frame": "{still:.0f}", "sort ms": "{sort:.0f}"},
    **{"motion dB": "{motion:.1f}", "first picture dB": "{early:.1f}"},
}
# the clock stops when the card has drawn: reading a pixel waits for it
HELP = """
window.pixel = () => {
  const gl = document.getElementById("canvas").getContext("webgl2");
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  return performance.now();
};
window.frame = () => new Promise(requestAnimationFrame);
window.first = (async () => {
  while (!window.warpSplat?.times.drawn) await frame();
  return pixel();
})();
"""
FIRST = "first"
ALL = "async () => { await warpSplat.setCamera(warpSplat.cameras[0]); return pixel(); }"
AT_REST = """async (index) => {
  await warpSplat.setCamera(warpSplat.cameras[index % warpSplat.cameras.length]);
  pixel();
  for (let k = 0; k < 5; k++) await frame();
  return warpSplat.times;
}"""
MOVE = """async (frames) => {
  const canvas = document.getElementById("canvas"), found = [];
  for ([window.moving, window.moved] = [true, 0]; found.length < frames && moving;) {
    canvas.dispatchEvent(new WheelEvent("wheel", { deltaY: 0, cancelable: true })); // moves by nothing
    await frame();
    const { times } = warpSplat;
    if (times.frame !== found.at(-1)?.frame) window.moved = found.push(times);
  }
  return found;
}"""


def split(splats: SplatArrays, rows: np.ndarray) -> SplatArrays:
    """Those in ``rows`` as two each, along the longest axis, as the budget's growth does it."""
    every, axis = np.arange(len(rows)), splats.scales[rows].argmax(axis=1)
    turns = Rotation.from_quat(unit_quats(splats.quats[rows]), scalar_first=True).as_matrix()
    offsets = 0.7 * turns[every, :, axis] * np.exp(splats.scales[rows, axis])[:, None]
    child = splats.take(rows)
    child.scales[every, axis] += np.log(0.714)
    child = child._replace(opacities=logit(1 - np.sqrt(1 - sigmoid(child.opacities.astype(np.float64)))))
    halves = [child._replace(means=(child.means + sign * offsets).astype(np.float32)) for sign in (1, -1)]
    kept = SplatArrays(*(np.delete(array, rows, axis=0) for array in splats))
    return concatenated([kept, *halves])


def make_models(model: Path, folder: Path) -> dict[str, Path]:
    """The model, a million Gaussians of it by splits, with its cameras; a million made up."""
    iteration, (splats, antialiased, *_), trained = model_folder.open_model(model)
    while len(splats.means) < MILLION:
        splats = split(splats, np.argsort(-sizes(splats))[: MILLION - len(splats.means)])
    save_gaussians(model_folder.ply_path(folder / "split", iteration), SplatFile(splats, antialiased))
    (folder / "split" / "cameras.json").write_text((model / "cameras.json").read_text())
    model_folder.write_cfg_args(folder / "split", trained)
    save_gaussians(folder / "made_up.ply", SplatFile(make_gaussians(MILLION, "cpu").splats()))
    return {"trained": model, "trained, split": folder / "split", "made up": folder / "made_up.ply"}


def measure(name: str, model: Path, folder: Path) -> dict:
    path = folder / "page.html"
    export_html(ExportHtmlConfig(str(model), str(path)))
    size, first_size = path.stat().st_size, path.read_bytes().index(PROGRAM) + len(PROGRAM)
    with browser_page(WIDTH, HEIGHT) as (page, _):
        page.set_default_timeout(300_000)
        page.add_init_script(HELP)
        page.goto(path.as_uri(), wait_until="commit")
        first = page.evaluate(FIRST)
        everything = page.evaluate(ALL) / 1e3
        rest = [page.evaluate(AT_REST, index) for index in (1, 2, 0)]
        still = screen(page, folder)
        motion = page.evaluate(MOVE, 25)[-10:]
        page.evaluate(f"void ({MOVE})(Infinity)")
        while page.evaluate("moved") < 5:
            page.wait_for_timeout(200)
        moving = screen(page, folder)
        page.evaluate("moving = false")
        begin = screen_of_first(page, path, folder)
    frame = [np.median([times["frame"] for times in found]) for found in (motion, rest)]
    found = {"name": name, "count": rest[-1]["drawn"], "size": size / 1e6, "begin": first_size / 1e6}
    found |= {"first": first / 1e3, "all": everything, "drawn": motion[-1]["drawn"], "frame": frame[0]}
    found |= {"detail": motion[-1]["detail"], "still": frame[1], "sort": rest[-1]["sort"]}
    found |= {"motion": psnr(moving, still), "early": psnr(begin, still)}
    print(found, flush=True)
    return found


def screen_of_first(page, path: Path, folder: Path) -> np.ndarray:
    """What is seen where nothing comes after the program, but for the words that say so."""
    text = path.read_bytes()
    path.write_bytes(text[: text.index(PROGRAM) + len(PROGRAM)])
    page.goto(path.as_uri())
    page.evaluate(FIRST)
    page.evaluate("document.getElementById('message').hidden = true")
    return screen(page, folder)


def screen(page, folder: Path) -> np.ndarray:
    """What the user sees, without the bar."""
    page.screenshot(path=folder / "screen.png")
    return load_png(folder / "screen.png")[: HEIGHT - BAR, :, :3]


def main() -> None:
    arguments = parse(__doc__, option("-m", "--model", type=Path, required=True, help="the folder of a trained model"))
    with tempfile.TemporaryDirectory() as folder:
        models = make_models(arguments.model, Path(folder))
        records = [measure(name, model, Path(folder)) for name, model in models.items()]
    note = (
        f"Chromium, {WIDTH} x {HEIGHT} px, from disk, WebGL in software. dB: PSNR of the screen against that at rest."
    )
    write_table("page", arguments.out, COLUMNS, records, note)


if __name__ == "__main__":
    main()
