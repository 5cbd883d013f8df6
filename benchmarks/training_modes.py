"""Training with each adjoint, with more seeds: PSNR with intervals, and time.

As benchmarks/training_cuts.py trains; "stored" takes too much memory to be repeated often.

    python benchmarks/training_modes.py [--seeds 6] [--out docs/benchmarks]
"""

from common import option, parse
from training_cuts import compare

MODES = ("manual", "stepwise", "reversible")


def main() -> None:
    arguments = parse(__doc__, option("--seeds", type=int, default=6))
    compare("training_modes", {mode: {"adjoint": mode} for mode in MODES}, arguments.seeds, arguments.out)


if __name__ == "__main__":
    main()
