"""Gymnasium's ids of the tasks, registered without that ``import morphgen`` loads Gymnasium.

Gymnasium finds no plugins of its own accord: somebody has to register what is to be made. This is
done at once if Gymnasium is imported already, and otherwise as soon as it is.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType

from morphgen.tasks.registry import TASKS

_LIBRARY = "gymnasium"


def register() -> None:
    """Tell Gymnasium of the tasks, now or once it is imported; a second time does nothing."""
    if any(isinstance(finder, _Awaited) for finder in sys.meta_path):
        return
    if _LIBRARY in sys.modules:
        _register()
    else:
        sys.meta_path.insert(0, _Awaited())


def _register() -> None:
    from gymnasium.envs.registration import register, registry

    for task in TASKS:
        name = f"morphgen/{task.capitalize()}-v0"
        if name not in registry:
            register(
                id=name,
                entry_point="morphgen.tasks.gym_env:TaskEnv",
                vector_entry_point="morphgen.tasks.vector:task_vector",
                kwargs={"task": task},
            )


class _Awaited(MetaPathFinder):
    """Registers right after Gymnasium is imported, and is gone.

    Until then it stays, for who only asks whether Gymnasium is there has not imported it.
    """

    def __init__(self) -> None:
        """Begin to wait."""
        self._asking = False

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """What would be found anyway, with the registration at the end of its loading."""
        if fullname != _LIBRARY or self._asking:
            return None
        self._asking = True
        try:
            spec = find_spec(fullname)
        finally:
            self._asking = False
        if spec is None or spec.loader is None:
            return spec
        load = spec.loader.exec_module

        def load_and_register(module: ModuleType) -> None:
            load(module)
            if self in sys.meta_path:
                sys.meta_path.remove(self)
            _register()

        spec.loader.exec_module = load_and_register  # type: ignore[method-assign]
        return spec
