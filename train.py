"""Train Gaussians on a scene's photographs: ``python train.py -s scene``. The same as ``warp-splat train``."""

import sys

from warp_splat.cli import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
