"""``python -m warp_splat.compare``: the same as ``warp-splat compare``."""

import sys

from warp_splat.cli import main

sys.exit(main(["compare", *sys.argv[1:]]))
