"""A process that runs commands on hostile input, and what it may use.

``Runner`` starts it and sends it one command at a time; as a program, this module is that process.
Commands share a process because starting one takes longer than most commands run.
"""

import contextlib
import io
import json
import math
import os
import resource
import select
import subprocess
import sys
import traceback
from pathlib import Path

TIME_S = 10.0
"""A command that takes longer counts as a hang."""
MEMORY_MIB = 1024
"""Largest resident set that a command may reach, with Python and its libraries."""
_ADDRESS_SPACE = 8 << 30
"""Bytes. It stops a runaway before the machine swaps; Python and its libraries map 2 GiB."""


class Runner:
    """Runs commands in a process that it starts again after a hang."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.process: subprocess.Popen[str] | None = None

    def run(self, *argv: object) -> dict:
        """Run a command.

        Returns:
            Its exit code, its stdout and stderr, and the peak memory of the process in MiB.

        Raises:
            AssertionError: If it hangs, or the process dies.
        """
        if self.process is None:
            self.process = subprocess.Popen(
                [sys.executable, "-P", __file__],  # -P: modules beside it are not packages
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                cwd=self.folder,
                text=True,
                env={**os.environ, "XDG_CACHE_HOME": str(self.folder / "cache")},
            )
        assert self.process.stdin
        assert self.process.stdout
        self.process.stdin.write(json.dumps([str(word) for word in argv]) + "\n")
        self.process.stdin.flush()
        ready, _, _ = select.select([self.process.stdout], [], [], TIME_S)
        answer = self.process.stdout.readline() if ready else ""
        if not answer:
            code = self.process.poll()
            self.close()
            raise AssertionError("it hangs" if code is None else f"the process died: {code}")
        return json.loads(answer)

    def close(self) -> None:
        """End the process."""
        if self.process is not None:
            self.process.kill()
            self.process.communicate()
            self.process = None


def serve() -> None:
    """Run the commands that arrive on stdin."""
    from morphgen.cli import main, progress

    progress.FIRST_LINE = math.inf  # on a busy machine all work is long, and would print lines
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
    answers = sys.stdout
    for line in sys.stdin:
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                code = main(json.loads(line))
            except SystemExit as end:
                code = end.code
            except BaseException:
                traceback.print_exc()
                code = None
        # Not ru_maxrss, which starts at the value of the parent process.
        status = Path("/proc/self/status").read_text()
        peak = int(status.partition("VmHWM:")[2].split()[0]) / 1024
        answer = {
            "code": code,
            "out": out.getvalue()[-4000:],
            "err": err.getvalue()[-4000:],
            "mib": peak,
        }
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    serve()
