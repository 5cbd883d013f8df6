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

from warp_splat.errors import InputError


def kernel_of_parts(module_options: dict, **parts: wp.Function | Callable) -> Callable:
    """A decorator: the kernel with the bodies of ``parts`` in place of ``a, b = part(c, d)``, in a module of its own.

    Arguments of such a call are variables. A part changes none of its parameters, and returns once, at its end. It may
    call other parts. Parameters beyond the arguments are the kernel's variables of these names; where it has none, it
    takes one more parameter, behind its first. A part that is never called need not be a Warp function.

    Raises:
        InputError: if a part does otherwise.
    """

    def decorate(function: Callable) -> wp.Kernel:
        definition, names = _parsed(function)
        taken = {
            node.id for node in ast.walk(definition) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
        }
        taken |= {parameter.arg for parameter in definition.args.args}
        definition.decorator_list = []
        asked: dict[str, type] = {}
        definition.body = [line for old in definition.body for line in _expanded(old, parts, names, taken, asked)]
        definition.args.args[1:1] = [ast.arg(name) for name in asked]
        for parameter in definition.args.args:
            parameter.annotation = ast.Name(f"type_of_{parameter.arg}", ast.Load())
            names[parameter.annotation.id] = (function.__annotations__ | asked)[parameter.arg]
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


def _expanded(
    line: ast.stmt, parts: dict[str, wp.Function | Callable], names: dict, taken: set[str], asked: dict[str, type]
) -> list[ast.stmt]:
    """What stands for a statement of the kernel, whose own variables are ``taken``; see :func:`_inlined`."""
    if isinstance(line, ast.If):
        line.body = [new for old in line.body for new in _expanded(old, parts, names, taken, asked)]
    if isinstance(line, ast.Assign) and isinstance(line.value, ast.Call) and isinstance(line.value.func, ast.Name):
        part = line.value.func.id
        if part in parts:
            function = getattr(parts[part], "func", parts[part])
            body = _inlined(part, function, line.targets[0], line.value.args, names, taken, asked)
            return [new for old in body for new in _expanded(old, parts, names, taken, asked)]
    return [line]


def _inlined(
    part: str,
    function: Callable,
    target: ast.expr,
    arguments: list[ast.expr],
    names: dict,
    taken: set[str],
    asked: dict[str, type],
) -> list[ast.stmt]:
    """The body of ``function``, its own names behind that of the part.

    ``names`` learns what it refers to, ``asked`` which parameters it takes that are no variables of the kernel.
    """
    definition, known = _parsed(function)
    parameters = [parameter.arg for parameter in definition.args.args]
    given = dict(zip(parameters, [argument.id for argument in arguments], strict=False))
    given |= {name: name for name in parameters[len(arguments) :]}
    beyond = [name for name in parameters[len(arguments) :] if name not in taken]
    asked |= {name: inspect.get_annotations(function, eval_str=True)[name] for name in beyond}
    nodes = [node for node in ast.walk(definition) if isinstance(node, ast.Name)]
    own = {node.id for node in nodes if isinstance(node.ctx, ast.Store)}
    renamed = {}
    for name in {node.id for node in nodes} - set(given):
        if name in own or (name in known and (name in taken or names.get(name, known[name]) is not known[name])):
            renamed[name] = f"{part}_{name}"
        if name in known:
            names[renamed.get(name, name)] = known[name]
    for node in nodes:
        node.id = given[node.id] if node.id in given else renamed.get(node.id, node.id)
    body = [
        line for line in definition.body if not (isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant))
    ]
    answer, returns = body.pop(), [node for node in ast.walk(definition) if isinstance(node, ast.Return)]
    if returns != [answer] or own & set(given):
        raise InputError(
            f"{part} {function.__name__}: expected a function that returns once, at its end, and changes none of its "
            "parameters; give what changes a name of its own, and choose with pick instead of if."
        )
    targets = target.elts if isinstance(target, ast.Tuple) else [target]
    values = answer.value.elts if isinstance(answer.value, ast.Tuple) else [answer.value]
    if len(values) != len(targets):
        raise InputError(
            f"{part} {function.__name__}: expected a function that returns {len(targets)} values, one after another, "
            f"found {len(values)}; Projection.{part} says which."
        )
    read = {node.id for value in values for node in ast.walk(value) if isinstance(node, ast.Name)}
    if read.isdisjoint({place.id for place in targets}):
        return body + [ast.Assign([place], value) for place, value in zip(targets, values, strict=True)]
    # a target may be an argument: all values come before it changes
    found = [f"{part}_returned{i}" for i in range(len(values))]
    body += [ast.Assign([ast.Name(name, ast.Store())], value) for name, value in zip(found, values, strict=True)]
    return body + [ast.Assign([place], ast.Name(name, ast.Load())) for place, name in zip(targets, found, strict=True)]
