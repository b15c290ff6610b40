"""The paper's scenarios: which robots each is made of. Their files lie in ``splits/``.

After a change here, or of a part that they use, ``write_scenarios`` makes the files anew.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from morphgen.benchmark.robot_factory import (
    Candidate,
    ComposedRecipe,
    RobotFactory,
    SampledRecipe,
    numbered_name,
    stream_seed,
)
from morphgen.benchmark.split import Member, Regime, Split
from morphgen.benchmark.split_file import SUFFIX, write_split
from morphgen.benchmark.statistics import statistics
from morphgen.errors import BenchmarkError, nearest
from morphgen.grammar.grammar_file import find_grammar, load_grammar
from morphgen.grammar.library import Library, default_library
from morphgen.grammar.pinning import pin

SEED = 0
"""Of all scenarios."""
PAPER = "AnyBody (arXiv 2505.14986), table 1: {}"


@dataclass(frozen=True)
class Draws:
    """Robots drawn from a grammar."""

    n: int
    grammar: str
    pins: str = ""
    """What is fixed in it, as ``morphgen compose`` takes it."""
    prefix: str = ""
    """Of their names, if not the grammar's name."""
    task: str | None = None
    """If not that of the scenario."""
    first: int = 0
    """Number of the first."""


@dataclass(frozen=True)
class Given:
    """A robot given by words of ``morphgen compose``."""

    name: str
    words: str
    task: str | None = None


Row = Draws | Given


@dataclass(frozen=True)
class Variant:
    """A task that the robots of a scenario are put to."""

    suffix: str
    """Of the split's name."""
    task: str
    obstacles: bool = False


@dataclass(frozen=True)
class Scenario:
    """Robots to train and to test on, for one or several tasks."""

    name: str
    regime: Regime
    summary: str
    reference: str
    train: tuple[Row, ...]
    test: tuple[Row, ...]
    variants: tuple[Variant, ...]
    hull: str = ""
    """Where the parameters of test robots lie, see ``morphgen.benchmark.regimes.HULLS``."""
    accepted: Mapping[str, str] = field(default_factory=dict)


REACH, PUSH = Variant("/reach", "reach"), Variant("/push", "push")
WITH_OBSTACLES = (
    Variant("/reach-obstacles", "reach", obstacles=True),
    Variant("/push-obstacles", "push", obstacles=True),
)
MIXED = Variant("", "push")

UR5_STICK = Given("ur5-stick", "arm=ur5 ee=stick")
UR5_PLANE = Given("ur5-plane", "arm=ur5 ee=plane")
UR5_EZ = Given("ur5-ez", "arm=ur5 ee=sake_ez")
UR5_SAWYER = Given("ur5-sawyer", "arm=ur5 ee=rethink")
PANDA = Given("panda", "arm=panda ee=panda_hand")
KINOVA = Given("kinova", "arm=kinova_gen3 ee=robotiq_2f85")
JACO = Given("jaco", "arm=jaco2 ee=jaco_fingers")
XARM = Given("xarm", "arm=xarm7 ee=robotiq_2f85")
LWR = Given("lwr", "arm=lwr ee=panda_hand")
YUMI = Given("yumi", "arm=yumi left.ee=yumi_gripper right.ee=yumi_gripper")
WIDOWX = Given("widowx", "arm=widowx ee=widowx_gripper")

SCENARIOS: tuple[Scenario, ...] = (
    Scenario(
        "interpolation/arm3",
        "interpolation",
        "A small arm with a claw, of ten sizes; test: a size between them",
        PAPER.format("Interpolation, Arm-3"),
        train=(Draws(10, "arm3"),),
        test=(Draws(1, "arm3", prefix="arm3-test"),),
        variants=(REACH, PUSH, *WITH_OBSTACLES),
        hull="inside",
    ),
    Scenario(
        "interpolation/panda",
        "interpolation",
        "The Panda with links of other sizes, ten times; test: the Panda as it is",
        PAPER.format("Interpolation, Panda"),
        train=(Draws(10, "panda_variations"),),
        test=(Given("panda", "panda_variations"),),
        variants=(REACH, PUSH),
    ),
    Scenario(
        "composition/ee-arm",
        "composition",
        "Planes and cylinders on a gantry, and a UR5 with three end-effectors; test: it with a "
        "stick",
        PAPER.format("Composition, EE Arm"),
        train=(
            Draws(3, "prims", "prim=plane", "plane"),
            Draws(4, "prims", "prim=cylinder", "cylinder"),
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
            Draws(3, "prims", "prim=plane", "plane", task="push"),
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
            Draws(2, "stick"),
            Draws(2, "nlink", "links=5"),
            Draws(1, "prims", "prim=plane", "plane"),
            Draws(1, "prims", "prim=cylinder", "cylinder"),
            Draws(2, "prims", "prim=cube", "cube"),
            Draws(2, "prims", "prim=sphere", "sphere"),
        ),
        test=(Draws(1, "chain", "beads=2"), Draws(1, "chain", "beads=3", first=1)),
        variants=(REACH, PUSH),
    ),
    Scenario(
        "extrapolation/arms",
        "extrapolation",
        "Eight real arms with their end-effectors, and two arms of tubes; test: the WidowX",
        PAPER.format("Extrapolation, Robot Arms"),
        train=(UR5_STICK, UR5_EZ, PANDA, KINOVA, JACO, XARM, LWR, YUMI, Draws(2, "arm5")),
        test=(WIDOWX,),
        variants=(REACH, PUSH),
    ),
    Scenario(
        "extrapolation/arms-small",
        "extrapolation",
        "Six real arms with their end-effectors, two arms of tubes and two small ones; test: the "
        "WidowX",
        "AnyBody's released scenarios: the second set of arms",
        train=(UR5_STICK, KINOVA, JACO, XARM, LWR, YUMI, Draws(2, "arm5"), Draws(2, "arm3")),
        test=(WIDOWX,),
        variants=(REACH, PUSH),
    ),
)
"""AnyBody's, arXiv 2505.14986."""


def scenario_splits(name: str, library: Library) -> tuple[Split, ...]:
    """The splits of a scenario, made from nothing but its rows: one for every variant.

    Args:
        name: Such as ``extrapolation/arms``.
        library: Where parts are.

    Raises:
        BenchmarkError: If there is no such scenario.
    """
    found = {scenario.name: scenario for scenario in SCENARIOS}
    if name not in found:
        raise BenchmarkError(f"unknown scenario {name!r}{nearest(name, found)}")
    scenario = found[name]
    maker = RobotFactory(library.folders)
    train, test = (
        [(body, row.task) for row in rows for body in _bodies(row, maker)]
        for rows in (scenario.train, scenario.test)
    )
    made = {
        "seed": SEED,
        **({"hull": scenario.hull} if scenario.hull else {}),
        "train": [_said(row) for row in scenario.train],
        "test": [_said(row) for row in scenario.test],
    }
    splits = [
        Split(
            f"{scenario.name}{variant.suffix}",
            scenario.regime,
            scenario.summary,
            tuple(_members(train, variant)),
            tuple(_members(test, variant)),
            made,
            scenario.accepted,
            scenario.reference,
        )
        for variant in scenario.variants
    ]
    figures = statistics(splits[0], library)
    return tuple(replace(split, statistics=figures) for split in splits)


def write_scenarios(folder: Path, names: Iterable[str] = ()) -> list[Path]:
    """Write the files of scenarios.

    Args:
        folder: Where they go, as ``<folder>/extrapolation/arms/reach.yaml``.
        names: Which scenarios; all if none are named.

    Returns:
        The files.
    """
    library = default_library()
    paths = []
    for name in tuple(names) or [scenario.name for scenario in SCENARIOS]:
        for split in scenario_splits(name, library):
            paths.append(folder / f"{split.name}{SUFFIX}")
            write_split(split, paths[-1])
    return paths


def _bodies(row: Row, maker: RobotFactory) -> Iterator[Candidate]:
    if isinstance(row, Given):
        yield maker(ComposedRecipe(tuple(row.words.split()), row.name))
        return
    folders = maker.library.folders
    grammar = load_grammar(find_grammar(row.grammar, folders), folders)
    grammar = pin(grammar, row.pins.split(), maker.library)
    prefix = row.prefix or row.grammar
    for number in range(row.first, row.first + row.n):
        yield maker(
            SampledRecipe(grammar, number, stream_seed(SEED, prefix), numbered_name(prefix, number))
        )


def _members(bodies: Iterable[tuple[Candidate, str | None]], variant: Variant) -> Iterator[Member]:
    for body, task in bodies:
        yield Member(
            body.name,
            body.category,
            str(body.derivation),
            task or variant.task,
            variant.obstacles,
            body.hash,
        )


def _said(row: Row) -> dict[str, object]:
    """A row as the file tells it."""
    task = {"task": row.task} if row.task else {}
    if isinstance(row, Given):
        return {"robot": row.name, "words": row.words, **task}
    return {
        "robots": row.n,
        "grammar": row.grammar,
        **({"pinned": row.pins} if row.pins else {}),
        "seed": stream_seed(SEED, row.prefix or row.grammar),
        **({"first": row.first} if row.first else {}),
        **task,
    }
