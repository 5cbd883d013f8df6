"""What all adjoints by hand have in common, the ``backward`` of torch's functions."""

from collections.abc import Callable

import torch

from warp_splat.errors import InputError
from warp_splat.runtime.timers import stage


def adjoint_of(what: str) -> Callable[[Callable], Callable]:
    """A stage of its own for a ``backward``, and an InputError where a graph of its gradients is wanted.

    Torch's ``once_differentiable`` lets them pass for constants where the loss is linear in the image.
    """

    def decorate(backward: Callable) -> Callable:
        def run(ctx, *upstream):
            if torch.is_grad_enabled():
                raise InputError("create_graph=True: expected False, as first derivatives have none; take differences.")
            with stage(f"adjoint of {what}"):
                return backward(ctx, *upstream)

        return run

    return decorate
