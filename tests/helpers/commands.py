"""Run the command line in another process and inspect the files it leaves."""

import os
import signal
import subprocess
import sys


def run_python(code, **options):
    """Run a program in a process of its own; return its result."""
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=True, **options)


def tree(folder):
    """Content of every file below a folder, by path; None for a folder."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


WITHOUT_PROGRESS = """
import sys
from morphgen.cli import main, progress
progress.FIRST_LINE = float("inf")  # on a busy machine all work is long, and would print lines
sys.exit(main())
"""


def start(*argv, **environment):
    """Start ``morphgen`` with arguments and environment variables; its output is piped."""
    return subprocess.Popen(
        [sys.executable, "-c", WITHOUT_PROGRESS, *map(str, argv)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | environment,
        preexec_fn=heed_ctrl_c,
    )


def heed_ctrl_c():
    """Restore Ctrl-C handling, which background processes of a shell ignore."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
