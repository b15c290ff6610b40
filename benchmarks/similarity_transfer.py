"""Which similarity of an unseen robot to the training robots predicts zero-shot success best.

    python benchmarks/similarity_transfer.py [--variants reach obstacles pose push]
        [--robots 10 30 100 300 1000] [--seeds 0 1] [--results results/robot-curve.json]
        [--runs runs/robot-curve] [--jobs 1] [--out results/similarity-transfer.json]
        [--figure FILE.png] [--report]

Policies, test robots and success are those of ``benchmarks/robot_curve.py``; policies without a
file of results are left out. The training robots of a policy are those that ``robots.json`` in the
folder of its run lists, so ``--runs`` must have a folder for each policy, such as
``push-serial10-seed0``; only this list is read. ``--report`` needs no runs: it reads the rows that
an earlier call has written to ``--out``. A test robot that several tests have counts once,
with the mean of its successes. Training robots that a measure does not apply to, such as those
without a workspace, are left out and named below the table.

For each policy and test robot, a measure gives the value of the most similar training robot. The
Spearman rank correlation of these values with success is computed within each policy, over its test
robots, and a cell is the mean of these correlations over the policies. So policies that are better
for all robots, because they were trained on more of them, do not change it. A policy that has the
same success on all robots has no correlation; the column "policies" has the number of the others.
Positive means: more similar, more success. The last two columns are no similarity, but the number
of movable joints from the root to the tool, and the reach from the root: more of it, more success.

In brackets is the 95% interval of a bootstrap that draws the test robots of a variant with
replacement, the same ones for all policies and columns, and computes the mean again; draws in which
no policy has a correlation do not count. With fewer than ten robots it is a rough guide only.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import groupby, product
from pathlib import Path
from statistics import mean

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from tabulate import tabulate

from morphgen.benchmark.survey import Fault, SplitSurvey, survey_split
from morphgen.encoding.similarity import MEASURES, most_alike
from morphgen.errors import BenchmarkError, MorphgenError
from morphgen.files import write_atomic
from morphgen.formats.rounding import round_number
from morphgen.grammar.library import Library, default_library
from morphgen.model.kinematics import reach_from_root
from morphgen.rl.runs.robot_source import read_drawn
from morphgen.splits.split import Member, RobotFactory, Split, compose_member, read_split, recipe_of
from morphgen.typing import Array
from robot_curve import REAL_ARMS, VARIANTS, policy_name, read_scores

COLUMNS = (*MEASURES, "joints", "reach")
OUT = Path("results/similarity-transfer.json")
DRAWS, SEED = 2000, 0
"""Draws of the bootstrap, and their seed."""
DIGITS = 6
"""Decimals of the values; rounding errors, which depend on the processor, are far smaller."""


@dataclass(frozen=True)
class Policy:
    """A policy with the robots that it was trained and judged on, by hash."""

    variant: str
    robots: int
    seed: int
    train: dict[str, Member]
    test: dict[str, Member]
    success: dict[str, float]


@dataclass(frozen=True)
class Row:
    """A policy on a test robot."""

    variant: str
    robots: int
    seed: int
    robot: str
    success: float
    values: dict[str, float]
    """Each of ``COLUMNS``: a measure to the most similar training robot, or a baseline."""


def read_policies(args: argparse.Namespace, library: Library) -> Iterator[Policy]:
    """Yield the policies that have results.

    Raises:
        TaskError: If the folder of a run is missing, or does not list its robots.
    """
    make = RobotFactory(library)
    recipes = [recipe_of((f"arm={arm}", "ee=stick"), library) for arm in REAL_ARMS]
    made = map(make, recipes)
    arms = {robot.name: robot.member("reach", ("reach",), obstacles=False) for robot in made}
    stored = read_scores(args.results)
    for variant, robots, seed in product(args.variants, args.robots, args.seeds):
        policy = policy_name(variant, robots, seed)
        if policy not in stored:
            continue
        train = {member.robot_hash: member for member in read_drawn(args.runs / policy)}
        test: dict[str, Member] = {}
        successes: dict[str, list[float]] = {}
        for name, rows in stored[policy].items():
            tested = arms if name in arms else {m.name: m for m in read_split(name).test}
            for row in rows:
                member = tested[row["robot"]]
                test.setdefault(member.robot_hash, member)
                successes.setdefault(member.robot_hash, []).append(row["success"])
        success = {key: mean(values) for key, values in successes.items()}
        yield Policy(variant, robots, seed, train, test, success)


def survey_all(policies: list[Policy], library: Library, jobs: int) -> SplitSurvey:
    """Compare every test robot with every training robot of all policies.

    Raises:
        BenchmarkError: If a test robot cannot be composed or measured, or a robot has changed.
    """
    train = {key: member for policy in policies for key, member in policy.train.items()}
    test = {key: member for policy in policies for key, member in policy.test.items()}
    split = Split("all robots", "extrapolation", "", tuple(train.values()), tuple(test.values()))
    survey = survey_split(split, library, jobs=jobs)
    robots = (*survey.train, *survey.composed("test"))
    for member, robot in zip((*split.train, *split.test), robots, strict=True):
        if not isinstance(robot, Fault) and robot.robot_hash != member.robot_hash:
            raise BenchmarkError(f"robot {member.name!r} is not the one of the run any more")
    return survey


def compare(policies: list[Policy], survey: SplitSurvey) -> Iterator[Row]:
    """Yield a row for each policy and test robot, from the survey of all robots."""
    train = {member.robot_hash: i for i, member in enumerate(survey.split.train)}
    test = {member.robot_hash: i for i, member in enumerate(survey.split.test)}
    stats = [robot.stats for robot in survey.composed("test")]
    for policy in policies:
        trained = [train[key] for key in policy.train]
        for key, success in policy.success.items():
            tested = test[key]
            values = {}
            for name in MEASURES:
                alike = survey.by_measure(name)[trained, tested]
                best = most_alike(alike, name)
                assert best is not None, f"no training robot of {policy.variant} has a workspace"
                values[name] = round(float(alike[best]), DIGITS)
            robot = compose_member(policy.test[key], default_library())
            reach = round_number(reach_from_root(robot))
            values |= {"joints": stats[tested].movable_to_tool, "reach": reach}
            yield Row(policy.variant, policy.robots, policy.seed, robot.name, success, values)


def spearman(x: Array, y: Array, counts: Array) -> Array:
    """Return Spearman's correlation, equal values with their mean rank, of several draws of cases.

    Args:
        x: First variable of n cases, shape (n,).
        y: Second variable, shape (n,).
        counts: How often each draw has each case, whole numbers, shape (draws, n).

    Returns:
        A coefficient for each draw, shape (draws,); NaN where a variable is constant.
    """
    # Twice the mean rank, less a constant: in whole numbers a variance of 0 is exactly 0.
    rx, ry = (counts @ (2.0 * (v[:, None] < v) + (v[:, None] == v)) for v in (x, y))
    terms = (np.ones_like(rx), rx, ry, rx**2, ry**2, rx * ry)
    n, sx, sy, sxx, syy, sxy = ((counts * term).sum(axis=1) for term in terms)
    with np.errstate(invalid="ignore"):
        scale = np.sqrt(n * sxx - sx**2) * np.sqrt(n * syy - sy**2)
        return np.asarray((n * sxy - sx * sy) / scale)


def table_line(rows: list[Row]) -> list[str | int]:
    """Return the line of a variant in the table, from its rows."""
    robots = sorted({row.robot for row in rows})
    policies = [list(own) for _, own in groupby(rows, lambda row: (row.robots, row.seed))]
    varied = [own for own in policies if len({row.success for row in own}) > 1]
    line: list[str | int] = [rows[0].variant, len(varied), len(robots)]
    share = np.full(len(robots), 1 / len(robots))
    drawn = np.random.default_rng(SEED).multinomial(len(robots), share, DRAWS)
    counts = np.vstack([np.ones(len(robots)), drawn])  # the first has each robot once
    for column in COLUMNS if varied else ():
        sign = -1 if column in MEASURES and not MEASURES[column].larger_is_more_alike else 1
        of_policies = [
            spearman(
                np.array([sign * row.values[column] for row in own]),
                np.array([row.success for row in own]),
                counts[:, [robots.index(row.robot) for row in own]],
            )
            for own in varied
        ]
        means = np.ma.masked_invalid(of_policies).mean(axis=0).filled(np.nan)
        low, high = np.nanpercentile(means[1:], [2.5, 97.5])
        line.append(f"{means[0]:+.2f} [{low:+.2f}, {high:+.2f}]")
    return line


def read_rows(path: Path) -> list[Row]:
    """Return the rows that an earlier call has written."""
    return [Row(**entry) for entry in json.loads(path.read_text("utf-8"))]


def by_variant(rows: list[Row]) -> dict[str, list[Row]]:
    """Return the rows of each variant."""
    return {name: list(own) for name, own in groupby(rows, lambda row: row.variant)}


def table(rows: list[Row]) -> str:
    """Return the table: a line for each variant."""
    lines = [table_line(own) for own in by_variant(rows).values()]
    return tabulate(lines, headers=["variant", "policies", "robots", *COLUMNS], tablefmt="github")


def draw_figure(rows: list[Row], path: Path) -> None:
    """Draw the success on each robot against its similarity: a panel for each variant."""
    variants = by_variant(rows)
    figure = Figure(figsize=(2.6 * len(variants) + 0.4, 3.1), layout="constrained")
    panels = figure.subplots(1, len(variants), squeeze=False, sharey=True)[0]
    arms = {f"{arm}-stick" for arm in REAL_ARMS}
    for (variant, rows), axes in zip(variants.items(), panels, strict=True):
        for label, is_arm in (("real arm with a stick", True), ("other robot", False)):
            robots = sorted({row.robot for row in rows if (row.robot in arms) == is_arm})
            points = [[row for row in rows if row.robot == robot] for robot in robots]
            similarity = [mean(row.values["cosine"] for row in own) for own in points]
            success = [100 * mean(row.success for row in own) for own in points]
            axes.scatter(similarity, success, s=16, marker="o" if is_arm else "^", label=label)
        axes.set_title(variant, fontsize=10)
    panels[0].set_ylim(-3, 103)
    panels[0].set_ylabel("success [%]")
    handles = panels[0].get_legend_handles_labels()
    figure.legend(*handles, fontsize=8, frameon=False, loc="outside upper right", ncols=2)
    figure.supxlabel("cosine similarity to the nearest training robot", fontsize=10)
    FigureCanvasAgg(figure).print_figure(path, dpi=110, metadata={"Software": None})


def main() -> None:
    """Compare the robots, print the table, and write the rows and the figure if asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    parser.add_argument("--robots", type=int, nargs="+", default=[10, 30, 100, 300, 1000])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--results", type=Path, default=Path("results/robot-curve.json"))
    parser.add_argument("--runs", type=Path, default=Path("runs/robot-curve"))
    parser.add_argument("--jobs", type=int, default=1, help="processes that compare robots")
    parser.add_argument("--out", type=Path, default=OUT, help="a row per policy and robot")
    parser.add_argument("--figure", type=Path, help="also draw success against cosine here (PNG)")
    parser.add_argument("--report", action="store_true", help="only print what is in --out")
    args = parser.parse_args()
    rows = read_rows(args.out) if args.report else measure(args)
    if args.figure:
        draw_figure(rows, args.figure)
    print(table(rows))


def measure(args: argparse.Namespace) -> list[Row]:
    """Compare the robots, write the rows, and print what is left out."""
    library = default_library()
    try:
        policies = list(read_policies(args, library))
        if not policies:
            raise BenchmarkError(f"{args.results}: no results of these policies")
        survey = survey_all(policies, library, args.jobs)
    except MorphgenError as error:
        sys.exit(str(error))
    rows = list(compare(policies, survey))
    entries = ",\n".join(json.dumps(asdict(row)) for row in rows)
    write_atomic(args.out, f"[\n{entries}\n]\n")
    for robot in survey.train:
        if isinstance(robot, Fault):
            print(f"left out: {robot.why}")
    return rows


if __name__ == "__main__":
    main()
