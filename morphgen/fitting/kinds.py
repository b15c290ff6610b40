"""The primitives that the fitter chooses from."""

from __future__ import annotations

from typing import Literal

Kind = Literal["box", "cylinder", "sphere"]
KINDS: tuple[Kind, ...] = ("box", "cylinder", "sphere")
