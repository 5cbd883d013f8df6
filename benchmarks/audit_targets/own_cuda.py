"""This package's renderer on a GPU, in all modes."""

from functools import partial

import torch

from audit_targets import own

if not torch.cuda.is_available():
    raise ImportError("no CUDA device, which it needs")


def _on_gpu(draw, *given):
    return draw(*(item.cuda() if isinstance(item, torch.Tensor) else item for item in given))


manual, stepwise, reversible, stored = (
    partial(_on_gpu, draw) for draw in (own.manual, own.stepwise, own.reversible, own.stored)
)
