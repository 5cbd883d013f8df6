"""The audit of renderers: a deliberately wrong one is found out, one that hangs or dies gets a row."""

import functools
import json
import os
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import audit
import audit_targets
import numpy as np
import psutil
import pytest
import torch
import wrong_renderer
from audit_targets import own
from browser import CHROMIUM
from commands import forking
from hostile import refusal

from warp_splat.audit import program
from warp_splat.audit.judged import RUNS, SceneRow, exact_image, measure
from warp_splat.audit.probes import FOCAL, GREEN, NEARLY_ROUND
from warp_splat.audit.renderer import Answer, Renderer, _draw, function_of
from warp_splat.audit.rules import find_rules
from warp_splat.audit.small_scenes import SCENES, on_all_pixels
from warp_splat.cli import main
from warp_splat.errors import InputError
from warp_splat.formats.ply import load_ply
from warp_splat.formats.png import load_png

USUAL = {"blur": 0.3, "antialiasing": False, "alpha_min": 1 / 255, "alpha_max": 0.99, "t_min": 1e-4, "near": 0.2}
USUAL["projection"] = "affine"


@pytest.fixture(autouse=True)
def forked(monkeypatch):
    """Renderers need not load anew what they draw with."""
    processes = forking()
    monkeypatch.setattr("multiprocessing.get_context", lambda method: processes)


def rules_of(eight_bit=False, **broken):
    def draw(workload):
        *geometry, dc, rest = workload.gaussians
        assert (workload.gaussians.scales > 0).all()  # which a renderer may ask for, and a file cannot say otherwise
        given = (*geometry, torch.cat([dc, rest], 1), workload.camera, workload.background)
        image = wrong_renderer.draw(wrong_renderer.Wrong(**broken), *given).float().double().numpy()
        image = np.round(image.clip(0, 1) * 255) / 255 if eight_bit else image
        return Answer(image, eight_bit, {}, True)

    return find_rules(draw)


@pytest.fixture(scope="module")
def right():
    return rules_of()


def test_a_right_renderer_has_the_usual_rules(right):
    assert right.options == pytest.approx(USUAL)
    assert "+0.5" in right.sentences["camera"] and "axis" in right.sentences["order"]
    assert "usual" in right.sentences["harmonics"] and "no antialiasing" in right.sentences["antialiasing"]


#: What is broken, whose sentence changes, what it then says, and what becomes of the options.
BROKEN = [
    ({"alpha_min": 1 / 512}, "cut", "1/512", {"alpha_min": 1 / 512}),
    ({"alpha_min": 0.0}, "cut", "No alpha is left out", {"alpha_min": 0.0}),
    ({"alpha_max": 0.999}, "clamp", "at 0.999", {"alpha_max": 0.999}),
    ({"alpha_max": 1.0}, "clamp", "not clamped", {"alpha_max": 0.9999}),
    ({"t_min": 1e-3}, "stop", "below 0.001", {"t_min": 1e-3}),
    ({"t_min": 0.0}, "stop", "does not stop", {"t_min": 0.0}),
    ({"near": 0.01}, "near plane", "about 0.01", {"near": 0.01}),
    ({"near": 0.0}, "near plane", "no near plane", {"near": 1e-6}),
    ({"blur": 0.1}, "low-pass", "0.1 px", {"blur": 0.1}),
    ({"blur": 0.0}, "low-pass", "no low-pass", {"blur": 1e-6}),
    ({"antialiasing": True}, "antialiasing", "scaled by the share", {"antialiasing": True}),
    ({"extent": 3.0}, "extent", "ends 3.0 standard deviations", {}),
    ({"rotation": "xyzw"}, "rotation", "x, y, z, w.", {}),
    ({"rotation": "inverse"}, "rotation", "inverse", {}),
    ({"flipped": (1, 3)}, "harmonics", "1 has the other sign; 3 has the other sign", {}),
    ({"flipped": (9,)}, "harmonics", "coefficient 9 has the other sign.", {}),
    ({"swapped": (1, 2)}, "harmonics", "1 is taken for 2; 2 is taken for 1", {}),
    ({"order": "distance"}, "order", "distance from the camera", {}),
    ({"order": "reversed"}, "order", "reversed", {}),
    ({"order": "file"}, "order", "not sorted: the first", {}),
    ({"space": "encoded"}, "color space", "after blending: it comes out too bright", {}),
    ({"space": "decoded"}, "color space", "decoded from sRGB before blending", {}),
    ({"space": "linear"}, "color space", "blended in linear light", {}),
    ({"background": "black"}, "background", "ignored; it is black", {}),
    ({"background": "white"}, "background", "ignored; it is white", {}),
    ({"shift": 0.5}, "camera", "on average by (0.50, 0.50)", {}),
    ({"projection": "ellipsoid"}, "camera", "ellipsoids along rays", {"projection": "ellipsoid"}),
]


@pytest.mark.parametrize(("broken", "name", "says", "options"), BROKEN, ids=lambda value: str(value)[:40])
def test_a_broken_rule_is_found_and_no_other(broken, name, says, options, right):
    found = rules_of(**broken)
    assert says in found.sentences[name]
    assert found.options == pytest.approx(USUAL | options, abs=1e-9)
    others = {rule for rule, sentence in found.sentences.items() if sentence != right.sentences[rule]} - {name}
    assert others <= {"camera"}  # which tells a figure that depends on the others


@pytest.mark.parametrize(("broken", "name", "says", "options"), BROKEN, ids=lambda value: str(value)[:40])
@pytest.mark.slow
def test_a_broken_rule_is_found_in_eight_bits(broken, name, says, options):
    if {"t_min", "alpha_max"} & set(broken):
        pytest.skip("8 bits do not show it")
    assert says in rules_of(eight_bit=True, **broken).sentences[name]


def test_blending_in_eight_bits_is_not_taken_for_a_stop():
    """160 faint layers let four levels through, as a stop at 0.015 would."""
    assert "does not stop" in rules_of(eight_bit=True, rounded=True).sentences["stop"]
    assert "below 0.0" in rules_of(eight_bit=True, t_min=0.02).sentences["stop"]


@pytest.fixture
def importable(monkeypatch):
    """Processes of their own find wrong_renderer."""
    here = str(Path(__file__).parent)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([here, os.environ.get("PYTHONPATH", "")]))


def rows_of(place, names, pause=0.0, **options):
    """Of the audit of a renderer, scene by scene."""
    renderer, rows = Renderer(place, **options), []
    for row in measure(renderer, {}, scenes=names.split()):
        rows.append(row)
        time.sleep(pause)
    renderer.close()
    return rows


@pytest.mark.slow
@pytest.mark.parametrize(
    ("function", "says"),
    [
        ("hangs", "hangs: no answer in 1 s"),
        ("crashes", "ended with 7"),
        ("nothing_of_that_name", "MODULE:function that can be imported"),
        ("draws_nothing", "draws nothing"),
        ("counts", "returned int64, neither floats nor uint8"),
    ],
)
def test_what_hangs_dies_or_draws_nothing_gets_a_row(importable, function, says):
    rows = rows_of(f"wrong_renderer:{function}", "one two", limit=1.0 if function == "hangs" else 60.0)
    assert [says in row.verdict for row in rows] == [True, True]
    assert {row.level for row in rows} <= {"warning", "error"}


def test_parameters_of_the_renderer_itself_want_no_gradients():
    own = torch.ones(3, requires_grad=True)
    arrays = [np.zeros((1, 1, 3), np.float32)] * 7
    image, gradients = _draw(lambda *given: own * torch.ones(2, 2, 3), arrays, None, None)
    assert image.shape == (2, 2, 3) and not gradients


@pytest.mark.slow
def test_what_dies_between_two_answers_ends_no_audit(importable):
    rows = rows_of("wrong_renderer:dies_later", "one two", pause=0.5)
    assert len(rows) == 2 and any("ended with 7" in row.verdict for row in rows)


@pytest.mark.slow
def test_what_refuses_is_asked_again(importable):
    rows = rows_of("wrong_renderer:ends_early", "one two cloud opaque faint")
    assert len(rows) == 5 and all("refuses: EOFError" in row.verdict for row in rows)


@pytest.mark.long  # it waits for half a minute
def test_a_page_that_hangs_gets_a_row_and_the_next_scene_is_drawn(tmp_path):
    """Playwright gives the first one up after half a minute; that tab answers no more."""
    pytest.importorskip("playwright")
    if not CHROMIUM:
        pytest.skip("no Chromium")
    (tmp_path / "page.html").write_text(
        "<script>const file = new XMLHttpRequest(); file.open('GET', '/scene.ply', false);"
        "file.overrideMimeType('text/plain; charset=x-user-defined'); file.send();"
        "while (file.responseText.includes('vertex 1\\n')); window.show = async () => {};</script>"
    )
    first, second = rows_of(str(tmp_path / "page.html"), "one two")
    assert "Timeout" in first.verdict and second.verdict == "draws nothing"


@pytest.mark.slow
def test_this_renderer_is_as_float64(importable):
    (row,) = rows_of("audit_targets.own:manual", "cloud")
    assert row.verdict == "as in float64" and row.same and row.runs == RUNS and row.largest < 1e-4
    assert set(row.gradients) == {"means", "quats", "scales", "opacities", "sh", "background"}
    assert max(row.gradients.values()) < 1e-4


@pytest.mark.slow
def test_a_program_is_audited_and_its_finding_made_small(tmp_path):
    """It draws black whatever it is asked, but for very few Gaussians; then nothing, of which nothing old is shown."""
    program = tmp_path / "program.py"
    black = "import os, sys\nfrom PIL import Image\nassert os.path.getsize(sys.argv[1]) > 1300\n"
    program.write_text(f"{black}Image.new('RGB', (64, 48)).save(sys.argv[3])\n")
    command = f"{sys.executable} {program} {{ply}} {{cameras}} {{out}}"
    assert main(["audit", "black", "--command", command, "--case", "cloud", "--out", str(tmp_path / "out")]) == 1
    assert len(load_ply(tmp_path / "out" / "scene.ply").splats.means) < len(SCENES["cloud"][1]()[0]["means"]) / 4
    assert len(json.loads((tmp_path / "out" / "cameras.json").read_text())) == 1
    assert not load_png(tmp_path / "out" / "found.png").any() and load_png(tmp_path / "out" / "expected.png").any()
    program.write_text("1 / 0")
    assert main(["audit", "black", "--command", command, "--case", "cloud", "--out", str(tmp_path / "out")]) == 1
    assert not list(tmp_path.glob("out/found.*"))


@pytest.mark.slow
def test_a_module_of_the_folder_where_one_stands_is_audited(tmp_path):
    """By the installed command, and by the process that draws, whose defaults are its own."""
    defaults = "import torch\ntorch.set_default_dtype(torch.float64)\ntorch.set_grad_enabled(False)\n"
    (tmp_path / "mine.py").write_text(defaults + "def draw(*given):\n    return given[-1].expand(48, 64, 3)\n")
    command = [Path(sys.executable).parent / "warp-splat", "audit", "mine:draw", "--case", "one"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout.startswith("one: 1 Gaussian on ") and "off by 0.719" in done.stdout, done.stderr


def shown_by(place):
    """What a renderer draws of the scene of one Gaussian."""
    drawn, camera = SCENES["one"][1]()
    given = [drawn[name] for name in ("means", "quats", "scales", "opacities", "sh_dc")]
    return function_of(place)(*given, camera, torch.zeros(3))


@pytest.mark.slow
def test_what_hangs_ends_with_what_it_has_started(tmp_path, monkeypatch):
    """And leaves no file."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    (tmp_path / "hangs.sh").write_text(f"echo $$ > {tmp_path / 'number'}; exec sleep 600\n")
    renderer = Renderer(f"sh {tmp_path / 'hangs.sh'} {{out}}", limit=5.0)
    (row,) = measure(renderer, {}, scenes=("one",))
    renderer.close()
    number, end = int((tmp_path / "number").read_text()), time.monotonic() + 20
    while psutil.pid_exists(number) and psutil.Process(number).status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < end
    assert "hangs" in row.verdict
    renderer.folder.cleanup()  # as at its end
    assert not list((tmp_path / "temporary").iterdir())


def test_ctrl_c_keeps_the_rows_before_it(tmp_path, monkeypatch):
    def interrupted(*_):
        yield SceneRow("one", "one of them", "hangs", "error")
        raise KeyboardInterrupt

    monkeypatch.setattr("warp_splat.audit.command.measure", interrupted)
    facts = {"target": "mine", "date": "", "rules": {}, "options": {}, "background": [0.0] * 3}
    monkeypatch.setattr("warp_splat.audit.command.tell_rules", lambda *_: facts)
    monkeypatch.setattr(Renderer, "start", lambda self: None)
    assert main(["audit", "mine:draw", "--out", str(tmp_path)]) == 130
    assert [row["scene"] for row in json.loads((tmp_path / "audit.json").read_text())["scenes"]] == ["one"]


@pytest.mark.slow
def test_a_program_may_write_an_exr(tmp_path):
    """Floats come back as they are: above 1, and in more than 256 levels."""
    program = tmp_path / "program.py"
    program.write_text(
        "import sys\nimport numpy as np\nimport OpenImageIO as oiio\n"
        "image = oiio.ImageBuf(oiio.ImageSpec(64, 48, 3, oiio.HALF))\n"
        "image.set_pixels(oiio.ROI(), np.full((48, 64, 3), [1.5, 0.501, 0.25], np.float32))\n"
        "image.write(sys.argv[1])\n"
    )
    image = shown_by(f"{sys.executable} {program} {{exr}}")
    assert image.dtype == np.float32
    np.testing.assert_allclose(image, np.broadcast_to([1.5, 0.501, 0.25], (48, 64, 3)), rtol=1e-3)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nobody"], "MODULE:function that can be imported"),
        (["nothing.html"], "expected a page, found no such file"),
        (["no_module:draw"], "that can be imported"),
        (["x", "--command", "prog {ply}"], "{out}"),
        (["x", "--command", "false"], "{out} (or {exr}) in it, found 'false'"),
        (["x", "--command", "no_such_program {out}"], "a program that can be run, found 'no_such_program'"),
        (["x", "--command", "prog {scene} {out}"], "expected {ply}, {cameras} and {out}"),
        *((["x", "--command", f"prog {wrong}"], "expected {ply}, {cameras}") for wrong in ("'{out}", "{ply.x} {out}")),
        (["wrong_renderer:torch"], "expected a function, found module"),
        (["audit_targets.own:manual", "--case", "nothing"], "expected one of one, two"),
        (["audit_targets.own:manual", "--case", "one", "--limit", "nan"], "--limit: expected a finite number"),
        (["audit_targets.own:manual", "--case", "one", "--degree", "9"], "--degree: expected 0 to 3, got 9"),
        (["audit_targets.own:manual", "-o", __file__], "expected a folder that can be written"),
        (["exits:draw"], "that can be imported, found SystemExit(3)"),
        (["ends:draw"], "its process ended with 0"),
    ],
)
def test_bad_input_is_one_sentence(arguments, says, fails, tmp_path, monkeypatch):
    (tmp_path / "exits.py").write_text("raise SystemExit(3)")
    (tmp_path / "ends.py").write_text("import os; os._exit(0)")
    monkeypatch.syspath_prepend(tmp_path)
    assert says in fails("audit", *arguments)


@pytest.mark.parametrize("color", [(0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (np.nan, np.nan, np.nan)], ids=str)
def test_nothing_is_read_off_a_picture_that_shows_nothing(color):
    """The same picture whatever it is asked for."""
    blank = Answer(np.broadcast_to(color, (47, 63, 3)), False, {}, True)
    rules = find_rules(lambda workload: blank)
    assert list(rules.sentences) == ["background"] and "shows nothing" in rules.sentences["background"]


def test_a_page_whose_packages_cannot_be_fetched_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(program, "CACHE", tmp_path)
    monkeypatch.setenv("PATH", "")
    page = audit_targets.OTHERS["spark"].place
    refusal(lambda: function_of(page), match=r"spark.html: expected npm, which fetches three@.*; install Node.js")


def test_a_browser_that_cannot_be_started_is_told_each_time(monkeypatch):
    """What playwright says of a second start of its own would hide that."""
    starts = [SimpleNamespace(chromium=SimpleNamespace())]  # without launch
    fake = SimpleNamespace(sync_playwright=lambda: SimpleNamespace(start=starts.pop))
    monkeypatch.setitem(sys.modules, "playwright.sync_api", fake)
    monkeypatch.setattr(program, "_playwright", functools.cache(program._playwright.__wrapped__))
    for _ in range(2):
        with pytest.raises(AttributeError, match="launch"):
            program._browser.__wrapped__()


@pytest.mark.parametrize(
    ("command", "says"), [("true {out}", "wrote no picture"), ("false {out}", "exit code 1: no reason given$")]
)
def test_a_program_that_writes_no_picture_says_so(command, says):
    with pytest.raises(RuntimeError, match=says):
        shown_by(command)


def test_tiny_rotations_are_not_lost_in_gsplats_function():
    """What the audit found: squares of 1e-20 underflow."""
    drawn, camera = SCENES["quats_1e-20"][1]()
    given = [drawn[name] for name in ("means", "quats", "scales", "opacities")]
    given += [torch.cat([drawn["sh_dc"], drawn["sh_rest"]], 1), camera, torch.zeros(3)]
    small = own.as_gsplat(*given)
    given[1] = given[1] * 1e20
    torch.testing.assert_close(small, own.as_gsplat(*given), atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("disks", "shift", "error"), [(False, 0.0, 1e-6), (False, 0.01, 1e-4), (True, 0.0, 1e-9), (True, 0.3, 0.06)]
)
def test_the_camera_of_what_rays_see_is_measured(disks, shift, error):
    """Soft Gaussians and opaque disks, moved to the right by ``shift`` px."""

    def draw(workload):
        means, _, scales, opacities, *_ = (tensor.double().numpy() for tensor in workload.gaussians)
        moved = means + shift / FOCAL * means[:, 2:] * [1, 0, 0]
        arrays = {"means": moved, "scales": scales / NEARLY_ROUND, "opacities": opacities}
        cover = audit.along_rays(arrays, workload.camera)
        return Answer((cover > audit.DISK if disks else cover)[..., None] * GREEN, False, {}, True)

    assert audit.camera_error(SimpleNamespace(draw=draw), 0, 31)[0] == pytest.approx(shift, abs=error)


def test_a_weaker_filter_is_not_taken_for_a_shift():
    """Its Gaussians are smaller, and beside the middle those of another place have another shape."""

    def draw(workload):
        options = replace(workload.options, blur=0.05)
        return Answer(exact_image(replace(workload, options=options)), False, {}, True)

    assert audit.camera_error(SimpleNamespace(draw=draw), 0, 31)[0] < 1e-4


def test_adapters_are_small():
    folder = Path(audit_targets.__file__).parent
    for path in folder.iterdir():
        assert path.is_dir() or len(path.read_text().splitlines()) <= 80, path


@pytest.mark.parametrize("name", [*audit_targets.OURS, *audit_targets.OTHERS])
def test_every_target_of_a_table_can_be_called_or_is_absent(name):
    """Absent: whoever asks for it is told so in a sentence."""
    try:
        assert callable(function_of({**audit_targets.OURS, **audit_targets.OTHERS}[name].place))
    except InputError as error:
        assert name not in audit_targets.OURS
        assert re.search("No module named|no CUDA device|(needs|expected) npm", str(error))


def test_harmonics_are_cut_where_a_renderer_claims_none():
    assert on_all_pixels("cloud", SCENES["cloud"][1](), degree=0).gaussians.sh_rest.shape[1] == 0
