"""A run's folder: what was asked for, and how far it got."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from morphgen.benchmark.token_layout import MAX_LINKS
from morphgen.errors import FormatError, TaskError
from morphgen.formats.data_files import read_json
from morphgen.formats.files import LOCK, partial_of, write_atomic
from morphgen.rl.checkpoint_content import require_fields, require_learner
from morphgen.rl.checkpoint_file import packed, unpacked, warn_of_no_hash
from morphgen.rl.config import PolicyConfig, PPOConfig
from morphgen.rl.sources import Source, most_obstacles
from morphgen.tasks.actions import ActionKind
from morphgen.tasks.env_specs import GoalConfig, default_configs, task_configs
from morphgen.tasks.observation import ObservationConfig
from morphgen.tasks.registry import TASKS
from morphgen.tasks.task import TaskConfig

CONFIG, CHECKPOINT = "config.json", "checkpoint.pt"
FORMAT = 2
"""Of config and checkpoint; rises when older ones cannot be read any more. In 1 every agent had a
scale of logits, and none by default."""


@dataclass(frozen=True)
class Interface:
    """What policies see and do; environments for them are made so."""

    kind: ActionKind = "continuous"
    max_links: int | None = None
    """Links that observations and actions are padded to, as ``batch_of`` has it."""
    channels: ObservationConfig = field(default_factory=ObservationConfig)


@dataclass(frozen=True)
class RunConfig:
    """All that a run's weights follow from, but the machine."""

    source: Source
    policy: PolicyConfig
    ppo: PPOConfig
    seed: int = 0
    """Of weights, actions, minibatches and episodes."""
    sim: str = "pybullet"
    envs: int = 128
    device: str = "cpu"
    """Of networks and rollouts."""
    begin: str = ""
    """A checkpoint whose networks it begins with."""
    whole: bool = False
    """Whether ``se`` has all environments and transitions for each robot of a split (paper); else
    the robots share them, as those of an agent of many robots do."""
    max_links: int = MAX_LINKS
    """Links that observations and actions are padded to; no robot may have more."""
    tasks: tuple[TaskConfig, ...] = field(default_factory=default_configs)
    """Constants of tasks; in files each has an entry of its own, under the name of its task."""

    def __post_init__(self) -> None:
        """Check.

        Raises:
            TaskError: If the seed is none, there is no environment, or so many links are too few
                for any robot.
        """
        if self.seed < 0:
            raise TaskError(f"--seed {self.seed}: expected 0 or more")
        if self.envs < 1:
            raise TaskError(f"--envs {self.envs}: expected 1 or more")
        if self.max_links < 2:
            raise TaskError(f"--max-links {self.max_links}: expected 2 or more")

    @property
    def updates(self) -> int:
        """How many there will be."""
        return self.ppo.updates(self.envs)

    @property
    def interface(self) -> Interface:
        """Of its policy."""
        obstacles = most_obstacles(self.source, GoalConfig(tasks=self.tasks))
        channels = ObservationConfig(tool=self.policy.tool_position, obstacles=obstacles)
        return Interface(self.policy.kind, self.max_links, channels)

    def as_data(self) -> dict[str, Any]:
        """Return plain data for JSON, which ``config_from`` reads."""
        data = asdict(self)
        del data["tasks"]
        return data | GoalConfig(tasks=self.tasks).as_data()


def open_run(folder: Path, config: RunConfig, *, resume: bool) -> None:
    """Make a run's folder, or make sure that the one that is there is of this run.

    A run that has no checkpoint yet has nothing to go on from, and may become another.

    Raises:
        TaskError: As ``require_open``.
        FormatError: If it cannot be written.
    """
    require_open(folder, config, resume=resume)
    path = folder / CONFIG
    if _has_learned(folder):
        return
    data = {"format": FORMAT, "morphgen": version("morphgen"), **config.as_data()}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(path, json.dumps(data, indent=2) + "\n")
    except OSError as error:
        raise FormatError(f"cannot write {path}: {error.strerror}") from error


def require_open(folder: Path, config: RunConfig, *, resume: bool) -> None:
    """Require that a run can be in a folder, before anything is written.

    Raises:
        TaskError: If it is there and is not to be resumed, or is of another run or none.
    """
    path = folder / CONFIG
    if _has_learned(folder):
        if not resume:
            raise TaskError(f"{folder} has a run: say --resume to go on, or another --out")
        _require_same(folder, read_config(folder), config)
    elif path.is_file():
        read_config(folder)
    elif folder.is_dir():
        own = (LOCK, partial_of(path).name)
        if any(each.name not in own for each in folder.iterdir()):
            raise TaskError(f"{folder} is there and is no run's folder: name another with --out")
    elif folder.exists():
        raise TaskError(f"{folder} is a file: name a folder with --out")


def _has_learned(folder: Path) -> bool:
    """Whether it is a run's folder, and has a checkpoint, or one of its robots has."""
    return (folder / CONFIG).is_file() and next(folder.rglob(CHECKPOINT), None) is not None


def read_config(folder: Path) -> RunConfig:
    """What a run was asked for.

    Raises:
        TaskError: If the folder is no run's.
    """
    path = folder / CONFIG
    try:
        data = read_json(path)
        _require_format(path, data)
    except OSError as error:
        raise TaskError(f"{folder} is no run's folder: it has no {CONFIG}") from error
    except (FormatError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise TaskError(f"{path} is not the config of a run: {error}") from error
    try:
        return config_from(data)
    except TaskError as error:
        raise TaskError(f"{path} is not the config of a run: {error}") from error


def config_from(data: object) -> RunConfig:
    """A config from what JSON keeps of it.

    Raises:
        TaskError: If something is missing, unknown, of another type or out of its range.
    """
    if not isinstance(data, Mapping):
        raise TaskError("run: expected a table")
    own = {key: value for key, value in data.items() if key not in ("format", "morphgen")}
    constants = {name: own.pop(name) for name in list(own) if name in TASKS}
    if "tasks" in own:  # a field, but in files each task has an entry of its own
        raise TaskError("run: unknown entry 'tasks'")
    require_fields(RunConfig, own, "run")
    for name in TASKS.builtin:
        if name not in constants:
            raise TaskError(f"run: no {name}")
    for name, values in constants.items():
        require_fields(TASKS[name].config_type, values, name)
    made = {"source": Source, "policy": PolicyConfig, "ppo": PPOConfig}
    for name, kind in made.items():
        if name not in own:
            raise TaskError(f"run: no {name}")
        require_fields(kind, own[name], name)
    source = _tuples(own.pop("source"))
    return RunConfig(
        Source(**source),
        PolicyConfig(**own.pop("policy")),
        PPOConfig(**own.pop("ppo")),
        tasks=task_configs(constants),
        **own,
    )


def write_checkpoint(folder: Path, config: RunConfig, learner: Mapping[str, Any]) -> None:
    """Put a checkpoint in the place of the last one.

    Raises:
        FormatError: If it cannot be written.
        TaskError: If a number is not finite; the last checkpoint stays.
    """
    path = folder / CHECKPOINT
    data = {"format": FORMAT, "run": config.as_data(), "learner": dict(learner)}
    content = packed(data, f"{path} is not replaced")
    try:
        write_atomic(path, content)
    except OSError as error:
        raise FormatError(f"cannot write {path}: {error.strerror}") from error


def read_checkpoint(path: Path) -> tuple[RunConfig, dict[str, Any]]:
    """The run of a checkpoint, and what its learner was then.

    Args:
        path: The file, or the run's folder. Nothing in it is executed.

    Raises:
        TaskError: If there is none, or it is none of a run: it is damaged, incomplete or beyond a
            limit, or a number in it is not finite.
    """
    file = path / CHECKPOINT if path.is_dir() else path
    if not file.is_file():
        raise TaskError(f"{file}: no such checkpoint")
    data, is_hashed = unpacked(file)
    if data.keys() != {"format", "run", "learner"}:
        raise TaskError(f"{file} is not a checkpoint of morphgen train")
    _require_format(file, data)
    try:
        config = config_from(data["run"])
    except TaskError as error:
        raise TaskError(f"{file}: {error}") from error
    require_learner(data["learner"], str(file))
    if not is_hashed:
        warn_of_no_hash(file)
    return config, data["learner"]


def _require_format(path: Path, data: Mapping[str, Any]) -> None:
    if data["format"] != FORMAT or isinstance(data["format"], bool):
        raise TaskError(
            f"{path} has format {data['format']!r}, and this morphgen reads {FORMAT}: it was "
            "written by another version"
        )


def _tuples(data: Mapping[str, Any]) -> dict[str, Any]:
    return {key: tuple(v) if isinstance(v, list) else v for key, v in data.items()}


def _require_same(folder: Path, stored: RunConfig, asked: RunConfig) -> None:
    theirs, ours = _flat(stored.as_data()), _flat(asked.as_data())
    for each in (theirs, ours):  # which GPU it is makes no other run
        each["device"] = each["device"].partition(":")[0]
    wrong = [
        f"{name} {_short(theirs.get(name))}, not {_short(ours[name])}"
        for name in ours
        if theirs.get(name) != ours[name]
    ]
    if wrong:
        raise TaskError(f"{folder} has another run: {'; '.join(wrong)}")


def _flat(data: Mapping[str, Any]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in data.items():
        if isinstance(value, dict):
            flat.update({f"{name}.{key}": each for key, each in value.items()})
        else:
            flat[name] = value
    return flat


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) < 60 and "\n" not in text else f"of {len(text)} letters"
