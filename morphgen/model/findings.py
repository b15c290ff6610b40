"""``Finding``: a suspicious or wrong property of a robot, with its place, reason and remedy."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

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


def left_out(code: str, where: str, what: str) -> Finding:
    """Return a finding about content that a robot cannot hold, and that nobody has to change."""
    why, repair = f"a robot has no place for {what}", f"left out: {what}"
    return Finding(code, "info", where, why, "none is needed", repair)
