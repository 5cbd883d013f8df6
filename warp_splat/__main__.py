"""``python -m warp_splat``: the same as the command ``warp-splat``."""

import sys

from warp_splat.cli import main

sys.exit(main())
