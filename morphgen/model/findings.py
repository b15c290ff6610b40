"""What is wrong with a robot: a code, where, why, and what to do."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

Severity = Literal["error", "warning", "info"]


@dataclass(frozen=True)
class Finding:
    """One thing about a robot that a user should know."""

    code: str
    """Stable, kebab-case, such as ``inertia-missing``."""
    severity: Severity
    where: str
    """The link, joint, frame or file concerned."""
    why: str
    """What is the case, with the value."""
    fix: str
    """What to do about it."""
    repair: str = ""
    """What a repair has changed or would change; empty if there is none."""

    @property
    def fixable(self) -> bool:
        """Whether ``morphgen check --fix`` repairs it."""
        return bool(self.repair)

    def as_dict(self) -> dict[str, object]:
        """Plain data for JSON."""
        data = asdict(self)
        del data["repair"]
        return {**data, "fixable": self.fixable}
