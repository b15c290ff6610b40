"""A signal while workers start prints one line and leaves no process and no partial file."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from helpers.commands import heed_ctrl_c
from helpers.runs import small_split
from helpers.simulators import needs_pybullet
from morphgen.benchmark.split_file import split_text

COMMANDS = {
    "sample": ["sample", "chain", "-n", 40, "--jobs", 2, "--light", "--out", "out"],
    "train": [
        *["train", "planar-cube", "task=reach", "--agent", "me-mlp", "--envs", 4, "--steps", 2048],
        *["--sim", "pybullet", "--workers", 2, "--out", "out"],
    ],
    "goals": ["goals", "split.yaml", "--jobs", 2],
    "split": [
        *["split", "new", "interpolation", "--grammar", "chain", "--train", 20, "--test", 20],
        *["--task", "reach", "--jobs", 2, "--out", "out.yaml"],
    ],
    "eval": ["eval", "ik", "--split", "split.yaml", "--sim", "pybullet", "--workers", 2],
}
PATIENCE = 120.0
"""Seconds to wait for a worker, and then for the end."""


@pytest.mark.slow
@pytest.mark.parametrize("later", [0.0, 0.3])
@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=needs_pybullet if "pybullet" in COMMANDS[n] else []) for n in COMMANDS],
)
def test_ctrl_c_while_workers_start_prints_one_line(tmp_path, name, later):
    check(tmp_path, name, later)


@pytest.mark.slow
def test_ctrl_c_as_the_first_worker_starts_prints_one_line(tmp_path):
    check(tmp_path, "sample", 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sample", "goals", "split"])
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
        assert err.startswith("morphgen: interrupted; ")
        assert err.index("\n") == len(err) - 1
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
