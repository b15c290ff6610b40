"""Promises of ``docs/versions.md``: values that are the same in all versions 0.3.x, and formats.

A change of a value needs a new minor version; then record the new values in ``reference.json``.
"""

import json
import math
import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from morphgen.benchmark import release, split_folder
from morphgen.benchmark.scores import submission
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
from morphgen.grammar.robot_set import SetConfig
from morphgen.grammar.sampling import sample_robot
from morphgen.model.dynamics import GRAVITY
from morphgen.rl.demonstrations import lerobot
from morphgen.rl.evaluation import EvalConfig, evaluate_baseline
from morphgen.rl.runs import checkpoint as runs
from morphgen.rl.runs import robot_source
from morphgen.rl.runs.robot_source import split_source
from morphgen.rl.shipped_policies import POLICIES
from morphgen.splits import split
from morphgen.splits.split import split_id
from morphgen.splits.split_file import read_split, split_names
from morphgen.tasks.goals import split_goals
from morphgen.tasks.goals.goal_sets import FOLDER, INDEX
from morphgen.tasks.registry import TASKS
from morphgen.tasks.sim.base import SUBSTEPS, TIMESTEP
from morphgen.viewer import episode

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
    "build.json": split_folder.FORMAT,
    "goals/index.json": split_goals.FORMAT,
    "card.json": bundle.CARD_FORMAT,
    "set.json": SetConfig(Path(), "", "", 0, (), False, False, ()).settings()["format"],
    runs.CONFIG: runs.FORMAT,
    runs.CHECKPOINT: runs.FORMAT,
    robot_source.FILE: robot_source.FORMAT,
    "episodes.csv.gz": "",
    "release.json": release.FORMAT,
    "eval --submission": submission.FORMAT,
    ".npz": episode.FORMAT,
    lerobot.RECORDING: lerobot.FORMAT,
}


def test_formats_of_files_are_those_of_the_code():
    _, _, section = PAGE.partition("## What the files record")
    rows = re.findall(r"(?m)^\| [^`|]*`([^`]+)`[^|]*\| ?([^|]*?) ?\|", section.split("\n## ")[0])
    assert dict(rows) == {file: str(number) for file, number in FORMATS.items()}
