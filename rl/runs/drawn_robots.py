"""Training robots drawn from grammars: N sound robots of each, none of them a robot to test on.

The robots are those of ``morphgen sample`` with the same seed, except for those that are skipped:
test robots of splits, robots that were drawn before, and robots that cannot do the task. The same
source gives the same robots in the same order, with any number of processes.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from morphgen.benchmark.robot_factory import RobotFactory, SampledRecipe, numbered_name
from morphgen.benchmark.robot_factory import members as factory_members
from morphgen.benchmark.robot_hash import digest
from morphgen.benchmark.split import Member, Split
from morphgen.benchmark.split_file import read_split, split_names, split_text
from morphgen.benchmark.tokens import LARGEST_MAX_LINKS
from morphgen.errors import FormatError, MorphgenError, TaskError
from morphgen.formats.data_files import read_json
from morphgen.formats.files import write_atomic
from morphgen.grammar.analysis import load_sound_grammar
from morphgen.grammar.grammar_file import SUFFIX
from morphgen.grammar.library import default_library
from morphgen.processes import parallel_map
from morphgen.progress import own_progress
from morphgen.rl.config import read_fields
from morphgen.rl.runs.robot_source import RobotSource
from morphgen.rl.runs.robot_source import members as source_members
from morphgen.tasks.scenes.env_specs import GoalConfig, member_spec
from morphgen.tasks.task import EnvSpec

FILE = "robots.json"
"""File in a run's folder that lists its drawn robots."""
FORMAT = 1
MAX_DRAWS = 4
"""Draws per requested robot, after which a grammar is considered unfit for the task."""
MIN_DRAWS = 20
"""The same limit for few robots: draws per grammar."""
ROBOTS_PER_JOB = 16
"""Robots that a process draws before it reports; a process takes seconds to start, an arm3 with its
goals 0.06 s."""
MAX_FRESH = 10
"""Most robots of a grammar that are drawn to evaluate on."""
_FRESH = 0xF4E54
"""Mixed into the seed of robots to evaluate on, which thus are others than those to train on."""
HELD_OUT, DRAWN_BEFORE, UNFIT = "held out", "drawn before", "without goals"
"""Reasons for skipping a robot."""


@dataclass(frozen=True, eq=False)
class DrawnRobots:
    """Robots drawn from grammars, ready to train."""

    members: tuple[Member, ...]
    """Name, derivation and hash of each robot; its category is its grammar."""
    specs: tuple[EnvSpec, ...]
    """Environments of each robot, with its goal set."""
    skipped: Mapping[str, int]
    """Number of skipped robots, by reason."""
    held_out: tuple[str, ...]
    """Hashes of the robots that are never drawn, sorted."""

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
) -> RobotSource:
    """Return robots of grammars as a source; ``draw`` draws them."""
    folders = tuple(library)
    grammars = [
        (load_sound_grammar(name, default_library(folders)).name, _portable(name), count)
        for name, count in _parse_request(request)
    ]
    names = Counter(name for name, _, _ in grammars)
    name, times = names.most_common(1)[0]
    if times > 1:
        raise TaskError(f"--robots {request}: names the grammar {name!r} {times} times")
    for split in held_out:
        read_split(split)  # raises if it is unknown
    return RobotSource(
        ",".join(f"{name}:{count}" for name, _, count in grammars),
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


def num_drawn(source: RobotSource) -> int:
    """Return the number of robots that a source draws from grammars."""
    return sum(count for _, count in source.grammars)


def draw(source: RobotSource, config: GoalConfig, *, jobs: int = 1) -> DrawnRobots:
    """Return the robots of a source, which are drawn once per process.

    Goal sets are kept in the cache, so that an interrupted call continues.
    """
    key = replace(source, drawn_hash=""), config
    if key not in _drawn:
        robots = _draw_all(*key, jobs)
        while len(_drawn) >= _MAX_DRAWN:
            del _drawn[next(iter(_drawn))]
        _drawn[key] = robots
    robots = _drawn[key]
    if source.drawn_hash not in ("", robots.hash):
        raise TaskError(
            f"the robots of {source.name} with seed {source.draw_seed} have changed since the run "
            f"began: their hash is {robots.hash}, not {source.drawn_hash}"
        )
    return robots


_drawn: dict[tuple[RobotSource, GoalConfig], DrawnRobots] = {}
"""The robots drawn last, by source and goals."""
_MAX_DRAWN = 8
"""Largest number of sources whose robots are kept."""


def fresh_source(
    folder: Path,
    source: RobotSource,
    config: GoalConfig,
    seed: int,
    *,
    jobs: int = 1,
) -> tuple[RobotSource, str]:
    """Draw robots to evaluate a run of drawn robots on, other ones than it was trained on.

    Returns:
        The robots as the test side of a split, and a line that describes them.
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
    text = split_text(split)
    return RobotSource(
        "fresh",
        text,
        side="test",
        goal_seed=source.goal_seed,
        library=source.library,
    ), line


def write_drawn(folder: Path, source: RobotSource, robots: DrawnRobots) -> None:
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
    try:
        write_atomic(folder / FILE, f'{text},\n  "drawn": [\n{lines}\n  ]\n}}\n')
    except OSError as error:
        raise TaskError(f"cannot write {folder / FILE}: {error.strerror}") from error


def read_drawn(folder: Path) -> tuple[Member, ...]:
    """Return the drawn robots that the folder of a run lists."""
    path = folder / FILE
    try:
        data = read_json(path)
    except (OSError, FormatError) as error:
        raise TaskError(f"{path}: no list of drawn robots: {error}") from error
    if not isinstance(data, dict) or not isinstance(data.get("drawn"), list):
        raise TaskError(f"{path}: no list of drawn robots; expected the key 'drawn'")
    drawn = []
    for number, entry in enumerate(data["drawn"]):
        named = entry
        if isinstance(entry, dict):
            named = {"robot_hash" if key == "body" else key: entry[key] for key in entry}
        drawn.append(Member(**read_fields(named, Member, f"{path}: drawn: {number}")))
    return tuple(drawn)


def trained_on(folder: Path, source: RobotSource) -> list[str]:
    """Return the names of a source's robots that are among the drawn robots of a run."""
    hashes = {member.robot_hash for member in read_drawn(folder)}
    robots = {member.name: member.robot_hash for member in source_members(source)}
    robots = robots or {source.name: source.robot_hash}
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


def _portable(grammar: str) -> str:
    """Return the name of a grammar, or the absolute path of its file."""
    return str(Path(grammar).resolve()) if grammar.endswith(SUFFIX) else grammar


def _held_out(source: RobotSource) -> tuple[str, ...]:
    """Return the hashes of the test robots of all splits that are held out, sorted."""
    splits = (read_split(name) for name in (*split_names(), *source.held_out))
    return tuple(sorted({member.robot_hash for split in splits for member in split.test}))


def _draw_all(
    source: RobotSource,
    config: GoalConfig,
    jobs: int,
    others: frozenset[str] = frozenset(),
) -> DrawnRobots:
    """Draw the robots of a source, without those of test sides and those with other hashes."""
    library = default_library(tuple(map(Path, source.library)))
    held_out, total = _held_out(source), num_drawn(source)
    drawer = _Drawer(
        library.folders,
        replace(config, seed=source.goal_seed),
        str(source.task),
        source.obstacles,
        others | frozenset(held_out),
    )
    kept: dict[str, _Draw] = {}
    skipped: Counter[str] = Counter()
    fault = ""
    with own_progress() as show:
        show(0, total)
        for name, count in source.grammars:
            grammar = load_sound_grammar(name, library)
            wanted, tried = len(kept) + count, 0
            while missing := wanted - len(kept):
                if tried >= max(MAX_DRAWS * count, MIN_DRAWS):
                    raise TaskError(
                        f"--robots {source.name}: {count - missing} of {tried} robots of "
                        f"{grammar.name} can be used, expected {count}{fault}"
                    )
                numbers, tried = range(tried, tried + missing), tried + missing
                recipes = [
                    SampledRecipe(grammar, i, source.draw_seed, numbered_name(grammar.name, i))
                    for i in numbers
                ]
                for result in parallel_map(drawer, recipes, jobs, chunk=ROBOTS_PER_JOB):
                    reason = DRAWN_BEFORE if result.member.robot_hash in kept else result.skipped
                    if reason:
                        skipped[reason] += 1
                        fault = f"; {result.member.name}: {result.fault or reason}"
                    else:
                        kept[result.member.robot_hash] = result
                        show(len(kept), total)
    specs = tuple(result.spec for result in kept.values() if result.spec is not None)
    robots = tuple(result.member for result in kept.values())
    return DrawnRobots(robots, specs, dict(sorted(skipped.items())), held_out)


@dataclass(frozen=True, eq=False)
class _Draw:
    """A robot that was drawn."""

    member: Member
    """The robot and its task."""
    spec: EnvSpec | None = None
    """Its environments; None if it is skipped."""
    skipped: str = ""
    """Reason for skipping it."""
    fault: str = ""
    """Error of a robot that cannot do the task."""


@dataclass(frozen=True, eq=False)
class _Drawer:
    """Draws robots and samples their goal sets; it is sent to processes."""

    folders: tuple[Path, ...]
    config: GoalConfig
    task: str
    obstacles: bool
    held_out: frozenset[str]
    """Hashes of robots to skip."""

    @cached_property
    def _factory(self) -> RobotFactory:
        return RobotFactory(self.folders, max_links=LARGEST_MAX_LINKS)

    def __call__(self, recipe: SampledRecipe) -> _Draw:
        """Draw a robot."""
        candidate = self._factory(recipe)
        (member,) = factory_members((candidate,), (self.task,), self.obstacles)
        if member.robot_hash in self.held_out:
            return _Draw(member, skipped=HELD_OUT)
        try:
            return _Draw(member, member_spec(member, self._factory.library, self.config))
        except MorphgenError as error:
            return _Draw(member, skipped=UNFIT, fault=str(error))
