"""Submissions of a small split that tests write without running episodes."""

import copy

import msgspec

from helpers.runs import small_split
from morphgen.benchmark.scores.submission import (
    FORMAT,
    KIND,
    EvalProtocol,
    Submission,
    expected_robots,
)
from morphgen.errors import BenchmarkError
from morphgen.formats.records import read_record
from morphgen.grammar.library import default_library
from morphgen.splits.split import split_id

SPLIT = small_split()
PROTOCOL = EvalProtocol(episodes=4)
EXPECTED = expected_robots(SPLIT, PROTOCOL, default_library())
VERSION = "0.7.1"
BASELINE = {"mode": "", "training_seed": None}
"""Changes of the data of a baseline."""
TEST = -1
"""Index of the test robot."""


def outcomes(expected, successes=3, episodes=4, near=150.0):
    """Return the data of a robot that succeeds in its first episodes."""
    won = [i < successes for i in range(episodes)]
    return {
        "robot": expected.member.name,
        "side": expected.side,
        "task": expected.member.task,
        "body": expected.member.robot_hash,
        "goal_set": expected.goal_set,
        "success": won,
        "score": [near + i if each else -1.0 for i, each in enumerate(won)],
        "distance": [0.01 if each else 0.2 for each in won],
        "steps": [300] * episodes,
        "diverged": [False] * episodes,
        "random_score": [-2.0] * episodes,
        "random_success": [False] * episodes,
    }


def data(method="ours", split=SPLIT, expected=EXPECTED, protocol=PROTOCOL, **more):
    """Return the data of a valid submission; further arguments are those of ``outcomes``."""
    return {
        "kind": KIND,
        "format": FORMAT,
        "method": method,
        "mode": "deterministic",
        "training_seed": 0,
        "morphgen": VERSION,
        "split": {"name": split.name, "id": split_id(split)},
        "evaluation": msgspec.to_builtins(protocol.as_data(split)),
        "robots": [outcomes(each, **more) for each in expected],
    }


def submission(values=None, **more):
    return read_record(values or data(**more), Submission, "s.json", BenchmarkError)


def changed(*keys, value, **more):
    """Return the data of a submission with another value at a path of keys."""
    values = copy.deepcopy(data(**more))
    entry = values
    for key in keys[:-1]:
        entry = entry[key]
    entry[keys[-1]] = value
    return values
