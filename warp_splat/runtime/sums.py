"""Sums that are the same for any number of threads and on any processor, unlike torch's."""

import torch


def in_pairs(values: torch.Tensor) -> torch.Tensor:
    """The sum over the first axis of ``values`` [M, ...], in float64: of neighbors, then of these sums, and so on."""
    sums = (values if len(values) else torch.cat([values, values.new_zeros(1, *values.shape[1:])])).double()
    while len(sums) > 1:
        if len(sums) % 2:
            sums = torch.cat([sums, sums.new_zeros(1, *sums.shape[1:])])
        sums = sums[::2] + sums[1::2]
    return sums[0]
