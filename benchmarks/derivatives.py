"""How many lines a person had to write for the derivative of the pixel loop, counted in the source.

``python benchmarks/derivatives.py --out docs/benchmarks`` writes the table.
"""

import ast

from common import ROOT, parse, write_table

KERNELS = ROOT / "warp_splat" / "kernels"

_CLAMP = ("splat.adj_alpha_of",)
_EXP = ("falloff.adj_exp2_known", "step.adj_opaque", *_CLAMP)
_ROOT = ("step.conic_from_root",)
_READ = ("cpu/taped.adj_spread", "cpu/taped.adj_collect", *_ROOT)
_BEGIN = ("cpu/taped.replay_begin",)
_KEPT = ("cpu/taped.replay_front_of", "cpu/taped.adj_front_of")
_UNDO = (*_KEPT, "splat.odds_of")

#: Rules: functions that state a derivative or an inverse. Of overloads, one is counted.
RULES = {
    "manual": ("step.by_hand", "step.geometry_from_moments", "splat.adj_alpha_blend", "splat.odds_of", *_CLAMP),
    "stepwise": ("splat.odds_of", *_EXP, *_ROOT),
    "reversible": (*_BEGIN, *_UNDO, *_EXP, *_READ),
    "stored": (*_BEGIN, *_KEPT, *_EXP, *_READ),
    "generated": (*_BEGIN, *_UNDO, "simd.adj_halved"),
    "plain": (*_EXP, *_READ),
}
#: Plumbing: loops and steps restated so that they can be differentiated, and what carries values to and from them.
_KNOWN = ("falloff.exp2_known", "step.opaque")
_LOOP = ("cpu/blend.walk", *(f"cpu/adjoint.{name}" for name in ("adj_blend", "begin", "step", "finish", "folded")))
_WALK = ("cpu/taped.walk", "cpu/taped.spread", "cpu/taped.collect", "falloff.fall_value", *_KNOWN)
PLUMBING = {
    "manual": _LOOP,
    "stepwise": (*_LOOP, "step.stepwise", "step.step", *_KNOWN),
    "reversible": (*_WALK, "cpu/taped.begin", "cpu/taped.front_of"),
    "stored": (*_WALK, "cpu/taped.begin", "cpu/taped.front_of"),
    "generated": ("cpu/taped.walk", "cpu/taped.begin", "cpu/taped.front_of"),
    "plain": _WALK,
}


def derivative_lines(mode: str) -> tuple[int, int]:
    """Lines of rules and of plumbing that the derivative in ``mode`` needs, without depth.

    A line is a line of ``ast.unparse``: no comments, docstrings, or line breaks inside a statement.
    """
    count = lambda names: sum(_lines(*name.split("."), mode) for name in names)  # noqa: E731
    return count(RULES[mode]), count(PLUMBING[mode])


def _lines(module: str, name: str, mode: str) -> int:
    tree = ast.parse((KERNELS / f"{module}.py").read_text())
    nodes = (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef))
    found = next(node for node in nodes if node.name == name)
    return len(ast.unparse(_Specialize(mode).visit(found)).splitlines())


class _Specialize(ast.NodeTransformer):
    """Removes docstrings, and the branches of ``if wp.static(...)`` that a mode does not take."""

    def __init__(self, mode: str):
        self.known = {"mode": mode, "CHANNELS": 3, "way": -1, "known": True}

    def generic_visit(self, node: ast.AST) -> ast.AST:
        super().generic_visit(node)
        body = getattr(node, "body", None)
        if isinstance(body, list):
            if body and isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant):
                del body[0]
            body.extend([] if body else [ast.Pass()])
        return node

    def visit_If(self, node: ast.If) -> ast.AST | list[ast.stmt]:
        self.generic_visit(node)
        test = node.test
        if not (isinstance(test, ast.Call) and ast.unparse(test.func) == "wp.static"):
            return node
        taken = eval(ast.unparse(test.args[0]), {}, self.known)
        return node.body if taken else node.orelse


def main() -> None:
    counts = {mode: derivative_lines(mode) for mode in RULES}
    rows = [[mode, *lines, sum(lines)] for mode, lines in counts.items()]
    note = "Lines of Python that state a derivative or an inverse, and that restate the loop or carry values."
    data = {mode: {"rules": rules, "plumbing": plumbing} for mode, (rules, plumbing) in counts.items()}
    write_table("derivatives", parse(__doc__).out, ["mode", "rules", "plumbing", "lines"], rows, note, data)


if __name__ == "__main__":
    main()
