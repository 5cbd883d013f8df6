"""Imports point downwards: walks the package's imports and finds none that points up."""

import ast
import re
from collections import defaultdict
from itertools import chain
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "warp_splat"
#: A module imports from its own layer and those above it in this list.
LAYERS = [
    {"errors", "flags", "config", "presets", "text"},  # the standard library only
    {"lenses"},
    {"kernels", "runtime", "camera", "color"},
    {"raster"},
    {"formats"},
    {"scene", "evaluation", "gaussians", "tape", "gsplat", "newton"},
    {"rendering", "sfm", "viewer"},
    {"training"},
    {"pruning"},
    {"compare", "inspect", "export_html", "meshing"},
    {"audit"},
    {"cli", "__init__", "__main__"},
]


#: What may bear one name in several modules, beside the kernels and drivers of the two devices: it means the same.
SAME_MEANING = {
    "command",  # what runs a command, in the folder of each
    "blend",  # its kernels, its drivers, its torch function
    "through",  # a projection through a family of lenses
    "project",  # likewise
    "rasterize",  # of torch, on a tape
}


def layer_of(module: str) -> int:
    """Of a dotted name without the package's."""
    first = module.split(".", maxsplit=1)[0]
    return next(level for level, modules in enumerate(LAYERS) if first in modules)


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts)


def imported(path: Path):
    """The dotted name of each import that runs."""
    tree = ast.parse(path.read_text())
    branches = [node for node in ast.walk(tree) if isinstance(node, ast.If)]
    typing_only = [node for node in branches if "TYPE_CHECKING" in ast.dump(node.test)]
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


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=module_of)
def test_imports_point_downwards(path):
    level = layer_of(module_of(path) if path.name != "__main__.py" else "__main__")
    for name in imported(path):
        package, _, module = name.partition(".")
        if package != "warp_splat":
            assert not (level == 0 and package in ("torch", "warp", "numpy")), f"{path}: standard library only"
            in_kernels = "kernels" in path.relative_to(PACKAGE).parts
            assert not (package == "torch" and in_kernels), f"{path}: kernels never see torch"
        elif module and not module.startswith("__"):
            assert layer_of(module) <= level, f"{path.name} (layer {level}) imports {name} (layer {layer_of(module)})"


def test_the_ground_floor_is_small():
    assert len(list(PACKAGE.glob("*.py"))) <= 12


def test_only_launch_launches():
    for path in PACKAGE.rglob("*.py"):
        text = path.read_text()
        assert not ("wp.launch(" in text or "wp.launch_tiled(" in text) or path.name == "launch.py", path


def test_no_name_has_two_meanings():
    """Of modules, and of public functions and classes."""
    places = defaultdict(set)
    for path in PACKAGE.rglob("*.py"):
        place = module_of(path).replace("cuda", "cpu")
        if not path.name.startswith("__"):
            places[path.stem].add(f"module {place}")
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].add(place)
    modules = {name: {place for place in found if place.startswith("module ")} for name, found in places.items()}
    for name, found in places.items():
        for kind in (modules[name], found - modules[name]):
            assert len(kind) < 2 or name in SAME_MEANING, f"{name}: {sorted(kind)}"


def test_scripts_import_what_there_is():
    scripts = [(PACKAGE.parent / folder).rglob("*.py") for folder in ("assets", "benchmarks", "docs")]
    for path in chain(*scripts):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("warp_splat"):
                place = PACKAGE.parent / node.module.replace(".", "/")
                files = [file.stem for file in place.glob("*")] if place.is_dir() else []
                text = (place / "__init__.py" if place.is_dir() else place.with_suffix(".py")).read_text()
                known = {*re.findall(r"\w+", text), *files}
                assert known.issuperset(name.name for name in node.names), path
