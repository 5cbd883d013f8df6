"""What `warp-splat mesh` takes: of the whole command, in a process of its own.

Wants an idle machine. Processor seconds are those of all threads.

    python benchmarks/mesh_time.py -m MODEL [-m MODEL ...] [--out docs/benchmarks]
"""

import os
import subprocess
import sys
import time
from pathlib import Path

from common import TRAINED, parse, write_table

from warp_splat.config import MeshConfig
from warp_splat.pruning.opened import Opened

HEADERS = ("scene", "Gaussians", "photographs", "seconds", "processor seconds", "peak, GB")


def row_of(model: Path) -> tuple:
    opened = Opened(MeshConfig(model=str(model), output=""))
    begun = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "warp_splat", "mesh", model, model / "mesh.ply"])
    _, failed, used = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - begun
    assert not failed
    name, views = Path(opened.trained["source_path"]).name, opened.scene.train
    photographs = f"{len(views)} of {views[0].camera.width} x {views[0].camera.height}"
    numbers = f"{seconds:.0f}", f"{used.ru_utime + used.ru_stime:.0f}", f"{used.ru_maxrss / 1e6:.1f}"
    return name, len(opened.file.splats.means), photographs, *numbers


def main() -> None:
    arguments = parse(__doc__, TRAINED)
    note = "The whole command, on all cores."
    write_table("mesh_time", arguments.out, HEADERS, [row_of(model.resolve()) for model in arguments.models], note)


if __name__ == "__main__":
    main()
