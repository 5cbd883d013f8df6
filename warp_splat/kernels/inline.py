"""Kernels assembled from functions without a call. LLVM leaves long functions as calls, and so their adjoints.

As calls, the projection takes 13 % longer and its adjoint 24 % (50,000 Gaussians, one thread, AVX-512). Loops that
kernels share, and what each of them does in it, are parts as well (:func:`warp_splat.kernels.cpu.blend.walk`).
"""

import ast
import inspect
import linecache
import textwrap
import zlib
from collections.abc import Callable
from dataclasses import dataclass

import warp as wp

from warp_splat.errors import InputError

Part = wp.Function | Callable


def defined(name: str, source: str, names: dict) -> Callable:
    """The function ``name`` of a text that may refer to ``names``, where Warp finds its source."""
    path = f"<{name} {zlib.crc32(source.encode())}>"
    linecache.cache[path] = (len(source), None, source.splitlines(keepends=True), path)
    exec(compile(source, path, "exec"), names)
    return names[name]


def without_gradient(*results: type) -> Callable[[Callable], wp.Function]:
    """Decorate a function of Warp with these results: its adjoint does nothing."""

    def decorate(function: Callable) -> wp.Function:
        made, name = wp.func(function), f"adj_{function.__name__}"
        types = function.__annotations__ | {f"adj_ret{place}": result for place, result in enumerate(results)}
        nothing = defined(name, f"def {name}({', '.join(types)}):\n    pass\n", {})
        nothing.__annotations__ = types
        wp.func_grad(made)(nothing)
        return made

    return decorate


def kernel_of_parts(module_options: dict, **parts: Part) -> Callable:
    """A decorator: the kernel with the bodies of ``parts`` in place of ``a, b = part(c, d)``, in a module of its own.

    Arguments of such a call are variables. A part changes none of its parameters, and returns once, at its end; one in
    place of ``part(c, d)`` returns nothing. It may call other parts. Parameters beyond the arguments are the kernel's
    variables of these names; where it has none, it takes one more parameter, behind its first. A part that is never
    called need not be a Warp function.

    Raises:
        InputError: if a part does otherwise.
    """

    def decorate(function: Callable) -> wp.Kernel:
        definition, names = _parsed(function)
        taken = set(function.__code__.co_varnames)
        assembly = _Assembly(parts, names, taken, dict(function.__annotations__))
        definition.decorator_list = []
        definition.body = assembly.expanded(definition.body)
        more = [ast.arg(name) for name in assembly.types if name not in function.__annotations__]
        definition.args.args[1:1] = more
        for parameter in definition.args.args:
            parameter.annotation = ast.Name(f"type_of_{parameter.arg}", ast.Load())
            names[parameter.annotation.id] = assembly.types[parameter.arg]
        source = ast.unparse(ast.fix_missing_locations(ast.Module([definition], [])))
        kernel = defined(function.__name__, source, names)
        return wp.kernel(module="unique", module_options=dict(module_options))(kernel)

    return decorate


def _parsed(function: Callable) -> tuple[ast.FunctionDef, dict]:
    """Its definition, and the value of every name that it may refer to."""
    definition = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
    assert isinstance(definition, ast.FunctionDef)
    return definition, {**function.__globals__, **inspect.getclosurevars(function).nonlocals}


@dataclass
class _Assembly:
    """What is known while a kernel is put together."""

    parts: dict[str, Part]
    names: dict  # what the kernel's text refers to
    taken: set[str]  # the kernel's own variables
    types: dict[str, type]  # of its parameters

    def expanded(self, lines: list[ast.stmt]) -> list[ast.stmt]:
        """Statements with the bodies of parts in place of their calls."""
        found = []
        for line in lines:
            if isinstance(line, ast.If | ast.For | ast.While):
                line.body, line.orelse = self.expanded(line.body), self.expanded(line.orelse)
            call = line.value if isinstance(line, ast.Assign | ast.Expr) else None
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id in self.parts:
                target = line.targets[0] if isinstance(line, ast.Assign) else None
                found += self.expanded(self.inlined(call.func.id, target, call.args))
            else:
                found.append(line)
        return found

    def inlined(self, part: str, target: ast.expr | None, arguments: list[ast.expr]) -> list[ast.stmt]:
        """The body of a part, its own names behind that of the part."""
        function = getattr(self.parts[part], "func", self.parts[part])
        definition, known = _parsed(function)
        parameters = [parameter.arg for parameter in definition.args.args]
        given = dict(zip(parameters, [argument.id for argument in arguments], strict=False))
        given |= {name: name for name in parameters[len(arguments) :]}
        beyond = [name for name in parameters[len(arguments) :] if name not in self.taken]
        self.types |= {name: inspect.get_annotations(function, eval_str=True)[name] for name in beyond}
        nodes = [node for node in ast.walk(definition) if isinstance(node, ast.Name)]
        own = {node.id for node in nodes if isinstance(node.ctx, ast.Store)}
        renamed = {}
        for name in {node.id for node in nodes} - set(given):
            another = name in known and self.names.get(name, known[name]) is not known[name]
            if name in own or another or (name in known and name in self.taken):
                renamed[name] = f"{part}_{name}"
            if name in known:
                self.names[renamed.get(name, name)] = known[name]
        for node in nodes:
            node.id = given[node.id] if node.id in given else renamed.get(node.id, node.id)
        body = definition.body[1:] if ast.get_docstring(definition) else definition.body
        name = f"{part} {function.__name__}"
        returns = [node for node in ast.walk(definition) if isinstance(node, ast.Return)]
        if returns != ([body[-1]] if target else []) or own & set(given):
            raise InputError(
                f"{name}: expected a function that returns once, at its end, and changes none of its "
                "parameters; give what changes a name of its own, and choose with pick instead of if."
            )
        if not target:
            return body
        answer = body.pop()
        targets = target.elts if isinstance(target, ast.Tuple) else [target]
        values = answer.value.elts if isinstance(answer.value, ast.Tuple) else [answer.value]
        if len(values) != len(targets):
            raise InputError(
                f"{name}: expected a function that returns {len(targets)} values, one after another, "
                f"found {len(values)}; Projection.{part} says which."
            )
        read = {node.id for value in values for node in ast.walk(value) if isinstance(node, ast.Name)}
        if read.isdisjoint({place.id for place in targets}):
            return body + [ast.Assign([place], value) for place, value in zip(targets, values, strict=True)]
        # a target may be an argument: all values come before it changes
        found = [f"{part}_returned{i}" for i in range(len(values))]
        body += [ast.Assign([ast.Name(name, ast.Store())], value) for name, value in zip(found, values, strict=True)]
        pairs = zip(targets, found, strict=True)
        return body + [ast.Assign([place], ast.Name(name, ast.Load())) for place, name in pairs]
