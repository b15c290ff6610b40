"""Read the URL, the theme and the width of the window from a browser that connects."""

from __future__ import annotations

import json
import uuid
from dataclasses import dataclass

import msgspec
import viser

from morphgen.viewer.address import AddressError
from morphgen.viewer.viser_internals import run_javascript

DEFAULT_WIDTH = 1400
"""Width of a window that a browser does not tell [pixels]."""
URL_TIMEOUT = 20.0
"""Time in which a browser has to report its URL [s]."""

_READ_LOCATION = """
const name = Object.keys(localStorage).find((key) => key.endsWith(%s));
const state = {query: window.location.search, dark: window.morphgen.theme(),
  width: window.innerWidth};
if (name) localStorage.setItem(name, JSON.stringify(state));
"""


@dataclass(frozen=True)
class Location:
    """The URL and the theme that a browser reports."""

    query: str = ""
    """Query of its URL with the question mark; empty if there is none."""
    dark: bool = False
    """Whether pages are dark: as the address says (``theme=dark``) or said before, else as the
    browser prefers."""
    width: int = DEFAULT_WIDTH
    """Width of its window [pixels]."""


def read_location(client: viser.ClientHandle) -> Location:
    """Return the URL and the theme of a browser.

    viser does not tell the server the URL. So a line of JavaScript copies it into the browser's
    local storage, under a key that no other tab uses, and viser reads it from there.

    Raises:
        AddressError: If the browser sends something else.
        RuntimeError: If the browser has disconnected, or has no local storage.
        TimeoutError: If it does not answer.
    """
    key = f"morphgen-{uuid.uuid4().hex}"
    client.local_storage.set_item(key, "")
    run_javascript(client, _READ_LOCATION % json.dumps(key))
    try:
        text = client.local_storage.get_item(key, timeout=URL_TIMEOUT) or ""
    finally:
        client.local_storage.remove_item(key)
    try:
        return msgspec.json.decode(text, type=Location) if text else Location()
    except msgspec.MsgspecError as error:
        raise AddressError(f"the browser sent no valid location: {error}") from error
