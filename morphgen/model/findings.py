"""``Finding``: a suspicious or wrong property of a robot, with its place, reason and remedy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

Severity = Literal["error", "warning", "info"]


@dataclass(frozen=True)
class Finding:
    """A property of a robot that a user should know about."""

    code: str
    """Stable identifier in kebab case, such as ``inertia-missing``."""
    severity: Severity
    """``error``, ``warning`` or ``info``; see ``morphgen.checks``."""
    where: str
    """The link, joint, frame or file concerned."""
    why: str
    """Description of the fault, with the value."""
    fix: str
    """Advice to the user."""
    repair: str = ""
    """The change that a repair made or would make; empty if no repair exists."""

    @property
    def fixable(self) -> bool:
        """Whether ``morphgen check --fix`` repairs the fault."""
        return bool(self.repair)

    def as_dict(self) -> dict[str, object]:
        """Return the finding as plain data for JSON."""
        data = asdict(self)
        del data["repair"]
        return {**data, "fixable": self.fixable}


def texts_of(path: Path, **constants: object) -> Callable[..., Finding]:
    """Return a function that makes the findings of a YAML file, which has all of their texts.

    Its arguments are the name of a row, which begins with the code, the place, and the values in
    the texts; ``repairable=False`` says that the repair of the row is not possible here. A row
    without a severity is a warning if it is repaired, else an error.
    """

    @cache
    def rows() -> Any:  # noqa: ANN401
        import yaml  # here, because most robots have no findings

        loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
        return yaml.load(path.read_text("utf-8"), Loader=loader)

    def found(row: str, where: str, *, repairable: object = True, **values: object) -> Finding:
        entry = rows()[row]
        why, fix, repair = (
            entry.get(key, "").format(**constants, **values) for key in ("why", "fix", "repair")
        )
        repair = repair if repairable else ""
        severity = entry.get("severity", "warning" if repair else "error")
        return Finding(row.split("/")[0], severity, where, why, fix, repair)

    return found
