"""A command of ours that serves a viewer, and how it ends."""

import io
import os
import re
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

PATIENCE = 300.0  # seconds; a machine may be busy


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
def served(*arguments, cwd=Path(__file__).parents[1]):
    """A command with a viewer, once that is up: the process, its address, what it printed so far."""
    # as a shell's "&" starts it, ignoring SIGINT: Ctrl-C only works once the command has a handler for it
    ignoring = ["sh", "-c", 'trap "" INT; exec "$@"', "sh"]
    command = [*ignoring, sys.executable, "-m", "warp_splat", *map(str, arguments)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    process = subprocess.Popen(command, cwd=cwd, **pipes)
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
