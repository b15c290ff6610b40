"""The doctor's findings about an installation, and versions of packages."""

import importlib.metadata
import json
import math
import os
import re
from dataclasses import asdict
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest

from morphgen.benchmark import release, split_folder
from morphgen.benchmark.scores import submission
from morphgen.cli import doctor, main
from morphgen.cli.doctor import Entry, attempt
from morphgen.encoding.robot_hash import digest, robot_hash
from morphgen.encoding.tokens import FREQUENCIES, KINDS, LAYOUT, MAX_LINKS, SHAPES, tokens
from morphgen.files import file_sha256
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats import bundle
from morphgen.formats.bundle import CARD, write_bundle
from morphgen.formats.files import folder_hashes
from morphgen.grammar.compose import compose
from morphgen.grammar.grammar_file import find_grammar, load_grammar
from morphgen.grammar.library import default_library
from morphgen.grammar.request import parse_words
from morphgen.grammar.sampling import SetConfig, sample_robot
from morphgen.model.dynamics import GRAVITY
from morphgen.rl.demonstrations import lerobot
from morphgen.rl.evaluation import EvalConfig, evaluate_baseline
from morphgen.rl.runs import checkpoint as runs
from morphgen.rl.runs import robot_source
from morphgen.rl.runs.robot_source import split_source
from morphgen.rl.shipped_policies import POLICIES
from morphgen.splits import split
from morphgen.splits.split import read_split, split_id, split_names
from morphgen.tasks import split_goals
from morphgen.tasks.goal_sets import FOLDER, INDEX
from morphgen.tasks.registry import TASKS
from morphgen.tasks.sim.base import SUBSTEPS, TIMESTEP


def by_name(entries):
    return {entry.name: entry for entry in entries}


def test_this_installation_is_sound(capsys):
    assert main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    sections = [line for line in lines if not line.startswith(" ")][:-1]
    assert sections == ["system", "packages"]
    names = {line.split(": ")[0].split(maxsplit=1)[1] for line in lines if line.startswith(" ")}
    assert any(line.endswith("/morphgen") for line in lines)
    assert {"installed", "cache", "gpu"} < names
    assert lines[-1].startswith("sound: ")


@pytest.mark.parametrize(("status", "code"), [("warning", 0), ("absent", 0), ("error", 1)])
def test_an_error_makes_the_exit_code_1(status, code, monkeypatch, capsys):
    entries = [("part", Entry("a", "ok", "b")), ("part", Entry("d", status, "e"))]
    monkeypatch.setattr(doctor, "diagnose", lambda: iter(entries))
    assert main(["doctor"]) == code
    assert capsys.readouterr().out.splitlines()[-1].startswith("NOT SOUND" if code else "sound")
    assert main(["doctor", "--json"]) == code
    data = json.loads(capsys.readouterr().out)
    assert (data["passed"], data["results"][1]["status"]) == (not code, status)
    assert data["results"][0] == {"section": "part", "name": "a", "status": "ok", "text": "b"}


@pytest.mark.parametrize(
    ("error", "status", "text"),
    [
        (ModuleNotFoundError(name="torch"), "absent", "pip install 'morphgen[tasks]'"),
        (ModuleNotFoundError(name="lxml"), "error", "lxml is not installed; install morphgen"),
        (ValueError("two\nlines"), "error", "ValueError: two lines"),
    ],
)
def test_what_a_broken_package_raises_is_a_result(error, status, text):
    def examine():
        raise error

    entry = attempt("it", examine)
    assert (entry.name, entry.status) == ("it", status)
    assert text in entry.text
    assert "\n" not in entry.text


class Declared:
    """A distribution of morphgen that declares other packages."""

    metadata = importlib.metadata.distribution("morphgen").metadata
    requires = (
        "pytest<1",
        "no-such-core",
        "numpy>=1",
        'numpy>=9; extra == "fit"',
        'no-such-extra; extra == "rl"',
        'no-such-tool; extra == "dev"',
        'morphgen[fit]; extra == "rl"',
        'no-such-past; python_version < "3" and extra == "pybullet"',
    )


def test_packages_outside_their_ranges_and_missing_ones_are_named(monkeypatch):
    real = importlib.metadata.distribution
    monkeypatch.setattr(
        importlib.metadata,
        "distribution",
        lambda name: Declared if name == "morphgen" else real(name),
    )
    entries = by_name(doctor.packages())
    assert {name: entry.status for name, entry in entries.items()} == {
        **{"pytest": "warning", "no-such-core": "error", "no-such-extra": "absent"},
        "installed": "ok",
    }
    assert "is outside of the range <1" in entries["pytest"].text
    assert entries["no-such-core"].text == "not installed: install morphgen again"
    assert entries["no-such-extra"].text == "not installed: pip install 'morphgen[rl]'"
    assert re.fullmatch(r"numpy \S+, pytest \S+", entries["installed"].text)


def test_a_cache_that_cannot_be_written_is_a_warning(tmp_path, monkeypatch):
    (tmp_path / "goals-5").mkdir()
    (tmp_path / "goals-5" / "a.npz").write_bytes(bytes(250_000))
    monkeypatch.setattr(doctor, "user_cache_path", lambda _: tmp_path)
    cache = doctor._cache()
    assert cache.status == "ok"
    assert cache.text == f"{tmp_path}: goals-5 0.2 MB; delete it to clear it"
    monkeypatch.setattr(os, "access", lambda *_: False)
    cache = doctor._cache()
    assert (cache.status, "cannot be written" in cache.text) == ("warning", True)


def test_an_error_that_a_package_made_of_ctrl_c_ends_the_diagnosis():
    def examine():
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as interrupt:
            raise ImportError("cannot load the library") from interrupt

    with pytest.raises(KeyboardInterrupt):
        attempt("package", examine)


RECORDED = json.loads(Path(__file__).with_name("reference.json").read_text(encoding="utf-8"))
LIBRARY = default_library()
TOKEN_STEP = 1e-4
"""Resolution of the recorded tokens, as of ``morphgen.encoding.tokens.TOLERANCE``."""
SCORE_TOLERANCE = 1.0
"""Processors differ in the last bits, by which a tool may enter the radius of success a step later.
A step of an episode counts 0.07 points."""


def constants():
    defaults = {name: asdict(TASKS[name].config_type()) for name in TASKS.builtin}
    simulation = {"timestep": TIMESTEP, "substeps": SUBSTEPS, "gravity": GRAVITY}
    return json.loads(json.dumps({**defaults, "simulation": simulation}))


def robot_hashes(folder):
    robot = compose(parse_words(["ur5-plane"], LIBRARY)[0], LIBRARY, "ur5-plane")
    grammar = load_grammar(find_grammar("arm3", LIBRARY.folders), LIBRARY.folders)
    sampled = sample_robot(grammar, LIBRARY, 17, seed=0).robot
    table = tokens(robot, token_shapes(robot, LIBRARY.folders), max_links=MAX_LINKS)
    # The offset keeps decimal numbers from being halfway between two points of the grid.
    rounded = np.floor(table / TOKEN_STEP + 1 / math.pi).astype(int)
    files = folder_hashes(write_bundle(robot, folder / robot.name, (), picture=False))
    return {
        "ur5-plane": robot_hash(robot),
        sampled.name: robot_hash(sampled),
        "tokens of ur5-plane": digest(rounded.tolist()),
        "files of ur5-plane": {name: sha256 for name, sha256 in files.items() if name != CARD},
    }


def score():
    source = split_source(read_split("interpolation/arm3/reach"), side="test")
    scores = evaluate_baseline("jacobian", source, EvalConfig(10, sim="kinematic"))
    return float(np.mean([each.score for each in scores]))


def test_values_are_those_of_all_versions_with_the_same_minor_number(tmp_path):
    fields = [[field.name, field.start, field.size] for field in LAYOUT]
    assert {
        "splits": {name: split_id(read_split(name)) for name in split_names()},
        "goal_sets": file_sha256(FOLDER / INDEX),
        "checkpoints": {name: file_sha256(POLICIES[name].file) for name in POLICIES.builtin},
        "constants": constants(),
        "token_layout": digest([fields, SHAPES, KINDS, FREQUENCIES.tolist(), MAX_LINKS]),
        "robots": robot_hashes(tmp_path),
        "score": pytest.approx(score(), abs=SCORE_TOLERANCE),
    } == RECORDED


PAGE = (Path(__file__).parents[2] / "docs" / "versions.md").read_text(encoding="utf-8")
FORMATS = {
    "NAME.yaml": split.FORMAT,
    "build.json": get_args(get_type_hints(split_folder._Settings)["format"])[0],
    "goals/index.json": split_goals.FORMAT,
    "card.json": bundle.CARD_FORMAT,
    "set.json": SetConfig(Path(), "", "", 0, (), False, False, ()).settings()["format"],
    runs.CONFIG: runs.FORMAT,
    runs.CHECKPOINT: runs.FORMAT,
    robot_source.FILE: robot_source.FORMAT,
    "episodes.csv.gz": "",
    "release.json": release.FORMAT,
    "eval --submission": submission.FORMAT,
    lerobot.RECORDING: lerobot.FORMAT,
}


def test_formats_of_files_are_those_of_the_code():
    _, _, section = PAGE.partition("## What the files record")
    rows = re.findall(r"(?m)^\| [^`|]*`([^`]+)`[^|]*\| ?([^|]*?) ?\|", section.split("\n## ")[0])
    assert dict(rows) == {file: str(number) for file, number in FORMATS.items()}
