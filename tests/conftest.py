"""Fixtures that several test modules share."""

import pytest
import torch

torch.set_num_threads(1)  # idle threads of torch would spin beside the kernels'


@pytest.fixture(params=["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"])
def device(request) -> str:
    """Every device that the renderer supports."""
    return request.param
