"""Addresses of pages: the query of a URL, such as ``?gallery=robots/arm3&sort=reach``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, get_args
from urllib.parse import parse_qsl, quote, urlencode

from morphgen.errors import MorphgenError, nearest

Page = Literal["library", "gallery", "robot", "compose", "compare", "split", "play"]
PAGES: tuple[Page, ...] = get_args(Page)
LONGEST = 8000
"""Characters of a query."""
MOST_DIGITS = 15
"""Of a number in an address; browsers have no larger whole numbers."""
ROBOT: Page = "robot"
"""Key of a page, and on the page ``play`` of the robots that play."""


class AddressError(MorphgenError):
    """An address that leads to no page."""


@dataclass(frozen=True)
class Address:
    """A page, what it shows, and how."""

    page: Page
    of: tuple[str, ...] = ("",)
    """What is shown: a folder, a robot, a split's name, words; several to compare."""
    state: Mapping[str, str] = field(default_factory=dict)
    """Sort order, filter, joint positions ...; what is at its default is left out."""
    robots: tuple[str, ...] = ()
    """Those that play; no other page has any."""

    @property
    def subject(self) -> str:
        """The first thing that is shown."""
        return self.of[0]

    @property
    def query(self) -> str:
        """The text after the host, from the question mark on."""
        robots = ((ROBOT, robot) for robot in self.robots)
        pairs = [*((self.page, of) for of in self.of), *robots, *self.state.items()]
        return "?" + urlencode(pairs, quote_via=quote, safe="/=:,@+")

    def with_state(self, **changes: str) -> Address:
        """The same page with other state; an empty value removes a key."""
        state = {key: value for key, value in {**self.state, **changes}.items() if value}
        return replace(self, state=state)


def whole_number(text: str, default: int) -> int:
    """A number of an address, 0 or more; the default if it is none that a page can hold."""
    is_number = text.isascii() and text.isdigit() and len(text) <= MOST_DIGITS
    return int(text) if is_number else default


def parse_address(query: str) -> Address | None:
    """Read the query of a URL.

    Args:
        query: With or without its question mark.

    Returns:
        None if the query is empty: the page that the viewer was started for.

    Raises:
        AddressError: If it names no page, or two different ones.
    """
    if len(query) > LONGEST:
        raise AddressError(f"the address has {len(query)} characters; at most {LONGEST} are read")
    pairs = parse_qsl(query.removeprefix("?").replace("+", "%2B"), keep_blank_values=True)
    if not pairs:
        return None
    named = {key for key, _ in pairs}
    robots = tuple(value for key, value in pairs if key == ROBOT) if "play" in named else ()
    pages = [page for page in PAGES if page in named and not (page == ROBOT and robots)]
    if not pages:
        raise AddressError(f"address {query!r:.100} names no page{nearest(pairs[0][0], PAGES)}")
    if len(pages) > 1:
        raise AddressError(f"address {query!r:.100} names two pages: {' and '.join(pages)}")
    of = tuple(value for key, value in pairs if key == pages[0])
    state = {key: value for key, value in pairs if key not in PAGES}
    return Address(pages[0], of, state, robots)
