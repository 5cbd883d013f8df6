"""Print kernels of a training step as they are compiled: what was assembled of parts, or written from a formula.

python benchmarks/show_kernel.py              # their names
python benchmarks/show_kernel.py project      # the source of those whose names hold this
"""

import argparse
from dataclasses import replace

from warp._src.context import user_modules

from warp_splat.lenses import Lens
from warp_splat.raster.api import rasterize
from warp_splat.runtime import launch
from warp_splat.scene import load_scene
from warp_splat.scene.embedded import embedded_scene
from warp_splat.training.options import TrainConfig
from warp_splat.training.trainer import Trainer


def sources() -> dict[str, str]:
    """Of each kernel and function of the package that a step takes, without and with a lens, by module and name."""
    launch.prepare("cpu", 0)
    trainer = Trainer(load_scene(embedded_scene(), resolution=8, report=str), TrainConfig(device="cpu"))
    trainer.warm_up()
    camera = replace(trainer.scene.train[0].camera, lens=Lens("OPENCV", (-0.1, 0.01, 0.0, 0.0)))
    means, quats, scales, opacities, *sh = trainer.model.activated(0)
    rasterize(means, quats, scales, opacities, tuple(sh), camera).image.sum().backward()
    found = {}
    for module in user_modules.values():
        for part in (*module.kernels.values(), *module.functions.values()):
            if not module.name.startswith("warp."):
                found[f"{module.name} {part.key.split('__locals__')[-1]}"] = part.adj.source
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", nargs="?", default="", help="of kernels and functions, or a part of it")
    wanted, found = parser.parse_args().name, sources()
    for name in sorted(found):
        if wanted in name.split()[1]:
            print(f"# {name}\n{found[name]}\n" if wanted else name)


if __name__ == "__main__":
    main()
