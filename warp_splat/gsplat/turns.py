"""Turning points and axes in torch, term by term: in torch's own product bits depend on how many there are."""

import torch


def rows_turned(rows: torch.Tensor, matrices: torch.Tensor) -> torch.Tensor:
    """Rows [..., 3] times matrices [..., 3, 3]."""
    first, second, third = (rows[..., axis, None] * matrices[..., axis, :] for axis in range(3))
    return first + second + third


def rotations(quats: torch.Tensor) -> torch.Tensor:
    """Matrices [..., 3, 3] of quaternions w first, any norm; of zero, the identity."""
    nothing = (quats == 0).all(-1, keepdim=True)
    quats = torch.where(nothing, quats.new_tensor([1.0, 0.0, 0.0, 0.0]), quats)
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    vector = torch.stack([x, y, z], -1)
    none = torch.zeros_like(w)
    across = torch.stack([none, -z, y, z, none, -x, -y, x, none], -1).unflatten(-1, (3, 3))
    outer = vector[..., :, None] * vector[..., None, :]
    scalar = (w * w - (vector * vector).sum(-1))[..., None, None] * torch.eye(3, device=w.device)
    return scalar + 2 * outer + 2 * w[..., None, None] * across  # Rodrigues' formula
