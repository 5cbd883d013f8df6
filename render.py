"""Render a trained model: ``python render.py -m output/model``. The same as ``warp-splat render``."""

import sys

from warp_splat.cli import main

if __name__ == "__main__":
    sys.exit(main(["render", *sys.argv[1:]]))
