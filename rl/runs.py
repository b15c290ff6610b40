"""The folder of a run: its config and its last checkpoint."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from morphgen.benchmark.token_layout import MAX_LINKS
from morphgen.errors import FormatError, TaskError, nearest
from morphgen.formats.data_files import read_json
from morphgen.formats.files import LOCK, partial_path, write_atomic
from morphgen.rl.agents import AGENTS
from morphgen.rl.aliases import current_learner, current_run
from morphgen.rl.checkpoint_content import require_learner
from morphgen.rl.checkpoint_file import packed, unpacked, warn_of_no_hash
from morphgen.rl.config import PolicyConfig, PPOConfig, policy_from, read_fields, shown
from morphgen.rl.robot_source import RobotSource, identity, most_obstacles, tasks_of
from morphgen.tasks.actions import ActionKind
from morphgen.tasks.collision_geometry import require_geometry
from morphgen.tasks.env_specs import GoalConfig, config_fields, default_configs, task_configs
from morphgen.tasks.observation import ObservationConfig, observation_config
from morphgen.tasks.registry import DEFAULT_SIMULATOR, SIMULATORS, TASKS
from morphgen.tasks.sim.base import CollisionGeometry
from morphgen.tasks.task import TaskConfig

CONFIG, CHECKPOINT = "config.json", "checkpoint.pt"
FORMAT = 3
"""Version of the files' format. Format 2 has other names of keys; see ``aliases``."""
READABLE = (2, FORMAT)
"""Versions that can be read. Format 1 had other defaults of the networks' logit scale."""


@dataclass(frozen=True)
class Interface:
    """Actions and observations that a policy needs from its environments."""

    kind: ActionKind = "continuous"
    """Kind of the actions."""
    max_links: int | None = None
    """Links that observations and actions are padded to; None: the number of the benchmark, or the
    links of the largest robot if it has more."""
    channels: ObservationConfig = field(default_factory=ObservationConfig)
    """Channels of the observations."""


def policy_interface(policy: PolicyConfig, *, max_links: int, obstacles: int) -> Interface:
    """Return the interface of a policy.

    Args:
        policy: Agent and networks.
        max_links: Links that its observations are padded to, if it needs a fixed number.
        obstacles: Minimum number of obstacle rows.
    """
    channels = observation_config(policy.channels, obstacles=obstacles)
    channels = replace(channels, tool=channels.tool or policy.tool_position)
    any_size = AGENTS[policy.agent].any_size
    return Interface(policy.kind, None if any_size else max_links, channels)


@dataclass(frozen=True)
class RunConfig:
    """Configuration of a run; together with the machine it determines the weights."""

    source: RobotSource
    """Robots and their tasks."""
    policy: PolicyConfig
    """Agent and networks."""
    ppo: PPOConfig
    """Hyperparameters of PPO."""
    seed: int = 0
    """Seed of weights, actions, minibatches and episodes."""
    sim: str = DEFAULT_SIMULATOR
    """Name of the simulator."""
    geometry: CollisionGeometry = "primitive"
    """Collision shapes of the robots in training; evaluations have all of them."""
    num_envs: int = 128
    """Number of parallel environments of all robots together."""
    device: str = "cpu"
    """Device of networks and rollouts."""
    initial_checkpoint: str = ""
    """Path of a checkpoint with the initial networks, relative to the folder of the run; empty for
    random initial weights."""
    full_budget: bool = False
    """For an agent of single robots on a split: train each robot with all environments and
    timesteps (as in the paper), instead of an equal share of them."""
    max_links: int = MAX_LINKS
    """Number of links that observations and actions are padded to; no robot may have more."""
    slice_updates: int = 0
    """Updates after which the next of the drawn robots take the places of the last ones, if there
    are more robots than environments; 0 if all robots have environments at all times."""
    tasks: tuple[TaskConfig, ...] = field(default_factory=default_configs)
    """Configs of the tasks; a file has an entry for each, under the name of the task."""

    @property
    def evaluation_tasks(self) -> tuple[TaskConfig, ...]:
        """Configs of the tasks in evaluations: with the default number of goals per robot."""
        return tuple(replace(task, num_goals=type(task)().num_goals) for task in self.tasks)

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            TaskError: If a number is out of its range, or the simulator is unknown.
        """
        if self.seed < 0:
            raise TaskError(f"--seed {self.seed}: expected 0 or more")
        if self.num_envs < 1:
            raise TaskError(f"--envs {self.num_envs}: expected 1 or more")
        if self.sim not in SIMULATORS:
            raise TaskError(f"unknown simulator {self.sim!r}{nearest(self.sim, SIMULATORS)}")
        require_geometry(self.geometry)
        if self.max_links < 2:
            raise TaskError(f"--max-links {self.max_links}: expected 2 or more")
        if self.slice_updates < 0:
            raise TaskError(f"--slice-updates {self.slice_updates}: expected 0 or more")

    @property
    def num_updates(self) -> int:
        """Number of updates until the end of the run."""
        return self.ppo.num_updates(self.num_envs)

    @property
    def interface(self) -> Interface:
        """Actions and observations of the policy."""
        obstacles = most_obstacles(self.source, GoalConfig(tasks=self.tasks))
        return policy_interface(self.policy, max_links=self.max_links, obstacles=obstacles)

    def as_data(self) -> dict[str, Any]:
        """Return the config as JSON values, which ``config_from`` reads."""
        data = asdict(self)
        del data["tasks"]
        return data | GoalConfig(tasks=self.tasks).as_data()


def open_run(folder: Path, config: RunConfig, *, resume: bool) -> None:
    """Create the folder of a run, or check that an existing one has the same run.

    A run without a checkpoint is overwritten: it has nothing to continue from.

    Raises:
        TaskError: If the folder has another run, or a run that is not to be resumed.
        FormatError: If the config cannot be written.
    """
    require_open(folder, config, resume=resume)
    path = folder / CONFIG
    if _has_checkpoint(folder):
        return
    data = {"format": FORMAT, "morphgen": version("morphgen"), **config.as_data()}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(path, json.dumps(data, indent=2) + "\n")
    except OSError as error:
        raise FormatError(f"cannot write {path}: {error.strerror}") from error


def require_open(folder: Path, config: RunConfig, *, resume: bool) -> None:
    """Require that ``open_run`` can create or resume a run in a folder; write nothing.

    Raises:
        TaskError: If the folder has a run that is not to be resumed, another run, or other files.
    """
    path = folder / CONFIG
    if _has_checkpoint(folder):
        if not resume:
            raise TaskError(f"{folder} has a run: pass --resume to continue it, or another --out")
        require_same_run(folder, config)
    elif path.is_file():
        read_config(folder)
    elif folder.is_dir():
        leftovers = (LOCK, partial_path(path).name)  # of a run that was killed at its start
        if any(entry.name not in leftovers for entry in folder.iterdir()):
            raise TaskError(
                f"{folder} exists and is not the folder of a run: name another with --out"
            )
    elif folder.exists():
        raise TaskError(f"{folder} is a file: name a folder with --out")


def _has_checkpoint(folder: Path) -> bool:
    """Return whether a run, or its part for any single robot, has a checkpoint."""
    return (folder / CONFIG).is_file() and next(folder.rglob(CHECKPOINT), None) is not None


def read_config(folder: Path) -> RunConfig:
    """Return the config of a run.

    Raises:
        TaskError: If the folder has no config, or an invalid one.
    """
    path = folder / CONFIG
    try:
        data = read_json(path)
        _require_format(path, data)
    except OSError as error:
        raise TaskError(f"{folder} is not the folder of a run: it has no {CONFIG}") from error
    except (FormatError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise TaskError(f"{path} is not the config of a run: {error}") from error
    try:
        return config_from(data)
    except TaskError as error:
        raise TaskError(f"{path} is not the config of a run: {error}") from error


def config_from(data: object) -> RunConfig:
    """Return the run config of a JSON file or a checkpoint; earlier names of keys are read, too.

    Raises:
        TaskError: If an entry is missing, unknown, of another type or out of its range.
    """
    if not isinstance(data, Mapping):
        raise TaskError(f"run: invalid value {shown(data)}; expected keys and values")
    entries = {k: v for k, v in current_run(data).items() if k not in ("format", "morphgen")}
    tasks = {name: entries.pop(name) for name in list(entries) if name in TASKS}
    if "tasks" in entries:  # a field, but in files each task has an entry of its own
        raise TaskError("run: unknown key 'tasks'")
    for name, values in tasks.items():
        if not isinstance(values, Mapping):
            raise TaskError(f"run: {name}: invalid value {shown(values)}; expected keys and values")
        read_fields(config_fields(name, values), TASKS[name].config_type, f"run: {name}")
    for name, values in entries.items():
        if isinstance(values, Mapping) and name not in RunConfig.__dataclass_fields__:
            raise TaskError(
                f"run: unknown task {shown(name)}; run the script that registers it, or install "
                "its package"
            )
    nested = {name: entries.pop(name) for name in ("source", "policy", "ppo") if name in entries}
    values = read_fields(entries, RunConfig, "run", given=nested)
    source = RobotSource(**read_fields(nested["source"], RobotSource, "run: source"))
    for name in tasks_of(source):  # not of all tasks: some may be newer than the run
        if name not in tasks:
            raise TaskError(f"run: missing key {name!r}")
    return RunConfig(
        source,
        policy_from(nested["policy"], "run: policy"),
        PPOConfig(**read_fields(nested["ppo"], PPOConfig, "run: ppo")),
        tasks=task_configs(tasks),
        **values,
    )


def write_checkpoint(folder: Path, config: RunConfig, learner: Mapping[str, Any]) -> None:
    """Write the checkpoint of a run, in place of its last one.

    Raises:
        FormatError: If the file cannot be written.
        TaskError: If a number is not finite; the last checkpoint is kept.
    """
    path = folder / CHECKPOINT
    data = {"format": FORMAT, "run": config.as_data(), "learner": dict(learner)}
    content = packed(data, f"{path} is not replaced")
    try:
        write_atomic(path, content)
    except OSError as error:
        raise FormatError(f"cannot write {path}: {error.strerror}") from error


def read_checkpoint(path: Path) -> tuple[RunConfig, dict[str, Any]]:
    """Return the run config and the learner's state of a checkpoint; nothing in it is executed.

    Args:
        path: The checkpoint, or the folder of its run.

    Raises:
        TaskError: If there is no checkpoint, or it is damaged, incomplete or beyond a limit, or a
            number in it is not finite.
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
    learner = current_learner(data["learner"])
    require_learner(learner, str(file))
    if not is_hashed:
        warn_of_no_hash(file)
    return config, learner


def _require_format(path: Path, data: Mapping[str, Any]) -> None:
    found = data["format"]
    if type(found) is not int or found not in READABLE:
        raise TaskError(
            f"{path} has format {shown(found)}; expected {' or '.join(map(str, READABLE))}: it "
            "was written by another version of morphgen"
        )


def require_same_run(folder: Path, config: RunConfig) -> None:
    """Require that a folder has a run with this config.

    Raises:
        TaskError: If the run in the folder has another config; the message lists the differences.
    """
    theirs, ours = _flat(read_config(folder)), _flat(config)
    differences = [
        f"{name} {_short(theirs.get(name))}, not {_short(value)}"
        for name, value in ours.items()
        if theirs.get(name) != value
    ]
    if differences:
        raise TaskError(f"{folder} has another run: {'; '.join(differences)}")


def _flat(config: RunConfig) -> dict[str, Any]:
    """Return the entries of a config by dotted name; a run may continue on another GPU."""
    device = config.device.partition(":")[0]
    return _entries(config.as_data() | {"source": identity(config.source), "device": device})


def _entries(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the entries of nested dictionaries by dotted name."""
    flat: dict[str, Any] = {}
    for name, value in data.items():
        nested = isinstance(value, dict) and value
        flat |= _entries(value, f"{prefix}{name}.") if nested else {f"{prefix}{name}": value}
    return flat


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) < 60 and "\n" not in text else f"of {len(text)} letters"
