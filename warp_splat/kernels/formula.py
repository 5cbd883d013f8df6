"""Formulas in NumPy, written down as functions of kernels, with their derivatives.

A :class:`Number` takes part in a computation and notes each step instead of taking it. It also notes its slopes: its
derivatives by the variables, by the rules of forward differentiation. So one function of NumPy serves arrays on the
host and sixteen Gaussians in a kernel, and no derivative of it is written by hand.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import warp as wp

from warp_splat.errors import InputError
from warp_splat.kernels import simd
from warp_splat.kernels.angle import angle
from warp_splat.kernels.inline import defined
from warp_splat.kernels.project.camera_view import CameraView, of_lens, turn

Name = str | None  # of a variable of the function; None: zero


class Notes:
    """The steps of a computation, each taken once."""

    def __init__(self):
        self.steps: dict[tuple[str, ...], str] = {}  # what is computed of what, and the name of the result
        self.masks: set[Name] = set()  # names of what is 0 or 1

    def note(self, operation: str, *operands: str) -> str:
        """The name of what an operation of :mod:`.simd` gives."""
        name = self.steps.setdefault((operation, *operands), f"v{len(self.steps)}")
        of_masks = operation in ("times", "pick") and {*operands[-2:]} <= self.masks
        if operation == "less" or of_masks or operands in (("0.0",), ("1.0",)):
            self.masks.add(name)
        return name

    def constant(self, value: float) -> Name:
        """Its name."""
        return self.note("fill", repr(float(value))) if value else None

    def number(self, operation: str, *operands: object) -> Number:
        """What such an operation gives, as a number without slopes."""
        return Number(self, self.note(operation, *map(str, operands)))

    def given(self, code: str) -> Number:
        """A number of the camera."""
        return self.number("fill", code)

    def product(self, a: Name, b: Name) -> Name:
        """Of what may be zero or one."""
        one = self.steps.get(("fill", "1.0"))
        if a is None or b is None or one in (a, b):
            return None if a is None or b is None else a if b == one else b
        return self.note("times", *sorted((a, b)))

    def sum(self, a: Name, b: Name) -> Name:
        """Likewise."""
        return self.note("plus", a, b) if a and b else a or b

    def difference(self, a: Name, b: Name) -> Name:
        """Likewise."""
        return self.note("minus", a, b) if a and b else a or (b and self.note("negative", b))

    def chosen(self, mask: Name, a: Name, b: Name) -> Name:
        """``a`` where the mask is not zero, else ``b``."""
        if mask not in self.masks:
            zero, number = self.real(None), self.real(mask)
            mask = self.note("plus", self.note("less", zero, number), self.note("less", number, zero))
        return self.note("pick", self.real(mask), self.real(a), self.real(b)) if a or b else None

    def real(self, a: Name) -> str:
        """The name of a number that may be zero."""
        return a or self.note("fill", "0.0")

    def lines(self, results: Sequence[str], like: str) -> list[str]:
        """As statements: only what ``results`` need; a sum with a product that nothing else needs is fused."""
        steps, needed = {name: step for step, name in self.steps.items()}, Counter(results)
        for name in reversed(steps):
            if name in needed:
                needed.update(operand for operand in steps[name][1:] if operand in steps)
        written = []
        for name, (operation, *operands) in steps.items():
            if name not in needed:
                continue
            if operation == "plus":
                product = next((a for a in operands if needed[a] == 1 and steps.get(a, " ")[0] == "times"), None)
                if product:
                    (other,) = (a for a in operands if a != product)
                    written = [line for line in written if not line.startswith(f"{product} ")]
                    operation, operands = "fma", [*steps[product][1:], other]
            operands += [like] if operation in ("fill", "of_lens", "turn", "everywhere") else []
            code = {"plus": "{} + {}", "minus": "{} - {}", "negative": "-{}"}.get(operation)
            code = code.format(*operands) if code else f"{operation}({', '.join(operands)})"
            written.append(f"{name} = {code}")
        return written


class Number(np.lib.mixins.NDArrayOperatorsMixin):
    """A number of a computation that is noted, and its slopes.

    Args:
        notes: of the computation.
        name: of the number.
        slopes: the names of its derivatives by the variables.
    """

    def __init__(self, notes: Notes, name: Name, slopes: tuple[Name, ...] = ()):
        self.notes, self.name, self.slopes = notes, name, slopes

    def __array_ufunc__(self, function: Callable, method: str, *operands, **more):
        if method != "__call__" or more or function not in RULES:
            found = " with ".join([function.__name__, *more])
            raise InputError(f"lens formula: expected only what docs/extending.md names, found {found}.")
        return RULES[function](self.notes, *_aligned(self.notes, operands))

    def __array_function__(self, function: Callable, _types, operands, _keywords):
        return self.__array_ufunc__(function, "__call__", *operands)

    def __bool__(self) -> bool:
        raise InputError("lens formula: expected choices by np.where, found one by if, and, or, not, min or max.")

    def __float__(self, *_digits) -> float:
        raise InputError("lens formula: expected functions of NumPy, found float or one of Python's math.")

    __int__ = __round__ = __trunc__ = __float__


def _aligned(notes: Notes, operands: Sequence) -> list[Number]:
    """All as numbers with as many slopes."""
    found = [a if isinstance(a, Number) else Number(notes, notes.constant(a)) for a in operands]
    most = max(len(a.slopes) for a in found)
    return [Number(notes, a.name, a.slopes or (None,) * most) for a in found]


def _multiply(notes: Notes, a: Number, b: Number) -> Number:
    pairs = zip(a.slopes, b.slopes, strict=True)
    slopes = (notes.sum(notes.product(da, b.name), notes.product(a.name, db)) for da, db in pairs)
    return Number(notes, notes.product(a.name, b.name), tuple(slopes))


def _linear(combine: Callable[[Notes, Name, Name], Name], notes: Notes, a: Number, b: Number) -> Number:
    slopes = (combine(notes, *pair) for pair in zip(a.slopes, b.slopes, strict=True))
    return Number(notes, combine(notes, a.name, b.name), tuple(slopes))


_add, _subtract = partial(_linear, Notes.sum), partial(_linear, Notes.difference)


def _divide(notes: Notes, a: Number, b: Number) -> Number:
    per_b = notes.note("inverse", notes.real(b.name))
    ratio = notes.product(a.name, per_b)
    pairs = zip(a.slopes, b.slopes, strict=True)
    slopes = (notes.product(notes.difference(da, notes.product(ratio, db)), per_b) for da, db in pairs)
    return Number(notes, ratio, tuple(slopes))


def _sqrt(notes: Notes, a: Number) -> Number:
    root = notes.note("root", notes.real(a.name))
    half = notes.product(notes.constant(0.5), notes.note("inverse", root))
    return Number(notes, root, tuple(notes.product(slope, half) for slope in a.slopes))


def _arctan2(notes: Notes, a: Number, b: Number) -> Number:
    square = notes.sum(notes.product(a.name, a.name), notes.product(b.name, b.name))
    per_square = notes.note("inverse", notes.real(square))
    pairs = zip(a.slopes, b.slopes, strict=True)
    turns = (notes.difference(notes.product(b.name, da), notes.product(a.name, db)) for da, db in pairs)
    slopes = (notes.product(turned, per_square) for turned in turns)
    return Number(notes, notes.note("angle", notes.real(a.name), notes.real(b.name)), tuple(slopes))


def _flat(operation: str, notes: Notes, *operands: Number) -> Number:
    """Of what has no slope."""
    names = (notes.real(a.name) for a in operands)
    return Number(notes, notes.note(operation, *names), (None,) * len(operands[0].slopes))


#: What formulas may use.
RULES = {
    np.add: _add,
    np.subtract: _subtract,
    np.multiply: _multiply,
    np.true_divide: _divide,
    np.negative: lambda notes, a: _subtract(notes, Number(notes, None, (None,) * len(a.slopes)), a),
    np.sqrt: _sqrt,
    np.arctan2: _arctan2,
    np.less: partial(_flat, "less"),
    np.floor: partial(_flat, "rounded_down"),
    np.greater: lambda notes, a, b: _flat("less", notes, b, a),
    np.where: lambda notes, mask, a, b: _linear(lambda _, *pair: notes.chosen(mask.name, *pair), notes, a, b),
}


def write_function(
    name: str, notes: Notes, parameters: Sequence[str], results: Sequence[Number], lanes: int, more: Sequence[str] = ()
) -> wp.Function:
    """The function of ``lanes`` numbers, the camera first, that does what was noted.

    Args:
        name: of the function.
        notes: of the computation.
        parameters: the numbers that it takes.
        results: what it returns.
        lanes: numbers side by side.
        more: parameters that are no numbers, with their types.
    """
    names = [notes.real(result.name) for result in results]
    body = [*notes.lines(names, parameters[-1]), f"return {', '.join(names)}"]
    taken = ["camera: CameraView", *(f"{parameter}: number" for parameter in parameters), *more]
    source = "\n    ".join([f"def {name}({', '.join(taken)}):", *body]) + "\n"
    known = {**vars(simd), "angle": angle, "CameraView": CameraView, "of_lens": of_lens, "turn": turn}
    known["number"] = simd.TYPES[lanes].number
    return wp.func(defined(name, f"{source}# of {lanes}\n", known))
