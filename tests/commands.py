"""Commands of ours, in this process and in others, and how they end."""

import io
import multiprocessing
import os
import re
import runpy
import signal
import socket
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest

from warp_splat.cli import main
from warp_splat.errors import InputError
from warp_splat.scene.embedded import embedded_scene
from warp_splat.training.trainer import Trainer

ROOT = Path(__file__).parents[1]
SCENE = embedded_scene()
FOX = Path(os.environ.get("WARP_SPLAT_FOX", ROOT.parent / "shared" / "data" / "fox"))
PATIENCE = 300.0  # seconds; a machine may be busy
#: Densifies, prunes, resets opacities and raises the SH degree within 60 steps.
SHORT = (
    "--eval -r 4 --iterations 60 --densify_from_iter 10 --densification_interval 10 --densify_until_iter 55 "
    "--opacity_reset_interval 30 --sh_interval 15 --densify_grad_threshold 0.00005 --quiet --test_iterations 3 9 33"
).split()


def train(folder, *options):
    """Train the embedded scene for :data:`SHORT`; the exit code."""
    return main(["train", "-s", str(SCENE), "-m", str(folder), *SHORT, *options])


def environment_of(path=ROOT, **more):
    """Of a process of Python that looks for modules in ``path`` first."""
    paths = [str(path), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths), **more}


def python(*words, check=True, path=ROOT, **environment):
    """A process of Python that has ended: what it said, and its exit code."""
    environment = environment_of(path, **environment)
    options = {"cwd": ROOT, "env": environment, "capture_output": True, "text": True, "timeout": 600}
    done = subprocess.run([sys.executable, *map(str, words)], check=False, **options)
    assert not (check and done.returncode), done.stderr
    return done


def started(*words, **pipes):
    """A process of Python that runs, with pipes for what it says."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "cwd": ROOT, **pipes}
    return subprocess.Popen([sys.executable, *map(str, words)], env=environment_of(), **pipes)


def forking():
    """Processes of Python that come from one that has loaded what a training needs."""
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["warp_splat.training.command"])
    return processes


def _as_torchrun_starts_it(environment, said, words):
    os.environ.clear()  # that of the first one forked
    os.environ.update(environment)
    os.dup2(said := os.open(said, os.O_WRONLY | os.O_APPEND | os.O_CREAT), 1)
    os.dup2(said, 2)
    sys.argv = list(words)
    runpy.run_path(words[0], run_name="__main__")


def together(count, *words):
    """A script by so many processes, as torchrun starts them, which takes longer: their exit codes, what they said."""
    with tempfile.TemporaryDirectory() as folder, socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        every = {**os.environ, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free.getsockname()[1])}
        every |= {"WORLD_SIZE": str(count), "LOCAL_WORLD_SIZE": str(count), "OMP_NUM_THREADS": "1"}
        free.close()
        said = Path(folder) / "said.txt"
        ranks = [{**every, "RANK": str(rank), "LOCAL_RANK": str(rank)} for rank in range(count)]
        processes = [forked_process(_as_torchrun_starts_it, rank, said, [*map(str, words)]) for rank in ranks]
        for process in processes:
            process.join(PATIENCE)
            process.kill()  # where it hangs
            process.join()
        return [process.exitcode for process in processes], said.read_text()


def forked_process(target, *arguments):
    """One that runs."""
    process = forking().Process(target=target, args=arguments)
    process.start()
    return process


def interrupt(monkeypatch, iteration):
    """Send SIGINT, as Ctrl-C does, while ``iteration`` is computed."""
    differentiate = Trainer.differentiate

    def interrupted(self, number):
        if number == iteration:
            os.kill(os.getpid(), signal.SIGINT)
        return differentiate(self, number)

    monkeypatch.setattr(Trainer, "differentiate", interrupted)


@contextmanager
def full_disk(limit):
    """Writes beyond ``limit`` bytes of a file fail, as the operating system reports it."""
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def no_space(path, *_):
    """In place of what writes a file."""
    raise InputError(f"{path}: could not be written (no space left on device).")


class CtrlC(io.StringIO):
    """The standard output of a command in this process, which presses Ctrl-C where a text begins with ``line``."""

    def __init__(self, line):
        super().__init__()
        self.line, self.heeded = line, []

    def write(self, text):
        if text.startswith(self.line):
            self.heeded.append(signal.getsignal(signal.SIGINT) is not signal.SIG_IGN)
            os.kill(os.getpid(), signal.SIGINT)
        return super().write(text)


@contextmanager
def served(*arguments):
    """A command with a viewer, once that is up: the process, its address, what it printed so far."""
    # as a shell's "&" starts it, ignoring SIGINT: Ctrl-C only works once the command has a handler for it
    ignoring = ["sh", "-c", 'trap "" INT; exec "$@"', "sh"]
    command = [*ignoring, sys.executable, "-m", "warp_splat", *map(str, arguments)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    process = subprocess.Popen(command, cwd=ROOT, **pipes)
    try:
        said = ""
        for line in process.stdout:
            said += line
            if found := re.search(r"Viewer at (http://127.0.0.1:\d+)", line):
                yield process, found[1], said
                return
        raise AssertionError(said)
    finally:
        process.kill()
        process.communicate()


def end(process):
    """Ctrl-C; the exit code, and what else was said."""
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=PATIENCE)[0]
    assert "Traceback" not in said
    return process.returncode, said


def changes_told(said):
    """The largest change of a pixel, measured, and its bound."""
    numbers = re.search(r"largest change of a pixel, .*: (\S+) measured, (\S+) its bound", said)
    return float(numbers[1]), float(numbers[2])
