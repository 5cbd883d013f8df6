"""The package as others import it: public names in any order, threads, forks."""

import gc
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from functools import partial

import numpy as np
import pytest
import torch
from commands import PATIENCE, ROOT, SCENE, environment_of, python

import warp_splat
from warp_splat.runtime import launch, pool
from warp_splat.runtime.interrupts import later

NAMES = warp_splat.__all__


def test_version_on_the_command_line():
    assert warp_splat.__version__ in python("-m", "warp_splat", "--version").stdout


def test_ctrl_c_while_libraries_load():
    code = (
        "import signal, sys; from warp_splat import cli\n"
        "cli.pkgutil.resolve_name = lambda name: signal.raise_signal(signal.SIGINT)\n"
        "sys.exit(cli.main(['render']))"
    )
    run = python("-c", code, check=False)
    assert run.returncode == 130 and run.stderr == "warp-splat: interrupted before it began.\n"


def test_ctrl_c_while_libraries_end():
    code = "import signal, weakref; from warp_splat import cli; weakref.finalize(cli, signal.raise_signal, 2); "
    assert "Traceback" not in python("-c", code + "cli.main(['view'])", check=False).stderr


@pytest.mark.slow
def test_every_public_name_exists_after_any_other_import():
    """One process for all: lazily loaded names must not be shadowed by modules of the same name."""
    lines = ["import warp_splat.training.trainer", "from warp_splat import *"]
    lines += [f"from warp_splat import {a}, {b}" for a, b in itertools.permutations(NAMES, 2)]
    lines += ["import types", f"names = {NAMES!r}"]
    lines += ["assert not any(isinstance(getattr(warp_splat, name), types.ModuleType) for name in names)"]
    python("-c", "\n".join(lines))


def test_unknown_name():
    with pytest.raises(AttributeError, match="nothing_like_it"):
        _ = warp_splat.nothing_like_it


HELP = """
from warp_splat.cli import main
try: main(["train", "--help"])
except SystemExit as end: assert end.code == 0
"""


@pytest.mark.parametrize(
    ("code", "absent"),
    [
        ("import warp_splat", {"torch", "warp", "numpy"}),
        ("import warp_splat.evaluation.report, warp_splat.formats.png", {"matplotlib", "av"}),
        (HELP, {"torch", "warp", "numpy"}),
    ],
)
def test_what_is_not_needed_is_not_imported(code, absent):
    python("-c", f"{code}\nimport sys; assert not {absent} & set(sys.modules)")


def image(count=3000):
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(count, 3, generator=generator) + torch.tensor([0.0, 0.0, 5.0])
    camera = warp_splat.Camera(64, 48, 60.0, 60.0, 32.0, 24.0, torch.eye(3).numpy(), [0, 0, 0])
    quats, scales = torch.randn(count, 4, generator=generator), torch.full((count, 3), 0.05)
    sh = torch.randn(count, 1, 3, generator=generator)
    return warp_splat.rasterize(means, quats, scales, torch.full((count,), 0.5), sh, camera).image


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.slow
def test_a_forked_child_renders_too():
    image()  # other workers wait for kernels that this process compiles, and would compile those of another again
    code = (
        "import os, sys; sys.path.insert(0, 'tests'); import warp_splat; warp_splat.set_threads(2)\n"
        "from test_package import image\n"
        "expected = image()\n"
        "child = os.fork()\n"
        "if child == 0: os._exit(0 if (image() == expected).all() else 1)\n"
        "sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))"
    )
    python("-c", code)


def test_a_failing_launch_waits_for_its_helpers(monkeypatch, threads):
    """An error in one slice reaches the caller after the other slices have ended; what the caller held is free then."""
    threads(2)
    image()
    running, held = [], []

    def failing(*arguments, **options):
        running.append(options)
        raise RuntimeError("planted")

    def caller():
        tensor = torch.empty(9)
        held.append(weakref.ref(tensor))
        image()

    monkeypatch.setattr(launch, "_bound", lambda *_: failing)
    gc.disable()
    try:
        with pytest.raises(RuntimeError, match="planted"):
            caller()
        assert held[0]() is None, "it waits for the garbage collector"
    finally:
        gc.enable()
    assert running


def test_an_interrupted_launch_waits_for_its_helpers(threads):
    """Who is interrupted frees the tensors that helpers still write into."""
    threads(2)
    image()  # a helper is there
    begun, ended = threading.Event(), []

    def run(low, high):
        if threading.current_thread() is threading.main_thread():
            begun.wait()  # until the helper has the other slice
        else:
            begun.set()
            signal.raise_signal(signal.SIGINT)  # for the main thread, which waits for this one by now, or soon
            time.sleep(0.3)
            ended.append(low)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # in the background, shells have it ignored
    try:
        with pytest.raises(KeyboardInterrupt):
            pool._Job([partial(run, 0, 1), partial(run, 1, 2)]).share(helpers=1)
    finally:
        signal.signal(signal.SIGINT, before)
    assert len(ended) == 1


def test_ctrl_c_comes_once_a_library_is_loaded():
    before, loaded = signal.signal(signal.SIGINT, signal.default_int_handler), False
    try:
        with pytest.raises(KeyboardInterrupt), later():
            signal.raise_signal(signal.SIGINT)
            loaded = True
    finally:
        signal.signal(signal.SIGINT, before)
    assert loaded


def test_an_interrupt_at_any_step_leaves_nothing_locked(threads):
    """Ctrl-C may come between any two steps of the caller's, also within the library's own threading."""
    threads(2)
    image()  # a helper is there
    for chosen in itertools.count():
        steps = itertools.count()

        def interrupt(frame, event, _, steps=steps, chosen=chosen):
            if frame.f_code.co_filename in (pool.__file__, threading.__file__) and next(steps) == chosen:
                raise KeyboardInterrupt  # ends the tracing, too
            return interrupt

        sys.settrace(interrupt)
        try:
            pool.in_slices(lambda low, high: time.sleep(0.001), [0, 1, 2, 3])
        except KeyboardInterrupt:
            continue
        finally:
            sys.settrace(None)
        break
    assert chosen > 20


FIRST_RENDERS = """
import sys, threading
import numpy as np, torch
from warp_splat import Camera, RasterOptions, rasterize
sys.setswitchinterval(1e-6)  # threads meet within Warp's and the parser's work
camera = Camera(40, 30, 40.0, 40.0, 20.0, 15.0, np.eye(3), [0.0, 0.0, 4.0])

def gradient(depth):
    rows = [torch.full(shape, 0.5, requires_grad=True) for shape in [(9, 3), (9, 4), (9, 3), (9,), (9, 4, 3)]]
    rasterize(*rows, camera, options=RasterOptions(depth=depth)).image.sum().backward()
    found.append(rows[0].grad)

found = []
together = [threading.Thread(target=gradient, args=(bool(i % 2),)) for i in range(6)]
[thread.start() for thread in together]
[thread.join() for thread in together]
gradient(False)
print(sum(torch.equal(each, found[-1]) for each in found))
"""


@pytest.mark.slow
def test_first_renders_of_several_threads():
    """Else their kernels are mixed up, or fail in the parser; in about half of the runs before."""
    assert python("-c", FIRST_RENDERS).stdout.split()[-1] == "7"


@pytest.mark.parametrize("count", [0, "a", 1.5, True, np.ones(2)], ids=repr)
def test_threads_must_be_a_positive_number(count):
    with pytest.raises(warp_splat.InputError, match="threads"):
        warp_splat.set_threads(count)


def test_threads_may_be_a_whole_number_of_any_kind(threads):
    threads(np.int64(2))
    assert warp_splat.get_threads() == 2 and type(warp_splat.get_threads()) is int


@pytest.mark.slow
def test_a_terminal_that_is_closed_ends_a_training_as_ctrl_c_does(tmp_path):
    """It writes all that it has, and finds nobody to tell."""
    pty = pytest.importorskip("pty")
    folder, end = tmp_path / "model", time.time() + PATIENCE
    process, terminal = pty.fork()
    if not process:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup has it ignored
        options = ["-s", SCENE, "-r", "8", "-m", folder, "--iterations", "100000", "--test_iterations", "9", "--quiet"]
        os.execv(sys.executable, [sys.executable, ROOT / "train.py", *map(str, options)])
    while not (folder / "preview.png").exists() and time.time() < end:
        time.sleep(0.1)
    os.close(terminal)
    assert os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == 130
    assert (folder / "results.json").exists() and list(folder.glob("point_cloud/*/*.ply"))


HANGS_UP = """
import os, signal
from warp_splat.runtime.interrupts import interruptible
signal.signal(signal.SIGHUP, signal.SIG_DFL)
with interruptible() as found:
    os.kill(os.getpid(), signal.SIGHUP)
os._exit(0 if found else 3)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "words", [["-m", "warp_splat", "inspect", str(SCENE)], ["-c", HANGS_UP]], ids=["inspect", "signal"]
)
def test_nothing_is_said_where_streams_are_closed(words):
    pytest.importorskip("pty")
    command = ["sh", "-c", 'exec "$@" >&- 2>&-', "sh", sys.executable, *words]
    assert subprocess.run(command, check=False, cwd=ROOT, env=environment_of()).returncode == 0
