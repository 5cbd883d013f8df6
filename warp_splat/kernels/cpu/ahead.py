"""Asking for memory before it is read or written here and there, so that many lines are under way at a time."""

import warp as wp

from warp_splat.kernels.splat import Splat2D


@wp.func_native("__builtin_prefetch(values.data + i, 1);")
def ask(values: wp.array[wp.vec2i], i: int):
    """Bring the lines of memory where an element lies, or would lie, into the cache."""


@wp.func_native("__builtin_prefetch(values.data + i, 1);")
def ask(values: wp.array[int], i: int): ...


@wp.func_native("__builtin_prefetch(values.data + i); __builtin_prefetch((char*)(values.data + i + 1) - 1);")
def ask(values: wp.array[Splat2D], i: int): ...
