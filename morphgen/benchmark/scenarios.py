"""The scenarios of the paper as tables of robots. The split files in ``splits/`` are made of them.

After a change here, or of a part that a scenario uses, run ``write_scenarios``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from morphgen.benchmark.generate import (
    Candidate,
    ComposedRecipe,
    RobotFactory,
    SampledRecipe,
    members,
    numbered_name,
    stream_seed,
)
from morphgen.benchmark.split import Member, Regime, Split
from morphgen.benchmark.split_file import SUFFIX, write_split
from morphgen.benchmark.survey import statistics
from morphgen.errors import BenchmarkError, nearest
from morphgen.grammar.grammar_file import find_grammar, load_grammar
from morphgen.grammar.library import Library, default_library
from morphgen.grammar.request import pin

SEED = 0
"""Seed of all scenarios."""
PAPER = "AnyBody (arXiv 2505.14986), table 1: {}"


@dataclass(frozen=True)
class SampledRow:
    """Robots sampled from a grammar."""

    n: int
    grammar: str
    pins: str = ""
    """Choices that are fixed in the grammar, in the notation of ``morphgen compose``."""
    prefix: str = ""
    """Prefix of the robots' names; by default the grammar's name."""
    task: str | None = None
    """Task of the robots; by default that of the variant."""
    first: int = 0
    """Number of the first robot."""


@dataclass(frozen=True)
class ComposedRow:
    """A robot given by the arguments of ``morphgen compose``."""

    name: str
    words: str
    task: str | None = None


Row = SampledRow | ComposedRow


@dataclass(frozen=True)
class Variant:
    """A task of a scenario; each variant is a split of its own."""

    suffix: str
    """Suffix of the split's name."""
    task: str
    obstacles: bool = False


@dataclass(frozen=True)
class Scenario:
    """Train and test robots for one or several tasks."""

    name: str
    regime: Regime
    summary: str
    reference: str
    train: tuple[Row, ...]
    test: tuple[Row, ...]
    variants: tuple[Variant, ...]
    hull: str = ""
    """Position of the parameters of test robots, see ``morphgen.benchmark.regimes.HULLS``."""
    accepted: Mapping[str, str] = field(default_factory=dict)


REACH, PUSH = Variant("/reach", "reach"), Variant("/push", "push")
WITH_OBSTACLES = (
    Variant("/reach-obstacles", "reach", obstacles=True),
    Variant("/push-obstacles", "push", obstacles=True),
)
MIXED = Variant("", "push")

UR5_STICK = ComposedRow("ur5-stick", "arm=ur5 ee=stick")
UR5_PLANE = ComposedRow("ur5-plane", "arm=ur5 ee=plane")
UR5_EZ = ComposedRow("ur5-ez", "arm=ur5 ee=sake_ez")
UR5_SAWYER = ComposedRow("ur5-sawyer", "arm=ur5 ee=rethink")
PANDA = ComposedRow("panda", "arm=panda ee=panda_hand")
KINOVA = ComposedRow("kinova", "arm=kinova_gen3 ee=robotiq_2f85")
JACO = ComposedRow("jaco", "arm=jaco2 ee=jaco_fingers")
XARM = ComposedRow("xarm", "arm=xarm7 ee=robotiq_2f85")
LWR = ComposedRow("lwr", "arm=lwr ee=panda_hand")
YUMI = ComposedRow("yumi", "arm=yumi left.ee=yumi_gripper right.ee=yumi_gripper")
WIDOWX = ComposedRow("widowx", "arm=widowx ee=widowx_gripper")

SCENARIOS: tuple[Scenario, ...] = (
    Scenario(
        "interpolation/arm3",
        "interpolation",
        "A small arm with a claw, of ten sizes; test: a size between them",
        PAPER.format("Interpolation, Arm-3"),
        train=(SampledRow(10, "arm3"),),
        test=(SampledRow(1, "arm3", prefix="arm3-test"),),
        variants=(REACH, PUSH, *WITH_OBSTACLES),
        hull="inside",
    ),
    Scenario(
        "interpolation/panda",
        "interpolation",
        "The Panda with links of other sizes, ten times; test: the Panda as it is",
        PAPER.format("Interpolation, Panda"),
        train=(SampledRow(10, "panda_variations"),),
        test=(ComposedRow("panda", "panda_variations"),),
        variants=(REACH, PUSH),
    ),
    Scenario(
        "composition/ee-arm",
        "composition",
        "Planes and cylinders on a gantry, and a UR5 with three end-effectors; test: it with a "
        "stick",
        PAPER.format("Composition, EE Arm"),
        train=(
            SampledRow(3, "prims", "prim=plane", "plane"),
            SampledRow(4, "prims", "prim=cylinder", "cylinder"),
            UR5_PLANE,
            UR5_EZ,
            UR5_SAWYER,
        ),
        test=(UR5_STICK,),
        variants=(REACH, PUSH),
        accepted={
            "part-unseen": "the paper's own: no train robot has the stick; its cylinders, rods of "
            "5 mm, stand for it"
        },
    ),
    Scenario(
        "composition/ee-task",
        "composition",
        "Planes on a gantry push, a UR5 with a stick reaches; test: a UR5 with a plane pushes",
        PAPER.format("Composition, EE-Task"),
        train=(
            SampledRow(3, "prims", "prim=plane", "plane", task="push"),
            replace(UR5_STICK, task="reach"),
        ),
        test=(replace(UR5_PLANE, task="push"),),
        variants=(MIXED,),
    ),
    Scenario(
        "extrapolation/primitives",
        "extrapolation",
        "Sticks, planar chains of bars, and simple bodies on a gantry; test: chains of beads",
        PAPER.format("Extrapolation, Primitives"),
        train=(
            SampledRow(2, "stick"),
            SampledRow(2, "nlink", "links=5"),
            SampledRow(1, "prims", "prim=plane", "plane"),
            SampledRow(1, "prims", "prim=cylinder", "cylinder"),
            SampledRow(2, "prims", "prim=cube", "cube"),
            SampledRow(2, "prims", "prim=sphere", "sphere"),
        ),
        test=(SampledRow(1, "chain", "beads=2"), SampledRow(1, "chain", "beads=3", first=1)),
        variants=(REACH, PUSH),
    ),
    Scenario(
        "extrapolation/arms",
        "extrapolation",
        "Eight real arms with their end-effectors, and two arms of tubes; test: the WidowX",
        PAPER.format("Extrapolation, Robot Arms"),
        train=(UR5_STICK, UR5_EZ, PANDA, KINOVA, JACO, XARM, LWR, YUMI, SampledRow(2, "arm5")),
        test=(WIDOWX,),
        variants=(REACH, PUSH),
    ),
    Scenario(
        "extrapolation/arms-small",
        "extrapolation",
        "Six real arms with their end-effectors, two arms of tubes and two small ones; test: the "
        "WidowX",
        "AnyBody's released scenarios: the second set of arms",
        train=(
            UR5_STICK,
            KINOVA,
            JACO,
            XARM,
            LWR,
            YUMI,
            SampledRow(2, "arm5"),
            SampledRow(2, "arm3"),
        ),
        test=(WIDOWX,),
        variants=(REACH, PUSH),
    ),
)
"""AnyBody's, arXiv 2505.14986."""


def scenario_splits(name: str, library: Library) -> tuple[Split, ...]:
    """Make the splits of a scenario from its table, one for each variant."""
    scenarios = {scenario.name: scenario for scenario in SCENARIOS}
    if name not in scenarios:
        raise BenchmarkError(f"unknown scenario {name!r}{nearest(name, scenarios)}")
    scenario = scenarios[name]
    factory = RobotFactory(library.folders)
    train, test = (
        [(robot, row.task) for row in rows for robot in _candidates(row, factory)]
        for rows in (scenario.train, scenario.test)
    )
    provenance = {
        "seed": SEED,
        **({"hull": scenario.hull} if scenario.hull else {}),
        "train": [_row_data(row) for row in scenario.train],
        "test": [_row_data(row) for row in scenario.test],
    }
    splits = [
        Split(
            f"{scenario.name}{variant.suffix}",
            scenario.regime,
            scenario.summary,
            tuple(_members(train, variant)),
            tuple(_members(test, variant)),
            provenance,
            scenario.accepted,
            scenario.reference,
        )
        for variant in scenario.variants
    ]
    figures = statistics(splits[0], library)
    return tuple(replace(split, statistics=figures) for split in splits)


def write_scenarios(folder: Path, names: Iterable[str] = ()) -> list[Path]:
    """Write the split files of scenarios and return their paths."""
    library = default_library()
    paths = []
    for name in tuple(names) or [scenario.name for scenario in SCENARIOS]:
        for split in scenario_splits(name, library):
            paths.append(folder / f"{split.name}{SUFFIX}")
            write_split(split, paths[-1])
    return paths


def _candidates(row: Row, factory: RobotFactory) -> Iterator[Candidate]:
    if isinstance(row, ComposedRow):
        yield factory(ComposedRecipe(tuple(row.words.split()), row.name))
        return
    folders = factory.library.folders
    grammar = load_grammar(find_grammar(row.grammar, folders), folders)
    grammar = pin(grammar, row.pins.split(), factory.library)
    prefix = row.prefix or row.grammar
    for number in range(row.first, row.first + row.n):
        yield factory(
            SampledRecipe(grammar, number, stream_seed(SEED, prefix), numbered_name(prefix, number))
        )


def _members(robots: Iterable[tuple[Candidate, str | None]], variant: Variant) -> Iterator[Member]:
    for robot, task in robots:
        yield from members([robot], [task or variant.task], variant.obstacles)


def _row_data(row: Row) -> dict[str, object]:
    """Return a row as plain data for the split file."""
    task = {"task": row.task} if row.task else {}
    if isinstance(row, ComposedRow):
        return {"robot": row.name, "words": row.words, **task}
    return {
        "robots": row.n,
        "grammar": row.grammar,
        **({"pinned": row.pins} if row.pins else {}),
        "seed": stream_seed(SEED, row.prefix or row.grammar),
        **({"first": row.first} if row.first else {}),
        **task,
    }
