"""Sources of robots for training and evaluation: a split, one robot, or robots of grammars.

Robots of grammars are those of ``morphgen sample`` with the same seed, except for those that are
skipped: test robots of splits, robots that were drawn before, and robots that cannot do the task.
The same source gives the same robots in the same order, with any number of processes.
"""

from __future__ import annotations

import itertools
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import msgspec
import numpy as np

from morphgen.encoding.robot_hash import digest, robot_hash
from morphgen.encoding.tokens import LARGEST_MAX_LINKS, require_max_links
from morphgen.errors import BenchmarkError, FormatError, MorphgenError, TaskError, nearest
from morphgen.formats.data_files import read_json
from morphgen.formats.files import write_file
from morphgen.formats.records import read_record
from morphgen.grammar.analysis import load_sound_grammar
from morphgen.grammar.grammar_file import SUFFIX
from morphgen.grammar.library import default_library
from morphgen.grammar.robot_source import is_robot_file
from morphgen.model.kinematics import driving_joints
from morphgen.model.robot import TOOL, Robot
from morphgen.processes import parallel_stream
from morphgen.progress import own_progress, show_progress
from morphgen.rl.config import read_fields
from morphgen.splits.split import (
    Member,
    MemberRecord,
    RobotFactory,
    SampledRecipe,
    Side,
    Split,
    compose_member,
    numbered_name,
    parse_split,
    read_split,
    split_id,
    split_names,
    split_text,
)
from morphgen.tasks.registry import TASKS
from morphgen.tasks.scenes.env_specs import GoalConfig, env_spec, load_robot, member_spec
from morphgen.tasks.split_goals import read_goals, shipped_goal_set
from morphgen.tasks.task import EnvSpec


@dataclass(frozen=True, kw_only=True)
class _Robots:
    """Robots with their tasks, described by text alone, so that a run's folder describes them."""

    name: str
    """Name of the split; words that describe one robot, or its file; or the grammars with the
    number of robots of each."""
    goal_seed: int = 0  # seed of goals, starts and obstacles
    library: tuple[str, ...] = ()  # folders with further parts


@dataclass(frozen=True, kw_only=True)
class SplitSource(_Robots):
    """The robots of a side of a split, each with its own task."""

    split: str  # text of the split's file; empty in a submission, which has its name and id
    side: Side = "train"
    member: str | None = None  # name of the only member that is meant; None for all of the side
    goal_dir: str = ""
    """Folder where the split is built with the goal sets to use; without it goals are sampled."""


@dataclass(frozen=True, kw_only=True)
class OneRobot(_Robots):
    """One robot at a task."""

    task: str
    obstacles: bool = False
    robot_hash: str


@dataclass(frozen=True, kw_only=True)
class GrammarSource(_Robots):
    """Robots that ``draw`` draws from grammars; with several tasks they have them in turn."""

    task: str  # name of the task, or names with commas between them
    obstacles: bool = False
    grammars: tuple[tuple[str, int], ...]
    """Grammars, by name or path, and the number of robots to draw from each."""
    draw_seed: int = 0  # seed of the robots: they are those of `morphgen sample --seed`
    held_out: tuple[str, ...] = ()
    """Splits whose test robots are not drawn, besides the splits that morphgen ships."""
    drawn_hash: str = ""  # hash of the drawn robots; empty until they are drawn


@dataclass(frozen=True, kw_only=True)
class RecordedSource(_Robots):
    """Robots of demonstrations, which a policy learns from without an environment."""

    task: str  # name of the task, or names with commas between them
    obstacles: bool = False
    demonstrations: tuple[str, ...]  # folders of the data sets
    content: tuple[str, ...]  # hash of the steps of each data set


Source: TypeAlias = SplitSource | OneRobot | GrammarSource | RecordedSource
"""Robots to train or to evaluate on."""
S = TypeVar("S", bound=Source)
KINDS = (SplitSource, GrammarSource, RecordedSource, OneRobot)


def source_from(stored: object, where: str) -> Source:
    """Return the source that ``dataclasses.asdict`` made a dictionary of.

    Versions until 0.3 wrote the fields of all kinds of sources, empty where they are of another.
    """
    data = read_record(stored, dict[str, Any], where, TaskError)
    kind: type[Source] = OneRobot
    if data.get("grammars"):
        kind = GrammarSource
    elif data.get("demonstrations"):
        kind = RecordedSource
    elif data.get("task") is None:
        kind = SplitSource
    own, known = (
        {each.name for kind in kinds for each in fields(kind)} for kinds in ([kind], KINDS)
    )
    values = {name: value for name, value in data.items() if name in own or name not in known}
    return kind(**read_fields(values, kind, where))


def split_source(
    split: Split,
    *,
    goal_seed: int = 0,
    goals: Path | None = None,
    library: tuple[Path, ...] = (),
    side: Side = "train",
) -> SplitSource:
    """Return the robots of a side of a split; ``goals`` is the folder with its goal sets."""
    return SplitSource(
        name=split.name,
        split=split_text(split),
        side=side,
        goal_seed=goal_seed,
        goal_dir=str(goals.resolve()) if goals is not None else "",
        library=tuple(str(folder.resolve()) for folder in library),
    )


def robot_source(
    robot: str,
    task: str,
    *,
    obstacles: bool = False,
    goal_seed: int = 0,
    library: tuple[Path, ...] = (),
) -> OneRobot:
    """Return one robot, named in any way that ``load_robot`` of ``env_specs`` reads."""
    return OneRobot(
        name=str(Path(robot).resolve()) if is_robot_file(robot) else robot,
        task=task,
        obstacles=obstacles,
        robot_hash=robot_hash(load_robot(robot, library=library)),
        goal_seed=goal_seed,
        library=tuple(str(folder.resolve()) for folder in library),
    )


def split_of(source: SplitSource) -> Split:
    """Return the split of a source."""
    return parse_split(source.split, Path(source.name)).split


def members(source: Source) -> tuple[Member, ...]:
    """Return the members of the split that are meant; none without a split."""
    if not isinstance(source, SplitSource) or not source.split:
        return ()
    side = split_of(source).side(source.side)
    if source.member is None:
        return side
    names = [member.name for member in side]
    if source.member not in names:
        raise BenchmarkError(
            f"split {source.name!r} has no {source.side} robot {source.member!r}"
            f"{nearest(source.member, names)}"
        )
    return tuple(member for member in side if member.name == source.member)


def side_of(source: Source) -> Side:
    """Return the side of the split; robots without one are train robots."""
    return source.side if isinstance(source, SplitSource) else "train"


def identity(source: Source) -> dict[str, Any]:
    """Return the entries of a source that results depend on: of a split its id, not its text.

    The text also has the version of morphgen that wrote it.
    """
    entries = asdict(source)
    if isinstance(source, SplitSource) and source.split:
        entries["split"] = split_id(split_of(source))
    return entries


def tasks_of(source: Source) -> tuple[str, ...]:
    """Return the tasks of the robots, without repetition."""
    if isinstance(source, SplitSource):
        return tuple(dict.fromkeys(member.task for member in members(source)))
    return tuple(source.task.split(","))


def other_side(source: S, side: Side) -> S:
    """Return a whole side of the same split."""
    if isinstance(source, SplitSource):
        return replace(source, side=side, member=None)
    if side == "test" and isinstance(source, GrammarSource | RecordedSource):
        raise _without_sides(source)
    if side == "test":
        raise TaskError(f"{source.name!r} is one robot and not a split: it has no test robots")
    return source


@lru_cache(maxsize=64)
def most_obstacles(source: Source, config: GoalConfig) -> int:
    """Return the largest number of obstacles of any robot, on both sides of the split."""
    if not isinstance(source, SplitSource):
        counts = [config.task_config(task).obstacles for task in tasks_of(source)]
        return max(counts) if source.obstacles else 0
    sides: tuple[Side, ...] = ("train", "test")
    both = (member for side in sides for member in members(other_side(source, side)))
    return max(
        (config.task_config(member.task).obstacles for member in both if member.obstacles),
        default=0,
    )


def require_links(source: Source, max_links: int) -> None:
    """Require that a policy can be tested on the other side of a split, or on held-out robots."""
    side: Side = "test" if side_of(source) == "train" else "train"
    others: Iterable[Member] = ()
    if isinstance(source, SplitSource):
        others = members(other_side(source, side))
    elif isinstance(source, GrammarSource):
        others = (member for name in source.held_out for member in read_split(name).test)
    library = default_library(tuple(map(Path, source.library)))
    for member in others:
        links = len(compose_member(member, library).links)
        require_max_links(links, f"{side} robot {member.name!r}", max_links)


def specs_of(source: Source, config: GoalConfig) -> list[EnvSpec]:
    """Return the robots with their tasks and scenes; each is built once per process."""
    if isinstance(source, GrammarSource | RecordedSource):
        raise _without_sides(source)
    config = replace(config, seed=source.goal_seed)
    if isinstance(source, SplitSource):
        own, meant = replace(source, split="", member=None), members(source)
        specs: list[EnvSpec] = []
        with own_progress() as show:
            for member in meant:
                show(len(specs), len(meant))
                specs.append(_of_member(member, own, config))
            show(len(specs), len(meant))
        return specs
    with show_progress(None):
        robot = load_robot(source.name, library=map(Path, source.library))
    if source.robot_hash != robot_hash(robot):
        raise TaskError(f"{source.name}: the robot has changed since the run began")
    return [env_spec(robot, source.task, config, obstacles=source.obstacles)]


def _without_sides(source: GrammarSource | RecordedSource) -> TaskError:
    origin = "are drawn from grammars" if isinstance(source, GrammarSource) else "were recorded"
    return TaskError(
        f"the training robots {source.name} {origin} and have no test side: name other robots "
        "with --split"
    )


_shipped = lru_cache(maxsize=2)(read_goals)


@lru_cache(maxsize=64)
def _of_member(member: Member, source: SplitSource, config: GoalConfig) -> EnvSpec:
    sets = _shipped(source.goal_dir, source.side) if source.goal_dir else None
    shipped = shipped_goal_set(sets, member.name, source.goal_dir)
    library = default_library(tuple(map(Path, source.library)))
    return member_spec(member, library, config, shipped=shipped)


FILE = "robots.json"  # file in a run's folder that lists its drawn robots
FORMAT = 1
MAX_DRAWS = 4  # draws per requested robot, after which a grammar is considered unfit for the task
MIN_DRAWS = 20  # the same limit for few robots: draws per grammar
ROBOTS_PER_JOB = 16
"""Robots for which another process is started: it takes seconds to start, and a robot 0.06 s if its
goals are stored, else up to some seconds."""
MAX_FRESH = 10  # most robots of a grammar that are drawn to evaluate on
_FRESH = 0xF4E54
"""Mixed into the seed of robots to evaluate on, which thus are others than those to train on."""
HELD_OUT, DRAWN_BEFORE, UNFIT = "held out", "drawn before", "without goals"
"""Reasons for skipping a robot."""


@dataclass(frozen=True, eq=False)
class DrawnRobots:
    """Robots drawn from grammars, ready to train."""

    members: tuple[Member, ...]
    """Name, derivation and hash of each robot; its category is its grammar."""
    specs: tuple[EnvSpec, ...]  # environments of each robot, with its goal set
    skipped: Mapping[str, int]  # number of skipped robots, by reason
    held_out: tuple[str, ...]  # hashes of the robots that are never drawn, sorted

    @property
    def hash(self) -> str:
        """Hash of the hashes of all robots, in order."""
        return digest([member.robot_hash for member in self.members])

    @property
    def most_links(self) -> int:
        """Number of links of the largest robot."""
        return max(len(spec.robot.links) for spec in self.specs)


def drawn_source(
    request: str,
    task: str,
    *,
    seed: int = 0,
    held_out: Sequence[str | Path] = (),
    obstacles: bool = False,
    goal_seed: int = 0,
    library: Sequence[Path] = (),
) -> GrammarSource:
    """Return robots of grammars as a source; ``draw`` draws them."""
    folders = tuple(library)
    grammars = [
        # A file by its absolute path: a run may be resumed in another folder.
        (
            load_sound_grammar(name, default_library(folders)).name,
            str(Path(name).resolve()) if name.endswith(SUFFIX) else name,
            count,
        )
        for name, count in _parse_request(request)
    ]
    names = Counter(name for name, _, _ in grammars)
    name, times = names.most_common(1)[0]
    if times > 1:
        raise TaskError(f"--robots {request}: names the grammar {name!r} {times} times")
    for split in held_out:
        read_split(split)  # raises if it is unknown
    return GrammarSource(
        name=",".join(f"{name}:{count}" for name, _, count in grammars),
        task=task,
        obstacles=obstacles,
        goal_seed=goal_seed,
        library=tuple(str(folder.resolve()) for folder in folders),
        grammars=tuple((name_or_path, count) for _, name_or_path, count in grammars),
        draw_seed=seed,
        held_out=tuple(
            str(Path(split).resolve()) if Path(split).is_file() else str(split)
            for split in held_out
        ),
    )


def num_actuated(robot: Robot, task: str) -> int:
    """Return the number of joints that actions move."""
    if TASKS[task].moves_fingers:
        return robot.dof
    return len(driving_joints(robot, robot.joint_chain(robot.frame(TOOL).link)))


def num_drawn(source: Source) -> int:
    """Return the number of robots that a source draws from grammars."""
    return sum(count for _, count in source.grammars) if isinstance(source, GrammarSource) else 0


def draw(source: GrammarSource, config: GoalConfig, *, jobs: int = 1) -> DrawnRobots:
    """Return the robots of a source, which are drawn once per process.

    Goal sets are kept in the cache, so that an interrupted call continues.
    """
    key = replace(source, drawn_hash=""), config
    if key not in _drawn:
        _drawn[key] = _draw_all(*key, jobs)  # not lru_cache: robots do not depend on the jobs
        if len(_drawn) > _MAX_DRAWN:
            del _drawn[next(iter(_drawn))]  # the oldest
    robots = _drawn[key]
    if source.drawn_hash not in ("", robots.hash):
        raise TaskError(
            f"the robots of {source.name} with seed {source.draw_seed} have changed since the run "
            f"began: their hash is {robots.hash}, not {source.drawn_hash}"
        )
    return robots


_drawn: dict[tuple[GrammarSource, GoalConfig], DrawnRobots] = {}
"""The robots drawn last, by source and goals."""
_MAX_DRAWN = 8  # largest number of sources whose robots are kept


def fresh_source(
    folder: Path, source: GrammarSource, config: GoalConfig, seed: int, *, jobs: int = 1
) -> tuple[SplitSource, str]:
    """Draw robots to evaluate a run of drawn robots on, other ones than it was trained on.

    They are the test side of a split; the second result is a line that describes them.
    """
    trained = read_drawn(folder)
    draw_seed = int(np.random.SeedSequence([_FRESH, source.draw_seed, seed]).generate_state(1)[0])
    counts = tuple((name, min(count, MAX_FRESH)) for name, count in source.grammars)
    fresh = replace(source, grammars=counts, draw_seed=draw_seed, drawn_hash="")
    hashes = frozenset(member.robot_hash for member in trained)
    robots = _draw_all(fresh, config, jobs, hashes)
    request = ",".join(f"{Path(name).stem}:{count}" for name, count in counts)
    line = f"fresh robots {request}, drawn with seed {draw_seed}, hash {robots.hash}"
    split = Split("fresh", "interpolation", line, trained, robots.members)
    test = split_source(split, side="test", goal_seed=source.goal_seed)
    return replace(test, library=source.library), line


def write_drawn(folder: Path, source: GrammarSource, robots: DrawnRobots) -> None:
    """Write the list of drawn robots into a run's folder; the same robots give the same bytes."""
    head = {
        "format": FORMAT,
        "robots": source.name,
        "seed": source.draw_seed,
        "hash": robots.hash,
        "skipped": dict(robots.skipped),
        "held_out": [*split_names(), *source.held_out],
        "held_out_bodies": robots.held_out,
    }
    lines = ",\n".join(f"    {json.dumps(member.as_dict())}" for member in robots.members)
    text = json.dumps(head, indent=2).removesuffix("\n}")
    write_file(folder / FILE, f'{text},\n  "drawn": [\n{lines}\n  ]\n}}\n')


def read_drawn(folder: Path) -> tuple[Member, ...]:
    """Return the drawn robots that the folder of a run lists."""
    path = folder / FILE
    try:
        data = read_json(path)
    except (OSError, FormatError) as error:
        raise TaskError(f"{path}: no list of drawn robots: {error}") from error
    if not isinstance(data, dict) or "drawn" not in data:
        raise TaskError(f"{path}: no list of drawn robots; expected the key 'drawn'")
    robots = read_record(data["drawn"], tuple[MemberRecord, ...], f"{path}: drawn", TaskError)
    return tuple(Member(**msgspec.structs.asdict(robot)) for robot in robots)


def trained_on(folder: Path, source: Source) -> list[str]:
    """Return the names of a source's robots that are among the drawn robots of a run."""
    hashes = {member.robot_hash for member in read_drawn(folder)}
    robots = {member.name: member.robot_hash for member in members(source)}
    if isinstance(source, OneRobot):
        robots = {source.name: source.robot_hash}
    return [name for name, robot_hash in robots.items() if robot_hash in hashes]


def _parse_request(request: str) -> Iterator[tuple[str, int]]:
    """Yield the grammars of a request, and the number of robots of each."""
    for entry in request.split(","):
        name, _, count = entry.strip().rpartition(":")
        if not name or not count.isdecimal() or int(count) < 1:
            raise TaskError(
                f"--robots {request}: {entry.strip()!r} is not a grammar and a number of robots; "
                "expected such as arm3:300,chain:300"
            )
        yield name, int(count)


def _draw_all(
    source: GrammarSource, config: GoalConfig, jobs: int, others: frozenset[str] = frozenset()
) -> DrawnRobots:
    """Draw the robots of a source, without those of test sides and those with other hashes."""
    library = default_library(tuple(map(Path, source.library)))
    splits = (read_split(name) for name in (*split_names(), *source.held_out))
    held_out = tuple(sorted({member.robot_hash for split in splits for member in split.test}))
    total = num_drawn(source)
    goals = replace(config, seed=source.goal_seed)
    factory = RobotFactory(library, max_links=LARGEST_MAX_LINKS)
    draw_one = partial(_draw_one, source, goals, factory, others | frozenset(held_out))
    kept: dict[str, tuple[Member, EnvSpec]] = {}
    skipped: Counter[str] = Counter()
    fault = ""
    with own_progress() as show:
        show(0, total)
        for name, count in source.grammars:
            grammar = load_sound_grammar(name, library)
            wanted, tried = len(kept) + count, 0
            recipes = (
                SampledRecipe(grammar, i, source.draw_seed, numbered_name(grammar.name, i))
                for i in itertools.count()
            )
            missing = partial(lambda wanted: wanted - len(kept), wanted)
            workers = min(jobs, -(-count // ROBOTS_PER_JOB))
            with parallel_stream(draw_one, recipes, workers, missing) as drawn:
                while some := missing():
                    if tried >= max(MAX_DRAWS * count, MIN_DRAWS):
                        raise TaskError(
                            f"--robots {source.name}: {count - some} of {tried} robots of "
                            f"{grammar.name} can be used, expected {count}{fault}"
                        )
                    tried += some
                    for member, spec, reason, error in itertools.islice(drawn, some):
                        if member.robot_hash in kept:
                            reason = DRAWN_BEFORE
                        if reason or spec is None:
                            skipped[reason] += 1
                            fault = f"; {member.name}: {error or reason}"
                        else:
                            kept[member.robot_hash] = member, spec
                            show(len(kept), total)
    members, specs = zip(*kept.values(), strict=True)
    return DrawnRobots(members, specs, dict(sorted(skipped.items())), held_out)


def _draw_one(
    source: GrammarSource,
    config: GoalConfig,
    factory: RobotFactory,
    held_out: frozenset[str],
    recipe: SampledRecipe,
) -> tuple[Member, EnvSpec | None, str, str]:
    """Return a robot with its environments, or the reason for skipping it and its error."""
    tasks = tasks_of(source)
    task = tasks[recipe.number % len(tasks)]
    member = factory(recipe).member(task, (task,), source.obstacles)
    if member.robot_hash in held_out:
        return member, None, HELD_OUT, ""
    try:
        return member, member_spec(member, factory.library, config), "", ""
    except MorphgenError as error:
        return member, None, UNFIT, str(error)
