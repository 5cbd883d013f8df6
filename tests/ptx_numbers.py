"""What PTX's instructions make of numbers: arrays of NumPy, an element for each thread."""

from collections.abc import Callable

import numpy as np

TYPES = {"pred": np.bool_, "f32": np.float32} | {
    f"{kind}{8 * size}": np.dtype(f"{code}{size}").type
    for kind, code in zip("bus", "uui", strict=True)
    for size in (1, 2, 4, 8)
}


def wide(numbers: np.ndarray) -> np.ndarray:
    """As whole numbers of twice as many bits."""
    return numbers.astype(f"{numbers.dtype.kind}{2 * numbers.dtype.itemsize}")


def divided(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Whole numbers rounded to zero, as C has it."""
    if a.dtype.kind == "f":
        return a / b
    found = np.abs(a) // np.abs(b)
    return found if a.dtype.kind == "u" else np.where((a < 0) != (b < 0), -found, found)


def shifted(shift: Callable, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """By more than all bits, too, which C leaves open."""
    most = a.dtype.type(a.dtype.itemsize * 8 - 1)
    return np.where(b > most, shift(shift(a, most), a.dtype.type(1)), shift(a, np.minimum(b, most)))


def leading_zeros(a: np.ndarray) -> np.ndarray:
    return (32 - np.frexp(a.astype(np.float64))[1]).astype(np.uint32)


def reversed_bits(a: np.ndarray) -> np.ndarray:
    bits = np.unpackbits(np.ascontiguousarray(a)[:, None].view(np.uint8), axis=1, bitorder="little")
    return np.packbits(bits[:, ::-1], axis=1, bitorder="little").view(np.uint32)[:, 0]


def inserted(a: np.ndarray, b: np.ndarray, start: np.ndarray, count: np.ndarray) -> np.ndarray:
    mask = ((np.uint64(1) << count) - np.uint64(1)) << start
    return (b & ~mask) | ((a << start) & mask)


def fused(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """The product is exact in float64. The sum is rounded there, and again: off by a bit in one of 2^29 cases."""
    return (a.astype(np.float64) * b + c).astype(np.float32)


def flushed(numbers: np.ndarray) -> np.ndarray:
    return np.where(np.abs(numbers) < np.finfo(np.float32).tiny, np.float32(0), numbers)


#: By name without types: what an instruction makes of its operands. Where there is a choice, it is to the nearest.
OPERATIONS: dict[str, Callable] = {
    **{"abs": np.abs, "neg": np.negative, "not": np.invert, "sqrt": np.sqrt, "rcp": np.reciprocal, "fma": fused},
    "rem": np.fmod,  # with the sign of the first, as C has it
    **dict.fromkeys(("mov", "cvta.to.global", "cvta.shared"), np.asarray),
    **{"add": np.add, "sub": np.subtract, "mul": np.multiply, "mul.lo": np.multiply, "div": divided},
    **{"and": np.bitwise_and, "or": np.bitwise_or, "xor": np.bitwise_xor, "min": np.fmin, "max": np.fmax},
    "mul.wide": lambda a, b: wide(a) * wide(b),
    "mul.hi": lambda a, b: (wide(a) * wide(b) >> a.dtype.itemsize * 8).astype(a.dtype),
    "mad.lo": lambda a, b, c: a * b + c,
    "rcp.approx.ftz": lambda a: flushed(np.reciprocal(flushed(a))),
    "ex2.approx.ftz": lambda a: flushed(np.exp2(flushed(a).astype(np.float64)).astype(np.float32)),
    "shl": lambda a, b: shifted(np.left_shift, a, b),
    "shr": lambda a, b: shifted(np.right_shift, a, b),
    **{"brev": reversed_bits, "clz": leading_zeros, "bfi": inserted},
    "bfind.shiftamt": lambda a: np.where(a == 0, np.uint32(2**32 - 1), leading_zeros(a)),
    "selp": lambda a, b, chosen: np.where(chosen, a, b),
    **{"setp.eq": np.equal, "setp.ne": lambda a, b: (a < b) | (a > b)},
    **{"setp.lt": np.less, "setp.le": np.less_equal, "setp.gt": np.greater, "setp.ge": np.greater_equal},
    # "u": true as well where one is no number
    **{"setp.neu": np.not_equal, "setp.nan": lambda a, b: np.isnan(a) | np.isnan(b)},
    **{"setp.ltu": lambda a, b: ~(a >= b), "setp.leu": lambda a, b: ~(a > b)},
    **{"setp.gtu": lambda a, b: ~(a <= b), "setp.geu": lambda a, b: ~(a < b)},
}
ROUNDED = {"rzi": np.trunc, "rmi": np.floor, "rpi": np.ceil, "rn": np.asarray}


def as_type(numbers: np.ndarray, dtype: type) -> np.ndarray:
    """The same bits, if there are as many; else the number, of which the lowest bits are kept."""
    numbers = np.asarray(numbers)
    return numbers.view(dtype) if numbers.itemsize == np.dtype(dtype).itemsize else numbers.astype(dtype)
