"""Tasks and simulators by name: morphgen's own, and those of other packages.

It also has the names of observation channels and goals, for it loads neither torch nor NumPy.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cached_property
from importlib import import_module
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

from morphgen.errors import MissingDependencyError, TaskError, nearest

if TYPE_CHECKING:
    from morphgen.tasks.sim.base import Simulator
    from morphgen.tasks.task import Task

KINEMATIC_CHANNELS = ("lag", "joint", "poses", "jacobian", "dls", "ik", "clearance", "contact")
"""Channels of ``kinematic_channels``, in the order in which networks concatenate them."""
CHANNELS = (
    *KINEMATIC_CHANNELS,
    *("velocity", "previous_action", "tree", "points", "no_state", "pace"),
)
"""Channels of observations that can be asked for by name; ``no_state`` hides what it names, and
``pace`` changes others."""
GOAL_KINDS = ("position", "pose")
"""Kinds of goals of reach: the tool's position, or its position and orientation."""


class Named(Protocol):
    """An object with the name under which a registry holds it."""

    @property
    def name(self) -> str:
        """Name in the registry."""


T = TypeVar("T", bound=Named)
_RESERVED = frozenset(
    {"tokens", "links", "actions", "velocity", "previous_action", "tool", "points", "obstacles"}
)
"""Entries of observations that are no fields of tasks."""


class Registry(Generic[T]):
    """Objects by name; each is imported when it is first requested.

    Names come from morphgen's own table, the entry points of installed packages, and ``register``.
    Iterating and testing for a name import none of the objects, so a registry can serve as the
    ``choices`` of a command line option.
    """

    def __init__(
        self,
        kind: str,
        group: str,
        builtin: Mapping[str, str | T],
        require: Callable[[T], None] = lambda item: None,
    ) -> None:
        """Create a registry.

        Args:
            kind: Noun for the objects in messages.
            group: Entry point group of other packages.
            builtin: Morphgen's own objects by name, or their locations as ``module:attribute``.
            require: Raises a ``TaskError`` for an object of others that lacks something.
        """
        self.kind, self.group, self._require = kind, group, require
        self.builtin = tuple(builtin)
        """Names of morphgen's own objects, in their order."""
        self._builtin = builtin
        self._loaded: dict[str, T] = {}

    def register(self, item: T) -> T:
        """Add an object for the rest of this process; return it.

        Worker processes (``--jobs``) do not know it: they import morphgen anew, and know only its
        own table and entry points. Use an entry point where several processes are needed.

        Raises:
            TaskError: If another object has this name, or it is no such object, or a class, or
                lacks something.
        """
        if isinstance(item, type) or not isinstance(getattr(item, "name", None), str):
            raise TaskError(f"{self.kind} {item!r}: expected an instance with a name")
        if item.name in self and self._loaded.get(item.name) is not item:
            raise TaskError(f"{self.kind} {item.name!r}: the name is taken; choose another")
        self._require(item)
        self._loaded[item.name] = item
        return item

    def __iter__(self) -> Iterator[str]:
        """Iterate over all names: morphgen's own first."""
        return iter(dict.fromkeys((*self._builtin, *self._entry_points, *self._loaded)))

    def __contains__(self, name: object) -> bool:
        """Return whether there is an object of this name."""
        return name in self._loaded or (isinstance(name, str) and self.is_installed(name))

    def is_installed(self, name: str) -> bool:
        """Return whether every process knows the name, not only this one by ``register``."""
        return name in self._builtin or name in self._entry_points

    def __getitem__(self, name: str) -> T:
        """Return the object of a name.

        Raises:
            TaskError: If the name is unknown, or the object cannot be imported, has another name or
                lacks something.
        """
        if name not in self._loaded:
            self._loaded[name] = self._load(name)
        return self._loaded[name]

    def _load(self, name: str) -> T:
        """Import the object of a name from its module; see ``__getitem__``."""
        path = self._builtin.get(name) or self._entry_points.get(name)
        if path is None:
            raise TaskError(f"unknown {self.kind} {name!r}{nearest(name, self)}")
        if not isinstance(path, str):
            return path
        module, _, attribute = path.partition(":")
        try:
            item: T = getattr(import_module(module), attribute)
        except (ImportError, AttributeError) as error:
            if name in self._builtin:
                raise
            raise TaskError(
                f"{self.kind} {name!r}: entry point {path!r} cannot be imported: {error}"
            ) from error
        if getattr(item, "name", None) != name:
            raise TaskError(
                f"{self.kind} {name!r}: entry point {path!r} is called "
                f"{getattr(item, 'name', None)!r}; expected the name of the entry point"
            )
        if name not in self._builtin:
            self._require(item)
        return item

    @cached_property
    def _entry_points(self) -> dict[str, str]:
        """Locations by name of the objects of installed packages; the lookup takes 4 ms."""
        from importlib.metadata import entry_points  # takes 50 ms to import

        return {entry.name: entry.value for entry in entry_points(group=self.group)}


def _require_task(task: Task[Any, Any]) -> None:
    """Require a task's name, constants and fields."""
    # They import numpy, which names alone do not need.
    from morphgen.tasks.task import STANDARD_FIELDS, TaskConfig

    where = f"task {task.name!r}"
    if not re.fullmatch("[a-z][a-z0-9]*", task.name):
        raise TaskError(f"{where}: expected a name of lower-case letters and digits")
    for name in ("config_type", "goal_set_type", "goal_format", "cache_folder", "fields"):
        if not hasattr(task, name):
            raise TaskError(f"{where}: the class attribute {name!r} is missing")
    if not issubclass(task.config_type, TaskConfig):
        raise TaskError(f"{where}: config_type is {task.config_type}; expected a TaskConfig")
    named = getattr(task.config_type, "task", None)
    if named != task.name:
        raise TaskError(f"{where}: config_type.task is {named!r}; expected {task.name!r}")
    standard = {field.name: field for field in STANDARD_FIELDS}
    for field in task.fields:
        if field.name in _RESERVED or standard.get(field.name, field) != field:
            raise TaskError(
                f"{where}: observation field {field.name!r}: the name is taken; choose another"
            )


TASKS: Registry[Task[Any, Any]] = Registry(
    "task",
    "morphgen.tasks",
    {
        "reach": "morphgen.tasks.reach.task:REACH",
        "push": "morphgen.tasks.push.task:PUSH",
        "drawer": "morphgen.tasks.articulated.task:DRAWER",
        "door": "morphgen.tasks.articulated.task:DOOR",
        "dial": "morphgen.tasks.articulated.task:DIAL",
    },
    _require_task,
)
"""Tasks; see ``morphgen.tasks.task.Task``."""
SIMULATORS: Registry[Simulator] = Registry(
    "simulator",
    "morphgen.simulators",
    {
        "pybullet": "morphgen.tasks.sim.bullet:SIMULATOR",
        "mujoco": "morphgen.tasks.sim.mujoco_sim:SIMULATOR",
        "warp": "morphgen.tasks.sim.warp_sim:SIMULATOR",
        "kinematic": "morphgen.tasks.sim.kinematic:SIMULATOR",
    },
)
"""Simulators; see ``morphgen.tasks.sim.base.Simulator``."""
DEFAULT_SIMULATOR = "mujoco"
"""Simulator to use unless one is named. Every installation has it, so that a command gives the same
episodes everywhere."""


def installed_simulators(condition: Callable[[Simulator], bool] = lambda _: True) -> list[str]:
    """Return the names of the simulators that are installed and meet a condition."""
    names = []
    for name in SIMULATORS:
        with suppress(MissingDependencyError):
            if condition(SIMULATORS[name]):
                names.append(name)
    return names


def require_device(name: str) -> None:
    """Require a device that torch can use: ``cpu``, ``cuda``, or such as ``cuda:1``."""
    import torch  # takes a second to load

    kind, _, number = name.partition(":")
    if name != "cpu" and (kind != "cuda" or not (number or "0").isdecimal()):
        raise TaskError(f"unknown device {name!r}; valid: cpu, cuda, or such as cuda:1")
    if kind == "cuda" and not torch.cuda.is_available():
        raise TaskError(f"device {name!r}: this machine has no CUDA device")
    if kind == "cuda" and int(number or 0) >= torch.cuda.device_count():
        raise TaskError(f"device {name!r}: there are {torch.cuda.device_count()} CUDA devices")


def batch_device(sim: str, learner_device: str) -> str:
    """Return the device for the batch of a learner: the learner's if the simulator can use it."""
    kind, _, _ = learner_device.partition(":")
    return learner_device if kind in SIMULATORS[sim].devices else "cpu"


def require_simulator_device(sim: str, device: str) -> None:
    """Require a device that this machine has and on which a simulator's tensors can be."""
    require_device(device)
    kind, _, _ = device.partition(":")
    valid = SIMULATORS[sim].devices
    if kind not in valid:
        others = installed_simulators(lambda simulator: kind in simulator.devices)
        raise TaskError(
            f"simulator {sim!r} on device {device!r}; expected device {' or '.join(valid)}, or "
            f"simulator {' or '.join(others)}"
        )


def evaluation_simulator(name: str) -> str:
    """Return the simulator that judges policies trained in a simulator.

    It is the same one, or MuJoCo if that one simulates no contacts or needs a GPU.
    """
    simulator = SIMULATORS[name]
    return name if simulator.simulates_contacts and "cpu" in simulator.devices else "mujoco"


def register_gym_envs() -> None:
    """Register ``morphgen/<Task>-v0`` of every task with Gymnasium; repeating it does nothing."""
    from gymnasium.envs.registration import register, registry

    for task in TASKS:
        env_id = f"morphgen/{task.capitalize()}-v0"
        if env_id not in registry:
            register(
                id=env_id,
                entry_point="morphgen.tasks.gym.env:TaskEnv",
                vector_entry_point="morphgen.tasks.gym.vector:task_vector",
                kwargs={"task": task},
            )
