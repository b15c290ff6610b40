"""Values that are the same in all versions with the same first two numbers, such as 0.3.x.

``reference.json`` records them. The diagnosis compares those of an installation with it, and a test
compares all of them: numbers of two versions are only comparable while they agree. A change of one
needs a new minor version; then record the new values and describe them in ``docs/versions.md``:

    python -m morphgen.doctor.reference
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from morphgen.benchmark.robot_hash import digest, robot_hash
from morphgen.benchmark.split import split_id
from morphgen.benchmark.split_file import read_split, split_names
from morphgen.benchmark.tokens import FREQUENCIES, KINDS, LAYOUT, MAX_LINKS, SHAPES, tokens
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.bundle import CARD, write_bundle
from morphgen.formats.files import file_sha256, folder_hashes
from morphgen.grammar.compose import compose
from morphgen.grammar.grammar_file import find_grammar, load_grammar
from morphgen.grammar.library import Library, default_library
from morphgen.grammar.request import parse_words
from morphgen.grammar.sampling import sample_robot
from morphgen.model.robot import Robot
from morphgen.rl.shipped_policies import POLICIES
from morphgen.tasks.goals.goal_sets import FOLDER, INDEX
from morphgen.tasks.registry import TASKS
from morphgen.tasks.sim.base import GRAVITY, SUBSTEPS, TIMESTEP

FILE = Path(__file__).with_name("reference.json")
ROBOT = "ur5-plane"
"""Robot whose bytes are recorded: a real arm with meshes, and a template."""
SAMPLED = ("arm3", 0, 17)
"""Grammar, seed and number of the sampled robot whose hash is recorded."""
TOKEN_STEP = 1e-4
"""Resolution of the recorded tokens, as of ``token_layout.TOLERANCE``."""
SCORED = "interpolation/arm3/reach"
"""Split whose test robot has a recorded score."""
BASELINE = "jacobian"
"""Baseline that has the score."""
EPISODES = 10
"""Number of episodes of the score."""
SCORE_TOLERANCE = 1.0
"""Largest accepted difference of the score: processors differ in the last bits, by which a tool may
enter the radius of success a step later. A step of an episode counts 0.07 points."""
OFF_GRID = 1 / math.pi
"""Offset of their grid [steps], so that decimal numbers are not halfway between grid points."""


def recorded() -> Mapping[str, Any]:
    """Return the recorded values by group."""
    values: dict[str, Any] = json.loads(FILE.read_text(encoding="utf-8"))
    return values


def splits() -> dict[str, str]:
    """Return the ids of the shipped splits, which include the hashes of their robots."""
    return {name: split_id(read_split(name)) for name in split_names()}


def goal_sets() -> str:
    """Return the hash of the index of the shipped goal sets, which has the hash of each file."""
    return file_sha256(FOLDER / INDEX)


def checkpoints() -> dict[str, str]:
    """Return the hashes of the shipped policies' files."""
    files = {name: POLICIES[name].file for name in POLICIES.builtin}
    return {name: file_sha256(file) for name, file in files.items()}


def constants() -> dict[str, Any]:
    """Return the default constants of tasks, and those of all simulators."""
    defaults = {name: asdict(TASKS[name].config_type()) for name in TASKS.builtin}
    simulation = {"timestep": TIMESTEP, "substeps": SUBSTEPS, "gravity": GRAVITY}
    plain: dict[str, Any] = json.loads(json.dumps({**defaults, "simulation": simulation}))
    return plain


def token_layout() -> str:
    """Return a hash of the fields of tokens and of their codes."""
    fields = [[field.name, field.start, field.size] for field in LAYOUT]
    return digest([fields, SHAPES, KINDS, FREQUENCIES.tolist(), MAX_LINKS])


def robots() -> dict[str, Any]:
    """Return hashes of a composed and of a sampled robot, of its tokens and of its files."""
    library = default_library()
    robot, sampled = reference_robot(library), sampled_robot(library)
    return {
        ROBOT: robot_hash(robot),
        sampled.name: robot_hash(sampled),
        f"tokens of {ROBOT}": token_hash(robot, library),
        f"files of {ROBOT}": file_hashes(robot),
    }


def reference_robot(library: Library) -> Robot:
    """Compose the robot whose bytes are recorded."""
    derivation, name = parse_words([ROBOT], library)
    return compose(derivation, library, name)


def sampled_robot(library: Library) -> Robot:
    """Draw the recorded robot of a grammar."""
    name, seed, number = SAMPLED
    grammar = load_grammar(find_grammar(name, library.folders), library.folders)
    return sample_robot(grammar, library, number, seed=seed).robot


def token_hash(robot: Robot, library: Library) -> str:
    """Return a hash of a robot's tokens at home."""
    table = tokens(robot, token_shapes(robot, library.folders), max_links=MAX_LINKS)
    return digest(np.floor(table / TOKEN_STEP + OFF_GRID).astype(int).tolist())


def file_hashes(robot: Robot) -> dict[str, str]:
    """Return the hashes of a bundle's files by path, without the card, which has the version."""
    with TemporaryDirectory() as parent:
        folder = write_bundle(robot, Path(parent) / robot.name, (), picture=False)
        return {name: value for name, value in folder_hashes(folder).items() if name != CARD}


def score() -> float:
    """Return the score of a baseline on the test robot of a shipped split, without contacts.

    It depends on the robot, its goal set, the constants of the task and the definition of the
    score. The simulator ``kinematic`` has no library whose version matters.
    """
    from morphgen.rl.evaluation import EvalConfig, evaluate_baseline
    from morphgen.rl.runs.robot_source import split_source

    source = split_source(read_split(SCORED), side="test")
    config = EvalConfig(EPISODES, sim="kinematic")
    return float(np.mean([each.score for each in evaluate_baseline(BASELINE, source, config)]))


GROUPS: Mapping[str, Callable[[], Any]] = {
    "splits": splits,
    "goal_sets": goal_sets,
    "checkpoints": checkpoints,
    "constants": constants,
    "token_layout": token_layout,
    "robots": robots,
    "score": score,
}
"""Function that computes the present values of each group."""


def main() -> None:
    """Write the present values."""
    present = {name: compute() for name, compute in GROUPS.items()}
    FILE.write_text(json.dumps(present, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
