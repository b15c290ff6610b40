"""The folder of a run: its config and its last checkpoint."""

from __future__ import annotations

import hashlib
import io
import json
import math
import pickle
import pickletools
import struct
import zipfile
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from morphgen.encoding.tokens import MAX_LINKS
from morphgen.errors import MALFORMED, MorphgenError, TaskError, nearest, shortened
from morphgen.files import write_atomic
from morphgen.formats.data_files import read_json
from morphgen.formats.files import LOCK, leftovers, writing
from morphgen.formats.records import Record, read_record
from morphgen.rl.agents import AGENTS
from morphgen.rl.config import PolicyConfig, PPOConfig, differences, policy_from, read_fields
from morphgen.rl.observation_layout import Layout
from morphgen.rl.policies import make_networks
from morphgen.rl.runs.robot_source import Source, identity, most_obstacles, source_from, tasks_of
from morphgen.tasks.actions import ActionKind
from morphgen.tasks.observation import ObservationConfig, observation_config
from morphgen.tasks.registry import DEFAULT_SIMULATOR, SIMULATORS, TASKS
from morphgen.tasks.scenes.env_specs import GoalConfig, config_fields, default_configs
from morphgen.tasks.task import TaskConfig


class _Optimiser(Record, frozen=True):
    """The state of Adam, by the number of the parameter."""

    state: dict[int, dict[str, Any]]
    param_groups: list[Any]


class _Learner(Record, frozen=True):
    """The state of a learner, as ``training.state_of`` returns it."""

    actor: dict[str, Any]
    critic: dict[str, Any]
    target_critic: dict[str, Any]
    optimiser: _Optimiser
    generators: dict[str, Any]
    batch: dict[str, Any]
    layout: Layout
    policy: dict[str, Any]
    config: dict[str, Any]
    update: int
    updates: int
    actor_lr_scale: float
    device: str


def require_learner(learner: object, where: str) -> None:
    """Require that the state of a learner is complete, and its weights have the right shapes."""
    state = read_record(learner, _Learner, f"{where}: learner", TaskError)
    try:
        PPOConfig(**read_fields(state.config, PPOConfig, "config"))
        policy = policy_from(state.policy)
        with torch.device("meta"):  # shapes alone: nothing is allocated
            actor, critic = make_networks(policy, state.layout, 0)
    except TaskError as error:
        raise TaskError(f"{where}: {error}") from error
    _require_tensors(state.actor, actor.state_dict(), f"{where}: actor")
    _require_tensors(state.critic, critic.state_dict(), f"{where}: critic")
    _require_tensors(state.target_critic, critic.state_dict(), f"{where}: target_critic")
    parameters = [*actor.parameters(), *critic.parameters()]
    for number, moments in state.optimiser.state.items():
        if not 0 <= number < len(parameters):
            raise TaskError(f"{where}: optimiser: state of an unknown parameter {number}")
        wanted = dict.fromkeys(("exp_avg", "exp_avg_sq"), parameters[number])
        own = {name: moments[name] for name in moments if name != "step"}  # a count, no moment
        _require_tensors(own, wanted, f"{where}: optimiser: parameter {number}")


def _require_tensors(
    stored: Mapping[str, Any], wanted: Mapping[str, torch.Tensor], where: str
) -> None:
    """Require tensors of the same names, shapes and types as others."""
    for name in {**wanted, **stored}:
        if name not in stored:
            raise TaskError(f"{where} has no {name}")
        if name not in wanted:
            raise TaskError(f"{where} has {shortened(repr(name))}, which its sizes do not ask for")
        tensor, expected = stored[name], wanted[name]
        if not isinstance(tensor, torch.Tensor):
            raise TaskError(f"{where}: {name} is {shortened(repr(tensor))}; expected a tensor")
        if (tensor.shape, tensor.dtype) != (expected.shape, expected.dtype):
            raise TaskError(
                f"{where}: {name} has shape {tuple(tensor.shape)} of {tensor.dtype}; expected "
                f"{tuple(expected.shape)} of {expected.dtype}"
            )


HASH = "sha256"  # key of the hash of all other content
MAX_BYTES = 512 * 2**20  # largest size of a checkpoint's file, and of its tensors together [bytes]
MAX_INDEX_BYTES = 32 * 2**20
"""Largest size of a checkpoint without the numbers of its tensors [bytes]."""
MAX_INSTRUCTIONS = 2_000_000
"""Most pickle instructions of that part; a run of 1,000 environments has about 60,000."""
MAX_VALUES = 1_000_000  # most numbers, texts, tensors and containers in a checkpoint
MAX_LEVELS = 20  # most levels of nested containers
MAX_INTEGER_BITS = 256  # most bits of an integer; the states of random generators have 128
_GLOBALS = frozenset(
    {"collections OrderedDict", "torch._utils _rebuild_tensor_v2"}
    | {f"torch {kind}Storage" for kind in ("Float", "Double", "Half", "BFloat16")}
    | {f"torch {kind}Storage" for kind in ("Long", "Int", "Short", "Char", "Byte", "Bool")}
)
"""All Python objects that a checkpoint of morphgen names. torch itself would also allow some that
allocate as much as a file asks for, such as ``bytearray``."""


_DAMAGED = (*MALFORMED, AssertionError, EOFError, pickle.UnpicklingError, zipfile.BadZipFile)
"""Exceptions that zipfile and torch 2 raise for damaged files; torch documents none of them."""


def packed(content: Mapping[str, Any], where: str) -> bytes:
    """Return the bytes of a checkpoint's file, with its hash."""
    file = io.BytesIO()
    torch.save({**content, HASH: _digest(content, where)}, file)
    return file.getvalue()


def unpacked(file: Path) -> dict[str, Any]:
    """Return the content of a checkpoint's file without its hash."""
    try:
        _require_container(file)
        # Mapped, a storage that claims more than its record has cannot reach beyond the file.
        data = torch.load(file, map_location="cpu", weights_only=True, mmap=True)
    except _DAMAGED as error:
        raise TaskError(f"{file} is not a checkpoint of morphgen train") from error
    if not isinstance(data, dict) or HASH not in data:
        raise TaskError(f"{file} is not a checkpoint of morphgen train")
    if data.pop(HASH) != _digest(data, str(file)):
        raise TaskError(
            f"{file} is damaged: its content does not have the hash that was stored with it; use "
            "another copy"
        )
    return {key: in_main_memory(value) for key, value in data.items()}


def _require_container(file: Path) -> None:
    size = file.stat().st_size
    if size > MAX_BYTES:
        raise TaskError(f"{file}: {size:,} bytes; a checkpoint has at most {MAX_BYTES:,}")
    with zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        if sum(entry.file_size for entry in entries) > size or any(
            entry.compress_type != zipfile.ZIP_STORED for entry in entries
        ):
            raise TaskError(f"{file}: compressed or overlapping entries; a checkpoint has none")
        index = [entry for entry in entries if entry.filename.endswith("/data.pkl")]
        if len(index) != 1:
            raise TaskError(f"{file} is not a checkpoint of morphgen train")
        if index[0].file_size > MAX_INDEX_BYTES:
            raise TaskError(
                f"{file}: {index[0].file_size:,} bytes beside its tensors; expected at most "
                f"{MAX_INDEX_BYTES:,}"
            )
        instructions = archive.read(index[0])
    for count, (operation, argument, _) in enumerate(pickletools.genops(instructions)):
        if count > MAX_INSTRUCTIONS:
            raise TaskError(
                f"{file}: more than {MAX_INSTRUCTIONS:,} instructions to build its content"
            )
        if "GLOBAL" in operation.name and argument not in _GLOBALS:
            raise TaskError(
                f"{file} is not a checkpoint of morphgen train: it names {str(argument)[:100]!r}, "
                "which no checkpoint does"
            )


def _digest(content: object, where: str) -> str:
    """Return the hexadecimal SHA-256 of a content; the order of keys does not matter.

    It must have plain containers, finite numbers and dense tensors only.
    """
    digest, counts = hashlib.sha256(), Counter[str]()

    def add(value: object, path: str, level: int) -> None:
        counts["values"] += 1
        if counts["values"] > MAX_VALUES:
            raise TaskError(f"{where}: more than {MAX_VALUES:,} values")
        if isinstance(value, torch.Tensor):
            counts["bytes"] += _require_tensor(value, where, path)
            if counts["bytes"] > MAX_BYTES:
                raise TaskError(f"{where}: tensors of more than {MAX_BYTES:,} bytes")
        if not isinstance(value, dict | list | tuple):
            digest.update(_leaf(value, f"{where}: {path} is"))
            return
        if level == MAX_LEVELS:
            raise TaskError(f"{where}: more than {MAX_LEVELS} levels of containers")
        digest.update(f"{'d' if isinstance(value, dict) else 'l'}{len(value)};".encode())
        for key, each in _entries(value, where):
            if isinstance(value, dict):
                digest.update(_leaf(key, f"{where}: a key is"))
            add(each, f"{path}.{str(key)[:100]}".lstrip("."), level + 1)

    add(content, "", 0)
    return digest.hexdigest()


def _leaf(value: object, what: str) -> bytes:
    """Return the bytes to hash of a tensor, text or number."""
    if isinstance(value, torch.Tensor):
        flat = value.detach().contiguous().reshape(-1).view(torch.uint8)
        return f"t{value.dtype}{tuple(value.shape)}".encode() + flat.numpy().tobytes()
    if isinstance(value, str):
        text = value.encode("utf-8", "surrogatepass")
        return f"s{len(text)};".encode() + text
    if isinstance(value, float):
        if not math.isfinite(value):
            raise TaskError(f"{what} {value}: not finite")
        return b"f" + struct.pack(">d", value)
    if not isinstance(value, int | None):
        raise TaskError(f"{what} of an unexpected type: {type(value).__name__}")
    if value is not None and value.bit_length() > MAX_INTEGER_BITS:
        raise TaskError(f"{what} a number of {value.bit_length():,} bits")
    return f"{type(value).__name__}{value};".encode()


def _entries(value: Mapping[Any, Any] | Sequence[Any], where: str) -> Iterable[tuple[Any, Any]]:
    """Return keys or indices and values of a container, sorted by key."""
    if not isinstance(value, Mapping):
        return enumerate(value)
    for key in value:
        if not isinstance(key, str | int):
            raise TaskError(f"{where}: a key of an unexpected type: {type(key).__name__}")
    return sorted(value.items(), key=lambda entry: (isinstance(entry[0], str), entry[0]))


def _require_tensor(tensor: torch.Tensor, where: str, path: str) -> int:
    """Require a dense tensor of finite numbers in main memory; return its size [bytes]."""
    plain = type(tensor) is torch.Tensor and tensor.device.type == "cpu"
    if not plain or tensor.layout != torch.strided or tensor.is_quantized:
        raise TaskError(f"{where}: {path} is not a dense tensor in main memory")
    size = tensor.numel() * tensor.element_size()
    if size > tensor.untyped_storage().nbytes():
        raise TaskError(f"{where}: {path} has {size:,} bytes, more than the file holds of it")
    if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
        lost = int((~torch.isfinite(tensor)).sum())
        raise TaskError(f"{where}: {path}: {lost} of {tensor.numel()} numbers are not finite")
    return size


def in_main_memory(value: object) -> object:
    """Return a copy of a content whose tensors are in main memory and need no file or GPU."""
    if isinstance(value, torch.Tensor):
        return value.detach().to("cpu", copy=True)
    if isinstance(value, dict):
        return {key: in_main_memory(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(in_main_memory(each) for each in value)
    return value


CONFIG, CHECKPOINT = "config.json", "checkpoint.pt"
FORMAT = 3  # version of the files' format


@dataclass(frozen=True)
class Interface:
    """Actions and observations that a policy needs; ``vars`` are arguments of ``make_batch``."""

    kind: ActionKind = "continuous"  # kind of the actions
    max_links: int | None = None
    """Links that observations and actions are padded to; None: the number of the benchmark, or the
    links of the largest robot if it has more."""
    observe: ObservationConfig = field(default_factory=ObservationConfig)
    """Channels of the observations."""


def policy_interface(policy: PolicyConfig, *, max_links: int, obstacles: int) -> Interface:
    """Return the interface of a policy."""
    observe = observation_config(policy.channels, obstacles=obstacles)
    observe = replace(observe, tool=observe.tool or policy.tool_position)
    any_size = AGENTS[policy.agent].any_size
    return Interface(policy.kind, None if any_size else max_links, observe)


@dataclass(frozen=True)
class RunConfig:
    """Configuration of a run; together with the machine it determines the weights."""

    source: Source  # robots and their tasks
    policy: PolicyConfig  # agent and networks
    ppo: PPOConfig  # hyperparameters of PPO
    seed: int = 0  # seed of weights, actions, minibatches and episodes
    sim: str = DEFAULT_SIMULATOR  # name of the simulator
    num_envs: int = 128  # number of parallel environments of all robots together
    device: str = "cpu"  # device of networks and rollouts
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
        if self.seed < 0:
            raise TaskError(f"--seed {self.seed}: expected 0 or more")
        if self.num_envs < 1:
            raise TaskError(f"--envs {self.num_envs}: expected 1 or more")
        if self.sim not in SIMULATORS:
            raise TaskError(f"unknown simulator {self.sim!r}{nearest(self.sim, SIMULATORS)}")
        if self.max_links < 2:
            raise TaskError(f"--max-links {self.max_links}: expected 2 or more")
        if self.slice_updates < 0:
            raise TaskError(f"slice_updates {self.slice_updates}: expected 0 or more")

    @property
    def num_updates(self) -> int:
        """Number of updates until the end of the run."""
        return self.ppo.num_updates(self.num_envs)

    @property
    def interface(self) -> Interface:
        """Actions and observations of the policy."""
        obstacles = most_obstacles(self.source, GoalConfig(tasks=self.tasks))
        interface = policy_interface(self.policy, max_links=self.max_links, obstacles=obstacles)
        if len(names := tasks_of(self.source)) == 1:
            return interface
        # A robot of one of several tasks has the channels of all.
        tasks = [TASKS[name] for name in names]
        observe = replace(
            interface.observe,
            targets=max(task.num_targets for task in tasks),
            objects=any(task.moves_object for task in tasks),
        )
        return replace(interface, observe=observe)

    def as_data(self) -> dict[str, Any]:
        """Return the config as JSON values, which ``config_from`` reads."""
        data = asdict(self)
        del data["tasks"]
        return data | GoalConfig(tasks=self.tasks).as_data()


def open_run(folder: Path, config: RunConfig, *, resume: bool) -> None:
    """Create the folder of a run, or check that an existing one has the same run.

    A run without a checkpoint is overwritten: it has nothing to continue from.
    """
    require_open(folder, config, resume=resume)
    if not _has_checkpoint(folder):
        data = {"format": FORMAT, "morphgen": version("morphgen"), **config.as_data()}
        _write(folder / CONFIG, (json.dumps(data, indent=2) + "\n").encode())


def _write(path: Path, content: bytes) -> None:
    """Write a file of a run in place of its last version, in a folder that is made for it."""
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, content)


def require_open(folder: Path, config: RunConfig, *, resume: bool) -> None:
    """Require that ``open_run`` can create or resume a run in a folder; write nothing."""
    path = folder / CONFIG
    if _has_checkpoint(folder):
        if not resume:
            raise TaskError(f"{folder} has a run: pass --resume to continue it, or another --out")
        require_same_config(read_config(folder), config, str(folder))
    elif path.is_file():
        read_config(folder)
    elif folder.is_dir():
        first_files = {folder / LOCK, *leftovers(path)}  # of a run that was killed at its start
        if not first_files >= set(folder.iterdir()):
            raise TaskError(
                f"{folder} exists and is not the folder of a run: name another with --out"
            )
    elif folder.exists():
        raise TaskError(f"{folder} is a file: name a folder with --out")


def _has_checkpoint(folder: Path) -> bool:
    """Return whether a run, or its part for any single robot, has a checkpoint."""
    return (folder / CONFIG).is_file() and next(folder.rglob(CHECKPOINT), None) is not None


def read_config(folder: Path) -> RunConfig:
    """Return the config of a run."""
    path = folder / CONFIG
    if not path.is_file():
        raise TaskError(f"{folder} is not the folder of a run: it has no {CONFIG}")
    try:
        data = read_json(path)
        _require_format(path, data)
        return config_from(data)
    except (MorphgenError, KeyError, TypeError) as error:
        raise TaskError(f"{path} is not the config of a run: {error}") from error


def config_from(data: object) -> RunConfig:
    """Return the run config of a JSON file or a checkpoint."""
    data = read_record(data, dict[str, Any], "run", TaskError)
    entries = {k: v for k, v in data.items() if k not in ("format", "morphgen")}
    if (geometry := entries.pop("geometry", "primitive")) != "primitive":  # runs of 0.3 have it
        raise TaskError(f"run: geometry {geometry!r}: robots collide as primitives now")
    tasks = {name: entries.pop(name) for name in list(entries) if name in TASKS}
    if "tasks" in entries:  # a field, but in files each task has an entry of its own
        raise TaskError("run: unknown key 'tasks'")
    configs = tuple(_task_config(name, values) for name, values in tasks.items())
    for name, values in entries.items():
        if isinstance(values, Mapping) and name not in RunConfig.__dataclass_fields__:
            raise TaskError(
                f"run: unknown task {shortened(repr(name))}; run the script that registers it, or "
                "install its package"
            )
    for name in ("source", "policy", "ppo"):
        if name not in entries:
            raise TaskError(f"run: missing key {name!r}")
    nested = {name: entries.pop(name) for name in ("source", "policy", "ppo")}
    values = read_fields(entries, RunConfig, "run", given=nested)
    source = source_from(nested["source"], "run: source")
    for name in tasks_of(source):  # not of all tasks: some may be newer than the run
        if name not in tasks:
            raise TaskError(f"run: missing key {name!r}")
    return RunConfig(
        source,
        policy_from(nested["policy"], "run: policy"),
        PPOConfig(**read_fields(nested["ppo"], PPOConfig, "run: ppo")),
        tasks=configs,
        **values,
    )


def _task_config(name: str, constants: object) -> TaskConfig:
    where, kind = f"run: {name}", TASKS[name].config_type
    fields = config_fields(name, read_record(constants, dict[str, Any], where, TaskError))
    config: TaskConfig = kind(**read_fields(fields, kind, where))
    return config


def write_checkpoint(folder: Path, config: RunConfig, learner: Mapping[str, Any]) -> None:
    """Write the checkpoint of a run, in place of its last one."""
    path = folder / CHECKPOINT
    data = {"format": FORMAT, "run": config.as_data(), "learner": dict(learner)}
    _write(path, packed(data, f"{path} is not replaced"))


def read_checkpoint(path: Path) -> tuple[RunConfig, dict[str, Any]]:
    """Return the run config and the learner's state of a checkpoint; nothing in it is executed."""
    file = path / CHECKPOINT if path.is_dir() else path
    if not file.is_file():
        raise TaskError(f"{file}: no such checkpoint")
    data = unpacked(file)
    if data.keys() != {"format", "run", "learner"}:
        raise TaskError(f"{file} is not a checkpoint of morphgen train")
    _require_format(file, data)
    try:
        config = config_from(data["run"])
    except TaskError as error:
        raise TaskError(f"{file}: {error}") from error
    require_learner(data["learner"], str(file))
    return config, data["learner"]


def _require_format(path: Path, data: Mapping[str, Any]) -> None:
    found = data["format"]
    if type(found) is not int or found != FORMAT:
        raise TaskError(
            f"{path} has format {shortened(repr(found))}; expected {FORMAT}: it was written by "
            "another version of morphgen"
        )


def require_same_config(stored: RunConfig, config: RunConfig, where: str) -> None:
    """Require that a stored run has this config."""
    if wrong := differences(_comparable(stored), _comparable(config), ", not "):
        raise TaskError(f"{where} has another run: {wrong}")


def _comparable(config: RunConfig) -> dict[str, Any]:
    """Return the entries of a config; a run may continue on another GPU."""
    device = config.device.partition(":")[0]
    return config.as_data() | {"source": identity(config.source), "device": device}
