"""Imports point downwards (CONTRIBUTING.md): walks the package's imports and finds none that points up."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "warp_splat"
LAYERS = [
    {"errors", "config", "flags", "presets", "color"},
    {"kernels"},
    {"camera", "devices", "launch", "distributed", "formats", "interrupts", "scene.types"},
    {"checks", "binning", "adjoints", "lanes", "blocks", "projection", "renderer", "losses", "metrics", "scene"},
    {"gaussians", "optimizer", "densify", "forecast", "perceptual", "ways"},
    {"trainer", "selftest", "report", "evaluate", "events", "gradcheck", "differences"},
    {"run", "train", "render", "convert", "page", "sfm", "doctor", "viewer"},
    {"compare"},
    {"cli", "__init__", "__main__"},
]


def module_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    if parts[-1] == "__main__":
        return "__main__"
    return "scene.types" if parts == ("scene", "types") else parts[0]


def layer_of(module: str) -> int:
    return next(level for level, modules in enumerate(LAYERS) if module in modules)


def imported(path: Path):
    """(module of this package, whole dotted name) of each import that runs."""
    tree = ast.parse(path.read_text())
    typing_only = [
        node for node in ast.walk(tree) if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
    ]
    skipped = {id(inner) for node in typing_only for inner in ast.walk(node)}
    for node in ast.walk(tree):
        if id(node) in skipped or not isinstance(node, ast.ImportFrom | ast.Import):
            continue
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif node.module == "warp_splat":
            names = [f"warp_splat.{alias.name}" for alias in node.names]
        else:
            names = [node.module]
        yield from names


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_downwards(path):
    level = layer_of(module_of(path))
    for name in imported(path):
        parts = name.split(".")
        if parts[0] != "warp_splat" or len(parts) == 1:
            assert not (level == 0 and parts[0] in ("torch", "warp", "numpy")), (
                f"{path} must import the standard library only"
            )
            assert not (parts[0] == "torch" and "kernels" in path.parts), f"{path}: kernels never see torch"
            continue
        module = "scene.types" if parts[1:3] == ["scene", "types"] else parts[1]
        if module.startswith("__"):
            continue
        assert layer_of(module) <= level, f"{path.name} (layer {level}) imports {name} (layer {layer_of(module)})"


def test_only_launch_launches():
    for path in PACKAGE.rglob("*.py"):
        text = path.read_text()
        assert not ("wp.launch(" in text or "wp.launch_tiled(" in text) or path.name == "launch.py", path
