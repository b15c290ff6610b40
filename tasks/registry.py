"""Tasks and simulators by name: morphgen's own, and those of other packages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from importlib import import_module
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

from morphgen.errors import TaskError, nearest

if TYPE_CHECKING:
    from morphgen.tasks.sim.base import Simulator
    from morphgen.tasks.task import Task


class Named(Protocol):
    """An object that a registry holds."""

    @property
    def name(self) -> str:
        """Name in the registry."""


T = TypeVar("T", bound=Named)


class Registry(Generic[T]):
    """Objects by name; each is imported when it is first asked for.

    Names come from three places: the rows of morphgen itself, the entry points of installed
    packages, and ``register``. Iterating over a registry, and asking whether a name is in it,
    imports none of the objects, so a registry may serve as ``choices`` of a command line option.
    """

    def __init__(self, kind: str, group: str, builtin: Mapping[str, str]) -> None:
        """Set up.

        Args:
            kind: What the objects are called in messages.
            group: Group of the entry points of other packages.
            builtin: Names of morphgen's own objects and where they are, as ``module:attribute``.
        """
        self.kind, self.group = kind, group
        self.builtin = tuple(builtin)
        """Names of morphgen's own objects, in their order."""
        self._builtin = builtin
        self._loaded: dict[str, T] = {}

    def register(self, item: T) -> T:
        """Add an object for the rest of this process; return it.

        Worker processes import morphgen anew and know only rows and entry points.

        Raises:
            TaskError: If another object has this name.
        """
        if item.name in self and self._loaded.get(item.name) is not item:
            raise TaskError(f"{self.kind} {item.name!r}: the name is taken; choose another")
        self._loaded[item.name] = item
        return item

    def __iter__(self) -> Iterator[str]:
        """Iterate over all names: morphgen's own first."""
        return iter(dict.fromkeys((*self._builtin, *self._entry_points, *self._loaded)))

    def __contains__(self, name: object) -> bool:
        """Return whether there is an object of this name."""
        known = name in self._builtin or name in self._loaded
        return known or name in self._entry_points

    def __getitem__(self, name: str) -> T:
        """Return the object of a name.

        Raises:
            TaskError: If the name is unknown, or the object cannot be imported or has another name.
        """
        if name not in self._loaded:
            self._loaded[name] = self._load(name)
        return self._loaded[name]

    def _load(self, name: str) -> T:
        path = self._builtin.get(name) or self._entry_points.get(name)
        if path is None:
            raise TaskError(f"unknown {self.kind} {name!r}{nearest(name, self)}")
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
        return item

    @cached_property
    def _entry_points(self) -> dict[str, str]:
        """Names and places of what installed packages bring; looking them up takes 4 ms."""
        from importlib.metadata import entry_points  # takes 50 ms to import

        return {each.name: each.value for each in entry_points(group=self.group)}


TASKS: Registry[Task[Any, Any]] = Registry(
    "task",
    "morphgen.tasks",
    {"reach": "morphgen.tasks.reach.task:REACH", "push": "morphgen.tasks.push.task:PUSH"},
)
"""Tasks; see ``morphgen.tasks.task.Task``."""
SIMULATORS: Registry[Simulator] = Registry(
    "simulator",
    "morphgen.simulators",
    {
        "pybullet": "morphgen.tasks.sim.bullet:SIMULATOR",
        "mujoco": "morphgen.tasks.sim.mujoco_sim:SIMULATOR",
    },
)
"""Simulators; see ``morphgen.tasks.sim.base.Simulator``."""
