"""Commands on a GPU that is pretended (``pretend_cuda``): nothing mixes it with the host, and no step waits for it."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import python
from pretended_runs import CHANGES, STEPS, TRAININGS
from scene_files import write_colmap, write_floats

HERE = Path(__file__).parent
REAL = f"{HERE.parent}:{HERE}:{HERE.parent / 'benchmarks'}"
PRETENDING = f"{HERE / 'pretend_cuda'}:{REAL}"
NAMES = ("a.png", "b.png", "c.png")
#: Commands that others see most of.
SELDOM = ("grid", "stepwise", "reversible", "stored", "clean", "compare", "bound", "profile", "resume")
#: What a training waits for by design: docs/cuda.md.
WAITING = {"profile": {"runtime/timers.py:_now"}}


def ran(folder, names=(), path=PRETENDING):
    """What became of each command."""
    done = python(HERE / "pretended_runs.py", folder, *names, check=False, path=path)
    lines = [json.loads(line.removeprefix("ran ")) for line in done.stdout.splitlines() if line.startswith("ran ")]
    assert lines and not done.returncode, done.stderr
    return {line["name"]: line for line in lines}


@pytest.fixture
def folder(tmp_path):
    """With a scene of three photographs and their depth."""
    scene = write_colmap(tmp_path / "scene", NAMES)
    for name in NAMES:
        write_floats(scene / "depths" / f"{name[0]}.exr", np.full((32, 48, 1), 0.2, np.float32))
    return tmp_path


def check_codes(found):
    wrong = {name: line["code"] for name, line in found.items() if line["code"] != 0}
    assert not wrong, "\n".join(map(str, wrong.values()))


def check(found):
    """Each ended well; between changes of the set, and once every photograph was there, no step waited."""
    check_codes(found)
    quiet = [step for step in range(5, STEPS + 1) if step not in {*CHANGES, *(change + 1 for change in CHANGES)}]
    for name, line in found.items():
        waits = [note for note in line["waits"] if note["iteration"] in quiet]
        places = {note["where"].split(" < ")[0] for note in waits if not name == "resume"}  # profiled, too
        assert places == WAITING.get(name, set()), (name, waits)


@pytest.mark.slow
def test_commands(folder):
    others = ("first call", "render", "view", "simplify", "learned camera", "gsplat")
    names = [name for name in (*TRAININGS, *others) if name not in SELDOM]
    check(ran(folder, names))


@pytest.mark.slow
def test_newtons_sensor_works_in_the_stream_that_warp_works_in(folder):
    pytest.importorskip("newton", reason="newton is not installed")
    check(ran(folder, ["simulation"]))


@pytest.mark.slow
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
def test_commands_on_a_gpu(folder):
    check_codes(ran(folder, path=REAL))


@pytest.mark.long
def test_every_command(folder):
    found = ran(folder)
    check(found)
    assert set(TRAININGS) < set(found) and set(SELDOM) < set(found)
