"""Turning points in torch, term by term: in torch's own product bits depend on how many there are."""

import torch


def rows_turned(rows: torch.Tensor, matrices: torch.Tensor) -> torch.Tensor:
    """Rows [..., 3] times matrices [..., 3, 3]."""
    first, second, third = (rows[..., axis, None] * matrices[..., axis, :] for axis in range(3))
    return first + second + third
