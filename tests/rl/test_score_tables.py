"""Tables of results from episodes."""

import math
from pathlib import Path

import numpy as np
import pytest

from helpers.submissions import SPLIT, data
from morphgen.benchmark.split import split_id
from morphgen.benchmark.split_file import read_split
from morphgen.errors import BenchmarkError
from morphgen.rl.scores.score_tables import result_rows, result_tables
from morphgen.rl.scores.submission import submission_from

BASELINE = {"mode": "", "training_seed": None}
TRAINING = {"simulator": "warp", "transitions": 30_000_000}


def read(**files):
    return {name: submission_from(values, Path(name)) for name, values in files.items()}


def floor():
    """Episodes of the reference controller, which scores 100 and succeeds twice in four."""
    return data("jacobian", successes=2, near=100.0) | BASELINE


def by_key(rows):
    return {(row.task, row.method, row.mode, row.finetuned): row for row in rows}


def wilson(successes, trials, z=1.959964):
    middle = (successes + z * z / 2) / (trials + z * z)
    rate = successes / trials
    half = (
        z * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials**2)) / (1 + z * z / trials)
    )
    return middle - half, middle + half


def test_a_row_has_all_seeds_of_a_method_and_the_difference_to_the_reference():
    first = data(successes=4, near=150.0) | {"training": TRAINING}
    second = data(successes=3, near=130.0) | {"training": TRAINING, "training_seed": 1}
    rows = by_key(result_rows(read(a=first, b=second, c=floor())))
    row = rows["reach", "ours", "deterministic", 0]
    assert (row.seeds, row.transitions, row.simulator) == ((0, 1), 30_000_000, "warp")
    scores = [np.array([150.0, 151, 152, 153]) + 2, np.array([130.0, 131, 132, -1]) + 2]
    reference = np.array([100.0, 101, -1, -1]) + 2
    for side, robots in (("train", row.sides["train"]), ("test", row.sides["test"])):
        trials = 8 * robots.robots
        assert robots.episodes == trials, side
        assert robots.mean == pytest.approx(np.mean(scores))
        assert robots.iqm.low <= robots.iqm.value <= robots.iqm.high
        assert (robots.success.low, robots.success.high) == pytest.approx(
            wilson(7 * robots.robots, trials), abs=1e-6
        )
        assert robots.difference.value == pytest.approx(
            np.mean(scores, axis=0).mean() - reference.mean()
        )
        assert robots.difference.low < robots.difference.value < robots.difference.high
    assert rows["reach", "jacobian", "", 0].sides["test"].difference is None


def test_policies_of_single_robots_are_compared_in_the_same_episodes():
    values = data(successes=4, near=150.0)
    for robot in values["robots"]:
        for key in ("success", "score", "distance", "steps", "diverged"):
            robot[key] = robot[key] * 2
    rows = by_key(result_rows(read(a=values, b=floor())))
    difference = rows["reach", "ours", "deterministic", 0].sides["test"].difference
    assert difference.value == pytest.approx(151.5 - 49.75)


def test_modes_and_fine_tuning_have_rows_of_their_own():
    tuned = data(near=160.0) | {"training": TRAINING | {"finetuned": 10_000}}
    tuned["robots"] = [robot for robot in tuned["robots"] if robot["side"] == "test"]
    stochastic = data() | {"mode": "stochastic"}
    rows = result_rows(read(a=data(), b=tuned, c=stochastic))
    keys = [(row.mode, row.finetuned, list(row.sides)) for row in rows if row.task == "reach"]
    both = ["train", "test"]
    assert keys == [
        ("deterministic", 0, both),
        ("deterministic", 10_000, ["test"]),
        ("stochastic", 0, both),
    ]
    lines = result_tables(rows).splitlines()
    assert any("10,000" in line for line in lines)
    assert any("ours (stochastic)" in line for line in lines)
    assert result_tables(rows, "github").startswith("## ")


def changed(values, **changes):
    values["robots"][0] |= changes
    return values


def test_runs_of_other_trainings_have_rows_of_their_own():
    longer = TRAINING | {"transitions": 100_000_000}
    files = {
        name: data() | {"training_seed": seed, "training": training}
        for seed, (name, training) in enumerate({"a": TRAINING, "b": longer, "c": TRAINING}.items())
    }
    rows = [row for row in result_rows(read(**files)) if row.task == "reach"]
    assert [(row.transitions, row.seeds) for row in rows] == [
        (30_000_000, (0, 2)),
        (100_000_000, (1,)),
    ]


def test_small_scores_have_two_decimals():
    for near, shown in ((0.25, "2.69"), (150.0, "115.0")):
        (line,) = result_tables(result_rows(read(a=data(near=near)))).splitlines()[4:5]
        assert line.split()[4] == shown


def test_a_run_that_two_studies_have_counts_once():
    one = result_rows(read(a=data(), c=floor()))
    assert result_rows(read(a=data(), b=data(), c=floor(), d=floor())) == one


SHIPPED = read_split("interpolation/arm3/reach")


@pytest.mark.parametrize(
    ("files", "why"),
    [
        (
            {"a": data(), "b": data(near=140.0)},
            "b: the same run, seed and mode as a with other episodes; name one of the two files",
        ),
        (
            {"a": data(), "b": data("other") | {"split": {"name": SPLIT.name, "id": "x"}}},
            "b: split.id x; expected",
        ),
        (
            {
                "a": data(),
                "b": data("other") | {"evaluation": data()["evaluation"] | {"episodes": 3}},
            },
            "b: evaluation.episodes 3; expected 4, as in a; scores of different",
        ),
        (
            {"a": data() | {"split": {"name": SHIPPED.name, "id": split_id(SHIPPED)}}},
            f"a: train robot .*: body .*; expected a robot of {SHIPPED.name}",
        ),
        (
            {"a": data(), "b": changed(data() | {"training_seed": 1}, robot="another")},
            "its seeds have other train robots",
        ),
        (
            {"a": data(), "b": changed(data("other"), random_score=[-500.0, -501, -500, -499])},
            "b: train robot .*: random_score: mean -500.00; expected .*, as in a",
        ),
    ],
)
def test_submissions_that_do_not_compare_are_refused(files, why):
    with pytest.raises(BenchmarkError, match=why):
        result_rows(read(**files))
