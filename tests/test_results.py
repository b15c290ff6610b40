"""The tables of docs/results.md and results/ are those that the stored studies print."""

import json
import re
import runpy
import shlex
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from morphgen.benchmark.scores.submission import EPISODES, read_table
from morphgen.cli import main

ROOT = Path(__file__).parent.parent
COMMANDS = re.findall(
    r"(?m)^(?:morphgen|python) .*--report$", (ROOT / "results/README.md").read_text("utf-8")
)
DOCS = [
    re.split(r"\s*\|\s*", line)
    for page in ("results/tables.md", "results/studies.md")
    for line in (ROOT / page).read_text("utf-8").splitlines()
]

RUNS = (
    ("`me-graph` with MuJoCo", r"me-graph|graph-", ("mujoco",)),
    ("`me-graph` without contacts", r"me-graph|graph-", ("kinematic",)),
    ("`me-graph` with MuJoCo Warp", r"me-graph|graph-", ("warp",)),
    ("`me-mlp` and `me-tf`", r"me-mlp|me-tf|se", ("kinematic", "warp")),
)
"""Runs that the docs name, a pattern of their agents, and their simulators."""
CONSTANTS = ("gamma", "num_steps", "learning_rate", "num_envs")
"""Constants of a run, in the order of the docs."""


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


@pytest.fixture(scope="module")
def copied(tmp_path_factory):
    """Return a folder with a copy of results/, for all commands: each table is read once."""
    folder = tmp_path_factory.mktemp("copied")
    shutil.copytree(ROOT / "results", folder / "results")
    return folder


@pytest.mark.parametrize("command", COMMANDS)
def test_the_docs_have_the_numbers_of_a_stored_study(command, copied, monkeypatch):
    monkeypatch.chdir(copied)
    assert run_here(command, monkeypatch) == 0
    study = re.search(r"--out (\S+)", command).group(1)
    rows = json.loads((copied / study / "results.json").read_text("utf-8"))["rows"]
    means = {
        (row["split"], row["task"], row["method"]): {
            f"{side['score']['value']:{'.1f' if row['task'] == 'reach' else '.0%'}}"
            for side in row["sides"].values()
        }
        for row in rows
        if row["mode"] == "deterministic" and not row["finetuned"]
    }
    assert means
    for agent, numbers in means.items():
        assert any(numbers <= {cell.split(" ")[0] for cell in line} for line in DOCS), agent


@pytest.mark.parametrize("file", sorted((ROOT / "results/many-episodes").glob("*.json")))
def test_results_of_many_episodes_are_those_of_the_page(file):
    ((row,),) = json.loads(file.read_text("utf-8")).values()
    assert row["episodes"] == 510
    score = f"{row['score']:.1f} [{row['low']:.1f}, {row['high']:.1f}]"
    name, _, sim = file.stem.rpartition("-")
    column = {"mujoco": 2, "pybullet": 4}[sim]
    cells = [line[column : column + 2] for line in DOCS if line[1:2] and f"`{name}`" in line[1]]
    assert [score, f"{row['success']:.1%}"] in cells


def test_the_page_of_results_has_the_tables_of_its_command():
    page = runpy.run_path(str(ROOT / "docs/results_page.py"))
    for path, tables in page["tables"]().items():
        assert page["write_tables"](tables, path) == path.read_text("utf-8")


def test_the_docs_have_the_table_of_the_stored_conformance(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    assert run_here("python benchmarks/conformance.py --report", monkeypatch) == 0
    text = (ROOT / "benchmarks" / "README.md").read_text("utf-8")
    assert capsys.readouterr().out.rstrip() in "\n".join(map(str.rstrip, text.splitlines()))


def test_the_law_of_made_failures_is_found(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    fitted = runpy.run_path(str(ROOT / "benchmarks" / "scaling_law.py"))["fitted"]
    robots = np.array([1.0, 3.0, 10.0, 30.0, 100.0])
    failures = np.array([0.1 + 0.6 * robots**-0.5, np.full(5, 0.3), 0.8 * robots**-0.2])
    floor, factor, exponent = fitted(robots, failures)
    assert floor == pytest.approx([0.1, 0.3, 0.0], abs=1e-6)
    assert factor == pytest.approx([0.6, 0.0, 0.8], abs=1e-6)
    assert exponent == pytest.approx([0.5, np.nan, 0.2], abs=1e-6, nan_ok=True)


def test_the_docs_have_the_constants_of_the_stored_runs():
    stored = {}
    tables = (ROOT / "results").rglob(EPISODES)
    configs = [run.config for path in tables for run in read_table(path) if run.config]
    for config in configs:
        agent, constants = config["policy"]["agent"], config | config["ppo"]
        (name,) = [
            name for name, agents, sims in RUNS if re.match(agents, agent) and config["sim"] in sims
        ]
        values = tuple(float(constants[key]) for key in CONSTANTS)
        stored.setdefault(name, set()).add(values)
    text = (ROOT / "results/README.md").read_text("utf-8")
    number = r"([\d.,e-]*\d)"
    documented = {
        name: {
            tuple(float(each.replace(",", "")) for each in values)
            for values in re.findall(rf"{name} \| {' [|] '.join([number] * len(CONSTANTS))}", text)
        }
        for name, _, _ in RUNS
    }
    assert documented == stored
