"""By two processes of ``test_distributed.py``: three steps together, what each process got, then models that differ.

torchrun --nproc-per-node 2 tests/torchrun_steps.py folder scene optimizer_type
"""

import sys
from pathlib import Path

import numpy as np
import torch

from warp_splat.runtime import launch
from warp_splat.runtime.distributed import GroupError, join
from warp_splat.scene import load_scene
from warp_splat.training.options import TrainConfig
from warp_splat.training.trainer import Trainer

STEPS = 3
#: Densifies after the third step, before which each process has seen other views.
CONFIG = {"device": "cpu", "densify_from_iter": 4, "densification_interval": 6, "sh_interval": 4}
CONFIG |= {"random_background": True, "parts": "floaters"}


def arrays(tensors) -> dict[str, np.ndarray]:
    return {name: tensor.detach().numpy() for name, tensor in tensors.items() if tensor is not None}


def main(folder: Path, source: str, optimizer_type: str) -> None:
    launch.prepare("cpu", 1)
    scene = load_scene(source, resolution=8, report=str)
    with join("cpu") as processes:
        trainer = Trainer(scene, TrainConfig(optimizer_type=optimizer_type, **CONFIG), processes)
        for step in range(1, STEPS + 1):
            iteration = step * processes.count
            loss = trainer.differentiate(iteration)
            name = folder / f"rank{processes.rank}_step{step}"
            gradients = arrays({key: leaf.grad for key, leaf in trainer.model.parameters.items()})
            np.savez(f"{name}_gradients", loss=loss.numpy(), **gradients)
            trainer.update(iteration)
            np.savez(f"{name}_model", **arrays(trainer.model.parameters))
        if processes.rank == 1:
            with torch.no_grad():
                trainer.model.parameters["quats"][0, 0] += 1e-6
        try:
            trainer.check_identical(iteration)
        except GroupError as error:
            (folder / f"rank{processes.rank}_error").write_text(str(error))
    threads = {path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm")}  # none but on Linux
    assert not any("gloo" in name for name in threads), f"these may abort a process that ends: {threads}"


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3])
