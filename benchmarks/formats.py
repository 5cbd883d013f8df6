"""What does each file format cost? Size, loss of renders, seconds to write and read, on trained models.

Half a minute for each model of 80,000 Gaussians on two cores.

    python benchmarks/formats.py -s SCENE -m MODEL [-s SCENE -m MODEL ...] [--out docs/benchmarks]
"""

import tempfile
import time
from pathlib import Path

import numpy as np
from common import TRAINED, option, parse, picture_of, write_table

from warp_splat.evaluation.metrics import psnr
from warp_splat.formats.exchange import FORMATS, load_gaussians, save_gaussians
from warp_splat.gaussians import GaussianModel
from warp_splat.rendering.finished import Finished
from warp_splat.runtime import launch

COLUMNS = {
    **{"scene": "{scene}", "Gaussians": "{count}", "format": "`{ending}`", "bytes each": "{each:.1f}"},
    **{"of the .ply": "1/{share:.1f}", "renders to its": "{close}", "test PSNR dB": "{quality:.2f}"},
    **{"write s": "{write:.1f}", "read s": "{read:.1f}"},
}
LEFT_OUT = {".gltf", ".usd", ".usda", ".usdz"}  # hold what a .glb and a .usdc do


def measure(scene_path: Path, model: Path, folder: Path) -> list[dict]:
    """A record for each format, the .ply first."""
    finished = Finished(model)
    scene, file = finished.refined(finished.load_scene(str(scene_path), lambda _: None)), finished.file
    first, first_bytes, records = None, 0, []
    for ending in (ending for ending in FORMATS if ending not in LEFT_OUT):
        path, start = folder / f"a{ending}", time.perf_counter()
        save_gaussians(path, file, lambda _: None)
        written = time.perf_counter()
        splats = load_gaussians(path).splats
        read, size = time.perf_counter(), path.stat().st_size
        picture = picture_of(GaussianModel.from_splats(splats), None, finished.options)
        renders = [picture(view.camera) for view in scene.test]
        if first is None:
            first, first_bytes = np.concatenate(renders), size
        same = np.array_equal(np.concatenate(renders), first)
        close = "the same" if same else f"{psnr(np.concatenate(renders), first):.1f} dB"
        pairs = zip(renders, scene.test, strict=True)
        quality = np.mean([psnr(image, view.picture, view.mask) for image, view in pairs])
        found = {"scene": scene_path.name, "count": len(splats.means), "ending": ending, "close": close}
        found |= {"each": size / len(splats.means), "share": first_bytes / size, "quality": quality}
        records.append({**found, "write": written - start, "read": read - written})
    return records


def main() -> None:
    arguments = parse(
        __doc__, option("-s", "--scenes", type=Path, action="append", required=True, help="one for each model"), TRAINED
    )
    launch.prepare("cpu", 0)
    with tempfile.TemporaryDirectory() as folder:
        pairs = zip(arguments.scenes, arguments.models, strict=True)
        records = [found for scene, model in pairs for found in measure(scene, model, Path(folder))]
    note = "Renders of the held-out views as 8-bit pictures, of all formats against those of the `.ply`."
    write_table("formats", arguments.out, COLUMNS, records, note)


if __name__ == "__main__":
    main()
