"""Kernels assembled from functions without a call. LLVM leaves long functions as calls, and so their adjoints.

As calls, the projection takes 13 % longer and its adjoint 24 % (50,000 Gaussians, one thread, AVX-512).
"""

from __future__ import annotations

import ast
import inspect
import linecache
import textwrap
import zlib
from collections.abc import Callable

import warp as wp


def kernel_of_parts(module_options: dict, **parts: wp.Function) -> Callable:
    """A decorator: the kernel with the bodies of ``parts`` in place of ``a, b = part(c, d)``, in a module of its own.

    Arguments of such a call are variables. A part changes none of its parameters, and returns once, at its end.
    """

    def decorate(function: Callable) -> wp.Kernel:
        definition, names = _parsed(function)
        definition.decorator_list = []
        for parameter in definition.args.args:
            parameter.annotation = ast.Name(f"type_of_{parameter.arg}", ast.Load())
            names[parameter.annotation.id] = function.__annotations__[parameter.arg]
        definition.body = [line for old in definition.body for line in _expanded(old, parts, names)]
        source = ast.unparse(ast.fix_missing_locations(ast.Module([definition], [])))
        path = f"<{function.__qualname__} {zlib.crc32(source.encode())}>"
        linecache.cache[path] = (len(source), None, source.splitlines(keepends=True), path)  # where Warp finds it
        exec(compile(source, path, "exec"), names)
        return wp.kernel(module="unique", module_options=dict(module_options))(names[function.__name__])

    return decorate


def _parsed(function: Callable) -> tuple[ast.FunctionDef, dict]:
    """Its definition, and the value of every name that it may refer to."""
    definition = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
    assert isinstance(definition, ast.FunctionDef)
    return definition, {**function.__globals__, **inspect.getclosurevars(function).nonlocals}


def _expanded(line: ast.stmt, parts: dict[str, wp.Function], names: dict) -> list[ast.stmt]:
    """What stands for a statement of the kernel."""
    if isinstance(line, ast.If):
        line.body = [new for old in line.body for new in _expanded(old, parts, names)]
    if isinstance(line, ast.Assign) and isinstance(line.value, ast.Call) and isinstance(line.value.func, ast.Name):
        part = line.value.func.id
        if part in parts:
            return _inlined(part, parts[part].func, line.targets[0], line.value.args, names)
    return [line]


def _inlined(part: str, function: Callable, target: ast.expr, arguments: list[ast.expr], names: dict) -> list[ast.stmt]:
    """The body of ``function``, its own names behind that of the part; ``names`` learns what it refers to."""
    definition, known = _parsed(function)
    given = {parameter.arg: argument for parameter, argument in zip(definition.args.args, arguments, strict=True)}
    nodes = [node for node in ast.walk(definition) if isinstance(node, ast.Name)]
    own = {node.id for node in nodes if isinstance(node.ctx, ast.Store)}
    renamed = {}
    for name in {node.id for node in nodes} - set(given):
        if name in own or (name in known and names.get(name, known[name]) is not known[name]):
            renamed[name] = f"{part}_{name}"
        if name in known:
            names[renamed.get(name, name)] = known[name]
    for node in nodes:
        node.id = given[node.id].id if node.id in given else renamed.get(node.id, node.id)
    body = [
        line for line in definition.body if not (isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant))
    ]
    answer = body.pop()
    assert isinstance(answer, ast.Return) and not own & set(given), f"{part}: one return, and no parameter changed"
    targets = target.elts if isinstance(target, ast.Tuple) else [target]
    values = answer.value.elts if isinstance(answer.value, ast.Tuple) else [answer.value]
    return body + [ast.Assign([place], value) for place, value in zip(targets, values, strict=True)]
