"""Diagnosis of an installation: versions, optional packages, files and caches."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from importlib import import_module
from typing import Any, Literal

from morphgen.errors import MissingDependencyError, MorphgenError, one_line
from morphgen.extras import missing_extra

SECTIONS: Mapping[str, tuple[str, str]] = {
    "system": ("morphgen.doctor.system", "machine"),
    "packages": ("morphgen.doctor.system", "packages"),
    "files": ("morphgen.doctor.files", "files"),
}
"""Module and function of each section; the function yields the results."""

Status = Literal["ok", "absent", "warning", "error"]


@dataclass(frozen=True)
class Entry:
    """One result."""

    name: str  # name of what was examined, such as `goal sets`
    status: Status
    """``absent`` for an optional package, ``error`` if morphgen does not work as documented."""
    text: str  # result, and what to do about it if it is not `ok`; one line
    data: Mapping[str, object] = field(default_factory=dict)  # values of the text, for programs

    def as_dict(self) -> dict[str, Any]:
        """Return the result as JSON values."""
        return asdict(self)


def attempt(name: str, examine: Callable[[], Entry]) -> Entry:
    """Return the result of a function; whatever it raises, the result says why."""
    try:
        return examine()
    except Exception as error:
        return failure(name, error)


def failure(name: str, error: Exception) -> Entry:
    """Return the result of an examination that raised an error."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, KeyboardInterrupt):
            raise cause
        cause = cause.__cause__ or cause.__context__
    text = missing_extra(error)
    if text is not None:
        return Entry(name, "absent", text)
    if isinstance(error, ModuleNotFoundError):
        text = f"the package {error.name} is not installed; install morphgen again"
    elif isinstance(error, MorphgenError):
        text = str(error)
    else:
        text = f"{type(error).__name__}: {error}"
    status: Status = "absent" if isinstance(error, MissingDependencyError) else "error"
    return Entry(name, status, one_line(text))


def diagnose() -> Iterator[tuple[str, Entry]]:
    """Examine the installation; yield each result with its section as soon as it is known.

    Nothing is written but temporary files and, if fits are missing, the user's cache. An error of a
    broken package is a result, too.
    """
    for section, (module, function) in SECTIONS.items():
        try:
            for entry in getattr(import_module(module), function)():
                yield section, entry
        except Exception as error:  # whatever a broken package raises
            yield section, failure(section, error)
