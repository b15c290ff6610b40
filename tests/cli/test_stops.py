"""Commands that a signal stops, or that meet a full disk: one line, no partial files."""

import errno
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from helpers.commands import heed_ctrl_c, tree
from helpers.runs import small_split
from morphgen.formats import files
from morphgen.splits.split import split_text

WRITERS = {
    **{f"export {f}": ["export", "prims", "--format", f] for f in ("urdf", "mjcf", "sdf", "ros2")},
    **{f"export {f}": ["export", "prims", "--format", f] for f in ("html", "glb", "srdf")},
    "compose": ["compose", "prims", "--no-picture", "--out", "out"],
    "import": ["import", "tiny.urdf", "--no-picture", "--out", "out"],
    "sample": ["sample", "chain", "-n", 2, "--light", "--out", "out"],
    "build": ["split", "build", "interpolation/arm3/reach", "--out", "out"],
    "tokens": ["tokens", "prims", "--out", "out.npz"],
    "similarity": ["similarity", "prims", "z1-plane", "--measure", "tree", "--map", "out.png"],
}
"""Commands that write files and folders."""
RESUMED = {".journal.jsonl"}
"""Hidden files from which the next run continues."""
CODES = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 129}


@pytest.fixture(autouse=True)
def _urdf(_own_folder):
    box = "<visual><geometry><box size='1 1 1'/></geometry></visual>"
    Path("tiny.urdf").write_text(f"<robot name='tiny'><link name='a'>{box}</link></robot>")


@pytest.fixture(autouse=True)
def _handlers():
    """Give the signals their default handlers, which test runners may change."""
    before = {each: signal.getsignal(each) for each in CODES}
    for each in CODES:
        signal.signal(each, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    for each, handler in before.items():
        signal.signal(each, handler)


@pytest.mark.parametrize(
    ("name", "number"),
    [*((name, signal.SIGINT) for name in WRITERS), *(("compose", each) for each in CODES)],
)
def test_a_signal_leaves_no_partial_file(name, number, run, tmp_path, monkeypatch):
    seen = []

    def stop_before(method):
        original = getattr(Path, method)

        def stopping(path, *arguments):
            if any(part.startswith(".") for part in path.relative_to(path.anchor).parts):
                seen.append(path)
                os.kill(os.getpid(), number)
            return original(path, *arguments)

        monkeypatch.setattr(Path, method, stopping)

    stop_before("chmod")  # of a temporary folder
    stop_before("replace")  # of a temporary file
    code, out, err = run(*WRITERS[name])
    assert seen
    assert (code, out) == (CODES[number], "")
    assert err.startswith("morphgen: interrupted; ")
    assert err.index("\n") == len(err) - 1
    hidden = {path.name for path in tmp_path.rglob(".*")}
    assert hidden <= RESUMED


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_second_signal_does_not_stop_the_cleaning_up(number, run, tmp_path, monkeypatch):
    def stopped_twice(path, mode):
        os.kill(os.getpid(), number)

    rmtree = files.shutil.rmtree

    def interrupted(*arguments, **settings):
        os.kill(os.getpid(), number)
        rmtree(*arguments, **settings)

    monkeypatch.setattr(Path, "chmod", stopped_twice)
    monkeypatch.setattr(files.shutil, "rmtree", interrupted)
    before = tree(tmp_path)
    assert run("export", "prims", "--format", "urdf")[0] == CODES[number]
    assert tree(tmp_path) == before


def test_ctrl_c_within_an_exec_gives_the_exit_code(tmp_path):
    (tmp_path / "stopped.py").write_text(
        """
import os, signal
from morphgen import cli
cli._run = lambda *_: exec("os.kill(os.getpid(), signal.SIGINT); [0 for _ in range(9)]")
raise SystemExit(cli.main([]))
"""
    )
    ended = subprocess.run([sys.executable, "-m", "stopped"], stderr=subprocess.PIPE, check=False)
    assert (ended.returncode, ended.stderr[:22]) == (130, b"morphgen: interrupted;")


def test_an_ignored_signal_stays_ignored(run, monkeypatch):
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as by nohup
    chmod = Path.chmod

    def hung_up(path, mode):
        os.kill(os.getpid(), signal.SIGHUP)
        chmod(path, mode)

    monkeypatch.setattr(Path, "chmod", hung_up)
    assert run("export", "prims", "--format", "urdf")[0] == 0
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN


@pytest.mark.parametrize(
    ("name", "number"),
    [
        *((name, errno.ENOSPC) for name in WRITERS),
        *(("compose", each) for each in (errno.EDQUOT, errno.EROFS, errno.EACCES)),
        ("tokens", errno.EACCES),
    ],
)
def test_a_disk_that_cannot_be_written_is_an_error_with_the_name(
    name, number, run, tmp_path, monkeypatch
):
    def refuse(path, *_, **__):
        has_name = number in (errno.EROFS, errno.EACCES)  # opening fails, not writing
        raise OSError(number, os.strerror(number), *([str(path)] if has_name else []))

    for method in ("write_text", "write_bytes"):
        monkeypatch.setattr(Path, method, refuse)
    code, out, err = run(*WRITERS[name])
    assert (code, out) == (2, "")
    assert err.index("\n") == len(err) - 1
    assert err.endswith(f": {os.strerror(number)}\n")
    words = err.removeprefix("morphgen: ").removeprefix("cannot write ").split(":")[0]
    words = words.removeprefix("to ")
    assert words.startswith(("prims", "out"))
    assert not any(part.startswith(".") for part in words.split("/"))
    assert {path.name for path in tmp_path.rglob(".*")} <= RESUMED


def test_a_journal_and_metrics_on_a_full_disk_are_named(tmp_path):
    path = tmp_path / "metrics.jsonl"
    for error in (OSError(errno.ENOSPC, "full"), OSError(errno.EACCES, "no", "other")):
        name = error.filename or str(path)
        with pytest.raises(OSError, match=json.dumps(name)[1:-1]), files.naming(path):
            raise error


COMMANDS = {
    "sample": ["sample", "chain", "-n", 40, "--jobs", 2, "--light", "--out", "out"],
    "goals": ["goals", "split.yaml", "--jobs", 2],
    "split": [
        *["split", "new", "interpolation", "--grammar", "chain", "--train", 20, "--test", 20],
        *["--task", "reach", "--jobs", 2, "--out", "out.yaml"],
    ],
}
PATIENCE = 120.0
"""Seconds to wait for a worker, and then for the end."""


@pytest.mark.slow
@pytest.mark.parametrize("later", [0.0, 0.3])
@pytest.mark.parametrize("name", COMMANDS)
def test_ctrl_c_while_workers_start_prints_one_line(tmp_path, name, later):
    check(tmp_path, name, later)


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_the_end_of_a_session_stops_workers_as_ctrl_c_does(tmp_path, name, number):
    check(tmp_path, name, 0.3, number)


def check(tmp_path, name, later, number=signal.SIGINT):
    (tmp_path / "split.yaml").write_text(split_text(small_split()))
    process = subprocess.Popen(
        [sys.executable, "-m", "morphgen", *map(str, COMMANDS[name])],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=heed_ctrl_c,
        env=os.environ | {"XDG_CACHE_HOME": str(tmp_path / "cache"), "OMP_NUM_THREADS": "1"},
    )
    try:
        deadline = time.monotonic() + PATIENCE
        while not any("spawn_main" in words for words in group(process.pid).values()):
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < deadline
            time.sleep(0.002)
        time.sleep(later)
        # As a terminal does; a hang-up also stops Python's resource tracker, which says so.
        (os.kill if number == signal.SIGHUP else os.killpg)(process.pid, number)
        out, err = process.communicate(timeout=PATIENCE)
        assert (process.returncode, out) == (128 + number, "")
        *updates, line = err.splitlines()
        assert line.startswith("morphgen: interrupted; ")
        assert all(re.search(r", \d+ s$", each) for each in updates)  # progress
        while group(process.pid) and time.monotonic() < deadline + PATIENCE:
            time.sleep(0.05)  # the resource tracker ends after the other processes
        assert group(process.pid) == {}
    finally:
        for left in group(process.pid):
            os.kill(left, signal.SIGKILL)
    assert [path for path in tmp_path.rglob(".*") if path.name != ".journal.jsonl"] == []


def group(leader):
    """Command lines of the running processes of a process group, by process id."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            state, _, number = (folder / "stat").read_text().rpartition(")")[2].split()[:3]
            words = (folder / "cmdline").read_text()
        except OSError:  # the process has ended
            continue
        if int(number) == leader and state != "Z":
            found[int(folder.name)] = words
    return found
