"""The frame of all pages, which stays while pages are rebuilt: top bar, tray, and cover.

viser's page gets the content of ``frame.html``: the bar with links to the pages, the tray of chosen
robots, and the cover that hides viser's empty page until a page has its content. Its script asks
the server for another page instead of loading it, so the browser keeps viser's client.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, lru_cache
from html import escape
from importlib.resources import files

from websockets.http11 import Response

from morphgen.viewer.app.address import CHOSEN, MAX_COMPARED, MAX_PLAYED, Address
from morphgen.viewer.robot_uri import DEFAULT_WORDS, uri_name

_BEFORE = b'<div id="root">'


def frame_page(response: Response) -> None:
    """Put the frame into a response with viser's page."""
    is_packed = response.headers.get("Content-Encoding") == "gzip"
    response.body = _framed(bytes(response.body), is_packed=is_packed)
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))


@cache
def _frame() -> bytes:
    """Return the frame with the bar of the first page, which is there before a page is built."""
    text = files("morphgen.viewer").joinpath("frame.html").read_text(encoding="utf-8")
    links = bar_html(Address("library"), dark=False)
    return text.replace('"pages">', f'"pages">{links}', 1).encode()


@lru_cache(maxsize=2)
def _framed(body: bytes, *, is_packed: bool) -> bytes:
    """Return the page with the frame; cached, because packing takes a tenth of a second."""
    page = gzip.decompress(body) if is_packed else body
    if page.count(_BEFORE) != 1:
        raise RuntimeError("this version of viser has another page; see viewer/app/frame.py")
    framed = page.replace(_BEFORE, _frame() + _BEFORE)
    return gzip.compress(framed) if is_packed else framed


def call(function: str, *arguments: object) -> str:
    """Return JavaScript that calls a function of the frame with plain data."""
    return f"window.morphgen?.{function}({', '.join(map(json.dumps, arguments))});"


_LINKS = {
    "Library": Address("library"),
    "Gallery": Address("gallery"),
    "Population": Address("population"),
    "Compose": Address("compose", (DEFAULT_WORDS,)),
    "Compare": Address("compare"),
    "Splits": Address("split"),
    "Playback": Address("play", ("reach",)),
    "Demonstrations": Address("demos"),
}
"""The links of the top bar by label."""


def bar_html(address: Address, *, dark: bool) -> str:
    """Return the content of the top bar."""
    links = "".join(
        f'<a href="{escape(target.query)}"'
        f"{' class=current' if target.page == address.page else ''}>{label}</a>"
        for label, target in _LINKS.items()
    )
    theme = "light" if dark else "dark"
    switch = escape(address.with_state(theme=theme).query)
    return f'{links}<a class="theme" href="{switch}">{theme}</a>'


def tray_html(chosen: Sequence[str]) -> str:
    """Return the content of the tray: how many robots are chosen, and what to do with them."""
    if not chosen:
        return ""
    n, robots = len(chosen), tuple(chosen)

    def link(label: str, address: Address, low: int, high: int) -> str:
        if low <= n <= high:
            return f'<a href="{escape(address.query)}">{label}</a>'
        return f'<span class="off" title="takes {low} to {high} robots">{label}</span>'

    names = escape(", ".join(map(uri_name, robots)))
    return (
        f'<b title="{names}">{n} chosen</b>'
        + link("compare", Address("compare", robots), 2, MAX_COMPARED)
        + link("play", Address("play", ("reach",), robots=robots), 1, MAX_PLAYED)
        + link("split", Address(CHOSEN, robots), 2, n)
        + '<a data-do="download" title="bundles as a zip">download</a>'
        + '<a data-do="clear" title="choose no robot">clear</a>'
    )


def shown_address(address: Address, chosen: Sequence[str]) -> Address:
    """Return a page's address with the robots that are chosen on it."""
    if address.page == CHOSEN:
        return replace(address, subjects=tuple(chosen) or ("",))
    return replace(address, chosen=tuple(chosen))
