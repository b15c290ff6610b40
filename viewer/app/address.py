"""Addresses of pages: the query of a URL, such as ``?gallery=robots/arm3&sort=reach``."""

from __future__ import annotations

import base64
import binascii
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from urllib.parse import parse_qsl, quote, urlencode

from morphgen.errors import MorphgenError, nearest

PAGES: Mapping[str, str] = {
    "library": "morphgen.viewer.pages.gallery:show_library",
    "gallery": "morphgen.viewer.pages.gallery:show",
    "population": "morphgen.viewer.pages.population:show",
    "robot": "morphgen.viewer.pages.robot:show",
    "compose": "morphgen.viewer.pages.compose:show",
    "chosen": "morphgen.viewer.pages.split:show_chosen",
    "compare": "morphgen.viewer.pages.population:show_compared",
    "split": "morphgen.viewer.pages.split:show",
    "play": "morphgen.viewer.pages.play:show",
    "demos": "morphgen.viewer.pages.play:show_demos",
}
"""The function that builds each page for a ``Session``, by the page's key in the address."""


MAX_QUERY = 8000  # longest query [characters]
MAX_DIGITS = 15  # longest number in an address [digits]; larger integers are not exact in a browser
MAX_PACKED = 4000  # longest packed text [characters]; some mail programs cut longer addresses
MAX_UNPACKED = 200_000  # longest unpacked text [bytes]: a short address cannot fill the memory
ROBOT = "robot"  # page of a robot; on the page `play`, each robot of the rollout
CHOSEN = "chosen"  # page of chosen robots; on other pages, each robot in the tray
MAX_COMPARED = 4  # most robots that are compared at once
MAX_PLAYED = 9  # most robots that do a task at once
MAX_CHOSEN = 3000  # most characters that the URIs of all chosen robots take in an address


class AddressError(MorphgenError):
    """An address does not lead to a page."""


@dataclass(frozen=True)
class Address:
    """A page with its subjects and its state."""

    page: str  # key of the page in `PAGES`
    subjects: tuple[str, ...] = ("",)
    """Folder, robot URI or name of a split that the page shows; several on page ``compare``."""
    state: Mapping[str, str] = field(default_factory=dict)
    """Sort order, filter, joint positions, ... by key; default values are left out."""
    robots: tuple[str, ...] = ()  # URIs of the robots of a rollout (page `play` only)
    chosen: tuple[str, ...] = ()  # URIs of the robots in the tray, subjects of page `chosen`

    @property
    def subject(self) -> str:
        """The first subject."""
        return self.subjects[0]

    @property
    def query(self) -> str:
        """The query of the URL, with its question mark."""
        robots = ((ROBOT, robot) for robot in self.robots)
        subjects = ((self.page, subject) for subject in self.subjects)
        chosen = ((CHOSEN, uri) for uri in self.chosen)
        return "?" + _encode([*subjects, *robots, *self.state.items(), *chosen])

    def with_state(self, **changes: str) -> Address:
        """Return the same page with other state; an empty value removes a key."""
        state = {key: value for key, value in {**self.state, **changes}.items() if value}
        return replace(self, state=state)


def parse_address(query: str) -> Address | None:
    """Parse the query of a URL; None if it is empty, which stands for the viewer's start page."""
    if len(query) > MAX_QUERY:
        raise AddressError(f"the address has {len(query)} characters; at most {MAX_QUERY} are read")
    # "+" stays a plus sign: addresses write spaces as %20.
    pairs = parse_qsl(query.removeprefix("?").replace("+", "%2B"), keep_blank_values=True)
    if not pairs:
        return None
    keys = {key for key, _ in pairs}
    robots = tuple(value for key, value in pairs if key == ROBOT) if "play" in keys else ()
    pages = [page for page in PAGES if page in keys and not (page == ROBOT and robots)]
    chosen: tuple[str, ...] = ()
    if CHOSEN in pages and len(pages) > 1:
        pages.remove(CHOSEN)
        chosen = tuple(value for key, value in pairs if key == CHOSEN and value)
    if not pages:
        raise AddressError(f"address {query!r:.100} names no page{nearest(pairs[0][0], PAGES)}")
    if len(pages) > 1:
        raise AddressError(f"address {query!r:.100} names two pages: {' and '.join(pages)}")
    subjects = tuple(value for key, value in pairs if key == pages[0])
    state = {key: value for key, value in pairs if key not in PAGES}
    return Address(pages[0], subjects, state, robots, chosen)


def _encode(pairs: Iterable[tuple[str, str]]) -> str:
    return urlencode(list(pairs), quote_via=quote, safe="/=:,@+")


def require_few_chosen(chosen: Sequence[str]) -> None:
    """Require that the tray's robots fit into every page's address."""
    n = len(_encode((CHOSEN, uri) for uri in chosen))
    if n > MAX_CHOSEN:
        raise AddressError(
            f"{len(chosen)} chosen robots take {n} characters of the address; expected at most "
            f"{MAX_CHOSEN}: choose fewer, or select them on the population page"
        )


def parse_count(text: str, default: int) -> int:
    """Return a nonnegative integer of an address; the default if it is invalid or too long."""
    is_number = text.isascii() and text.isdigit() and len(text) <= MAX_DIGITS
    return int(text) if is_number else default


def pack_text(text: str) -> str:
    """Compress a text into characters that an address keeps unescaped (base64url)."""
    content = base64.urlsafe_b64encode(zlib.compress(text.encode(), 9)).decode().rstrip("=")
    if len(content) > MAX_PACKED:
        raise AddressError(
            f"the text is too long for the page's address ({len(content)} characters packed, at "
            f"most {MAX_PACKED}): keep it in a file"
        )
    return content


def unpack_text(content: str) -> str:
    """Return the text that ``pack_text`` has packed."""
    if len(content) > MAX_PACKED:
        raise AddressError(
            f"the address has a text of {len(content)} characters; at most {MAX_PACKED} are read"
        )
    try:
        data = base64.b64decode(content + "=" * (-len(content) % 4), altchars=b"-_", validate=True)
        decompressor = zlib.decompressobj()
        text = decompressor.decompress(data, MAX_UNPACKED)
        if not decompressor.eof:
            raise AddressError(
                f"the address has an incomplete text, or one of more than {MAX_UNPACKED} bytes"
            )
        return text.decode()
    except (binascii.Error, zlib.error, ValueError) as error:
        raise AddressError(f"the address has no readable text: {error}") from error
