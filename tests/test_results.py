"""The tables of docs/training.md are those that the stored studies print."""

import json
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from morphgen.cli import main

ROOT = Path(__file__).parent.parent
COMMANDS = re.findall(
    r"(?m)^(?:morphgen|python) .*--report$", (ROOT / "results/README.md").read_text("utf-8")
)
DOCS = [
    re.split(r"\s*\|\s*", line) for line in (ROOT / "docs/training.md").read_text().splitlines()
]


def run_here(command, monkeypatch):
    program, *arguments = shlex.split(command)
    if program == "morphgen":
        return main(arguments)
    script = ROOT / arguments[0]
    monkeypatch.syspath_prepend(str(script.parent))
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit) as exit_:
        runpy.run_path(str(script), run_name="__main__")
    return exit_.value.code


@pytest.mark.parametrize("command", COMMANDS)
def test_the_docs_have_the_numbers_of_a_stored_study(command, tmp_path, monkeypatch):
    study = Path(re.search(r"--out (\S+)", command).group(1))
    shutil.copytree(ROOT / study, tmp_path / study)
    monkeypatch.chdir(tmp_path)
    assert run_here(command, monkeypatch) == 0
    rows = json.loads((tmp_path / study / "results.json").read_text("utf-8"))["rows"]
    means = {
        (row["split"], row["agent"]): {f"{group['mean']:.1f}" for group in row["groups"].values()}
        for row in rows
        if row["mode"] == "deterministic"
    }
    assert means
    for agent, numbers in means.items():
        assert any(numbers <= {cell.split(" ")[0] for cell in line} for line in DOCS), agent


def test_the_docs_have_the_table_of_the_number_of_robots():
    command = [sys.executable, "benchmarks/robot_curve.py", "--report"]
    printed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    rows = [re.split(r"\s*\|\s*", line) for line in printed.splitlines()[2:]]
    assert len(rows) == 5
    assert all(row in DOCS for row in rows)
