"""How kernels are written: names, order, shapes, size; and those assembled from functions: the same as if called."""

import ast
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from commands import python

from warp_splat.errors import InputError
from warp_splat.kernels.inline import kernel_of_parts

KERNELS = Path(__file__).parents[1] / "warp_splat" / "kernels"
MOST_PARAMETERS, MOST_LINES = 12, 100


def is_kernel(node):
    """Whether a function is decorated as one: by ``wp.kernel`` or by what assembles kernels."""
    return isinstance(node, ast.FunctionDef) and any("kernel" in ast.unparse(item) for item in node.decorator_list)


def find_kernels():
    """Each kernel of the package: its name, its lines of source and its definition."""
    for path in sorted(KERNELS.rglob("*.py")):
        text = path.read_text()
        for node in ast.walk(ast.parse(text)):
            if is_kernel(node):
                place = path.relative_to(KERNELS).with_suffix("")
                yield pytest.param(text.splitlines(), node, id=f"{place}:{node.name}")


FOUND = list(find_kernels())
each_kernel = pytest.mark.parametrize(("lines", "kernel"), FOUND)


def base_of(target):
    """The name of the variable that ``a[i, j]`` or ``a[i][j].x`` is part of."""
    while isinstance(target, ast.Subscript | ast.Attribute):
        target = target.value
    return target.id if isinstance(target, ast.Name) else ""


def written(kernel):
    """Variables of which elements are assigned."""
    for node in ast.walk(kernel):
        if isinstance(node, ast.Assign | ast.AugAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from (base_of(target) for target in targets if isinstance(target, ast.Subscript))


def parameters(kernel):
    return [parameter.arg for parameter in kernel.args.args]


def comment(lines, parameter):
    """What stands behind a parameter on its line."""
    return lines[parameter.end_lineno - 1].partition("#")[2]


def test_kernels_are_found():
    assert len(FOUND) > 15


@each_kernel
def test_what_is_written_is_named_so(lines, kernel):
    """And what is named so is used: written here, or given to a function that writes it."""
    changed = {name for name in written(kernel) if name in parameters(kernel)}
    assert all(name.endswith("_out") for name in changed)
    used = {node.id for statement in kernel.body for node in ast.walk(statement) if isinstance(node, ast.Name)}
    assert {name for name in parameters(kernel) if name.endswith("_out")} <= used


@each_kernel
def test_order_of_parameters(lines, kernel):
    """``first`` (of a slice; blocks have a tile or a group), inputs, a line ``# out``, outputs."""
    names = parameters(kernel)
    assert "first" not in names[1:]
    begins = ast.unparse(kernel.body[0])
    assert "first" in names or begins.startswith(("tile, ", "group, ")), "no index of the launch"
    outputs = [parameter for parameter in kernel.args.args if parameter.arg.endswith("_out")]
    assert names[len(names) - len(outputs) :] == [parameter.arg for parameter in outputs]
    if outputs:
        assert lines[outputs[0].lineno - 2].strip().startswith("# out")


@each_kernel
def test_arrays_say_their_shape(lines, kernel):
    for parameter in kernel.args.args:
        if "wp.array" in ast.unparse(parameter.annotation):
            assert comment(lines, parameter).strip().startswith("["), f"{parameter.arg}: no shape"


def test_arrays_of_structs_say_their_shape():
    for path in sorted(KERNELS.rglob("*.py")):
        lines = path.read_text().splitlines()
        for struct in ast.walk(ast.parse("\n".join(lines))):
            if isinstance(struct, ast.ClassDef) and "wp.struct" in map(ast.unparse, struct.decorator_list):
                for field in struct.body:
                    if isinstance(field, ast.AnnAssign) and "wp.array" in ast.unparse(field.annotation):
                        assert comment(lines, field).strip().startswith("["), f"{struct.name}: {ast.unparse(field)}"


@each_kernel
def test_size(lines, kernel):
    assert len(kernel.args.args) <= MOST_PARAMETERS, "put what belongs together into a struct (kernels/structs.py)"
    assert kernel.end_lineno - kernel.lineno < MOST_LINES


size = 2.0  # also the name of a variable of the kernel


@wp.func
def turned(x: float, y: float):
    half = 0.5 * size
    return x + y, half * (x - y)


def test_arguments_may_be_targets_and_names_may_meet():
    @kernel_of_parts({}, turned=turned)
    def kernel(values: wp.array[float], out: wp.array[float]):
        size = values[0]
        half = values[1]
        size, half = turned(size, half)
        out[0] = size
        out[1] = half

    out = wp.zeros(2, dtype=float, device="cpu")
    wp.launch(kernel, 1, [wp.array([5.0, 3.0], dtype=float, device="cpu")], [out], device="cpu")
    np.testing.assert_allclose(out.numpy(), [8.0, 2.0])


@wp.func
def hasty(x: float):
    if x > 1.0:
        return x
    return 2.0 * x


@wp.func
def careless(x: float):
    x = 2.0 * x
    return x


@wp.func
def generous(x: float):
    return x, x


@pytest.mark.parametrize(
    ("part", "message"),
    [(hasty, "returns once"), (careless, "returns once"), (generous, "returns 1 values, .* found 2")],
)
def test_functions_that_cannot_be_put_in_place_are_refused(part, message):
    with pytest.raises(InputError, match=message):

        @kernel_of_parts({}, part=part)
        def kernel(out: wp.array[float]):
            y = out[0]
            y = part(y)
            out[0] = y


LINES = [
    ("project", "    rotation_w = times(qw, rotation_scale)\n"),
    ("perspective_lens", "    v0 = of_lens(camera, 15, z)\n"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("word", "line"), LINES)
def test_what_is_compiled_can_be_read(word, line):
    """What was assembled: names of a part stand in the kernel; what was written from a formula."""
    shown = python("benchmarks/show_kernel.py", word, check=False).stdout
    assert f"def {word}(" in shown and line in shown
