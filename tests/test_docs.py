"""The documentation holds: its links, flags and tables, and every command and piece of code in it."""

import functools
import json
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
from contextlib import redirect_stdout
from pathlib import Path

import make_pages
import numpy as np
import pytest
import room
from commands import ROOT, SCENE, CtrlC
from scene_files import write_image

from warp_splat.cli import COMMANDS, main, parse
from warp_splat.flags import flags_of
from warp_splat.scene.depth_maps import PARAMETERS
from warp_splat.scene.images import read_size
from warp_splat.training.growth import GROWTHS
from warp_splat.training.parts import PARTS

DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.glob("*.md"))]
USERS = [page for page in PAGES if page.name != "CONTRIBUTING.md"]  # whose commands are tried; the others run for long
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
WRITTEN = {"per_view.md"}  # by commands, not in the repository
STEPS = "10"  # instead of thousands
PHOTOGRAPHS = 6

#: What shows that a line of the README's tables of inputs and outputs is true: tests, without "test_".
PROOFS = {
    "COLMAP, binary and text": """
        colmap_cameras_points_and_pixels largest_of_several_models undistorted_image_is_the_ideal_pinhole_image""",
    "nerfstudio, instant-ngp": """
        transforms_cameras_points_and_axes transforms_with_distortion
        transforms_intrinsics_of_frames_go_before_those_of_the_file""",
    "nerf-synthetic": "blender_axes_and_intrinsics blender_splits",
    "no points": "without_points_random_ones_in_the_views",
    "images": "sixteen_bits_and_gray jpeg images_are_found_by_their_stems",
    "alpha": "alpha_is_composited_on_the_background alpha_is_composited_on_random_backgrounds",
    "EXR, HDR, TIFF of floats": "floats_are_linear_light",
    "masks": "masks_by_either_name masked_loss metrics_do_not_see_what_is_masked",
    "`--start_ply FILE`": "start_from_a_file",
    "`.ply`": "reads_by_name_in_any_order_without_normals round_trip_returns_the_scene",
    "`.compressed.ply`": "compressed_ply_bytes_are_those_that_other_programs_read",
    "`.splat`": "splat_bytes_are_the_documented_layout",
    "`.spz`": "spz_bytes_are_the_documented_layout spz_version_2 spz_version_4_holds_the_same",
    "`.sog`": "sog_bytes_are_the_documented_layout a_palette_stands_for_many_harmonics archives_of_others_are_read",
    "`.glb`, `.gltf`": "gltf_holds_what_the_extension_says gltf_nodes_move_turn_and_scale",
    "`.usd`, `.usda`, `.usdc`, `.usdz`": """
        a_stage_holds_what_the_schema_says_and_comes_back fields_are_joined_as_their_parents_place_them""",
}


def name_of(page):
    return page.name


def blocks(page):
    """(language, text) of each fenced block."""
    return BLOCK.findall(page.read_text())


def prose(page):
    return BLOCK.sub("", page.read_text())


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)]+)\)", prose(page)):
        if target.startswith("http"):
            continue
        path, _, anchor = target.partition("#")
        found = page.parent / path if path else page
        assert found.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.*)$", found.read_text(), re.MULTILINE)
            assert anchor in [re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings], target


def test_every_picture_is_shown():
    text = "".join(page.read_text() for page in PAGES)
    assert not [path for path in (DOCS / "images").iterdir() if f"images/{path.name}" not in text]


@pytest.mark.parametrize("page", [page for page in USERS if not page.name.startswith("flags")], ids=name_of)
def test_flags_exist(page):
    flags = [item for config_type, *_ in COMMANDS.values() for item in flags_of(config_type)]
    known = {name for item in flags for name in (f"--{item.name}", *item.metadata.get("names", ()))}
    torchrun = {"--nproc-per-node", "--max-restarts"}
    foreign = torchrun | {"--help", "--version", "--no", "--logdir", "--with"}  # of TensorBoard, uv
    code = " ".join(re.findall(r"`([^`\n]+)`", prose(page)) + [text for kind, text in blocks(page) if not kind])
    used = {flag for flag in re.findall(r"(?<![\w-])--[a-z][\w-]*", code) if not flag.startswith("--no-")}
    assert used <= known | foreign | benchmark_flags()


@functools.cache
def benchmark_flags():
    scripts = [path for folder in ("assets", "benchmarks", "docs") for path in (ROOT / folder).glob("*.py")]
    return {
        flag
        for script in scripts
        for flag in re.findall(r'(?:add_argument|option)\([^)]*"(--\w+)"', script.read_text())
    }


def test_every_input_and_output_has_its_test():
    text = (ROOT / "README.md").read_text()
    tables = text[text.index("## What goes in") : text.index("## In your own torch code")]
    rows = [line.split("|")[1].strip() for line in tables.splitlines() if line.startswith("| ")]
    assert [row for row in rows if row not in ("in", "format")] == list(PROOFS)
    tests = "".join(path.read_text() for path in (ROOT / "tests").glob("test_*.py"))
    for name in " ".join(PROOFS.values()).split():
        assert f"def test_{name}(" in tests, name


def test_the_picture_of_the_house_is_that_of_the_imports():
    assert make_pages.PICTURE.read_text() == make_pages.make_architecture.picture(), "python docs/make_pages.py"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_files_exist(page):
    places = (ROOT, ROOT / "warp_splat", DOCS)
    for name in re.findall(r"`([\w/]+\.(?:py|js|glsl|md|txt))`", prose(page)):
        assert any((place / name).exists() for place in places) or name in WRITTEN, name


@pytest.mark.parametrize("page", make_pages.PAGES, ids=name_of)
def test_figures_tables_and_flags_are_those_of_their_sources(page):
    assert page.read_text() == make_pages.filled(page), "python docs/make_pages.py"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with what the pages presume: a scene, a trained model, a file of Gaussians, a configuration."""
    folder = tmp_path_factory.mktemp("user")
    model = folder / "output" / "abc123"
    assert main(["train", "-m", str(model), "-r", "8", "--iterations", STEPS, "--quiet"]) == 0
    assert main(["convert", str(model), str(folder / "vase.spz")]) == 0
    (folder / "mine.toml").write_text(f"iterations = {STEPS}\nresolution = 8\n")
    shutil.copytree(SCENE, folder / "path/to/scene")
    return folder


@pytest.fixture(scope="module")
def tried():
    """Commands, for pages that repeat those of another."""
    return set()


@pytest.mark.slow
@pytest.mark.parametrize("page", USERS, ids=name_of)
def test_commands(page, folder, tried, monkeypatch):
    """Each in its order, with few steps; what waits for a browser is ended by Ctrl-C."""
    lines = [line for language, text in blocks(page) if not language for line in text.splitlines()]
    monkeypatch.chdir(folder)
    for line in lines:
        command = line.removeprefix("pip install uv && ").partition("#")[0].strip()
        if command not in tried:
            run(command, folder)
            tried.add(command)


def run(line, folder):
    words = shlex.split(line)
    assert words[:2] == ["uv", "run"], line
    program, *arguments = words[2:]
    if program == "pytest":  # this
        return
    if program == "python":
        subprocess.run([sys.executable, ROOT / arguments[0], *arguments[1:]], check=True, capture_output=True)
        return
    if program == "torchrun":  # test_distributed.py::test_ctrl_c_stops_all_after_the_same_step runs it
        assert arguments[:3] == ["--nproc-per-node", "2", "train.py"], line
        parse(["train", *arguments[3:]])
        return
    arguments = {"train.py": ["train"], "render.py": ["render"], "warp-splat": []}[program] + arguments
    if arguments[0] == "sfm":
        room.write_photos(folder / "path/to/photos", PHOTOGRAPHS)
        shutil.rmtree(folder / "path/to/scene")
    if "--depths" in arguments:
        write_depths(folder / "path/to/scene")
    if arguments[0] == "train":
        if "-m" in arguments:  # another page may have trained there
            shutil.rmtree(folder / arguments[arguments.index("-m") + 1], ignore_errors=True)
        arguments += ["--iterations", "100000" if "--viewer" in arguments else STEPS]
        arguments += [] if "-r" in arguments else ["-r", "8"]
    if "--tensorboard" in arguments:
        pytest.importorskip("tensorboardX")
    if "--video" in arguments:
        arguments += ["--frames", "4"]
    watched = arguments[0] == "view" or "--viewer" in arguments
    with redirect_stdout(CtrlC("Viewer at") if watched else sys.stdout):
        assert main(arguments) == (130 if watched and arguments[0] == "train" else 0), line


def write_depths(scene):
    """A map of inverse depth for each photograph, in the reference's layout."""
    for path in (scene / "images").iterdir():
        width, height = read_size(path)
        write_image(scene / "depths" / f"{path.stem}.png", np.full((height, width, 1), 2**15, np.uint16))
    fits = {path.stem: {"scale": 1.0, "offset": 0.0} for path in (scene / "images").iterdir()}
    (scene / PARAMETERS).write_text(json.dumps(fits))


def example():
    """The README's code, which that of other pages continues."""
    return next(text for language, text in blocks(ROOT / "README.md") if language == "python")


@pytest.mark.parametrize(
    "page",
    [  # a minute to compile
        pytest.param(page, marks=[pytest.mark.slow] * (page.name == "extending.md"), id=page.name)
        for page in USERS
        if "```python" in page.read_text()
    ],
)
def test_code(page, tmp_path, monkeypatch):
    monkeypatch.chdir(with_scene(tmp_path))
    monkeypatch.syspath_prepend(tmp_path)
    names = {}
    for table, name in ((PARTS, "tint"), (GROWTHS, "fade")):
        monkeypatch.setitem(table, name, None)  # set by a page, and gone after it
        del table[name]
    exec(example(), names)
    for language, text in blocks(page):
        if file := re.match(r"# (\w+\.py)\n", text):
            Path(file[1]).write_text(text)
        elif language == "python":
            exec(text, names)
            if "from orthographic" in text:
                exec(textwrap.dedent(ORTHOGRAPHIC), names)
        elif language == "diff":  # before, and after
            for side in "-+":
                exec("".join(f"{line[1:]}\n" for line in text.splitlines() if line[:1] in (" ", side)), names)
    assert "report" not in names or names["report"].ok
    assert all(names[name].grad.isfinite().all() for name in ("means", "quats", "scales", "opacities", "sh"))


def with_scene(folder):
    (folder / "path/to").mkdir(parents=True)
    (folder / "path/to/scene").symlink_to(SCENE)
    return folder


#: After the code of docs/extending.md that uses a projection of its own: is it the renderer that it says?
ORTHOGRAPHIC = """
    out = warp_splat.rasterize(means, quats, scales, opacities, sh, flat, options=options)
    turned = means.detach().double() @ torch.tensor(flat.rotation).T + torch.tensor(flat.translation)
    wanted = turned[:, :2] * torch.tensor([flat.fx, flat.fy]) + torch.tensor([flat.cx, flat.cy])
    seen = out.radii > 0
    assert seen.sum() > 100 and torch.allclose(out.means2d[seen].double(), wanted[seen], atol=1e-3)
    assert warp_splat.check_gradients(means, quats, scales, opacities, sh, flat, options=options).ok
"""
