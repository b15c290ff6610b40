"""The table of pages. To add a page, write a module with ``show(session)`` and add a row."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

PAGES: Mapping[str, str] = {
    "library": "morphgen.viewer.page_library:show",
    "gallery": "morphgen.viewer.page_gallery:show",
    "population": "morphgen.viewer.page_population:show",
    "robot": "morphgen.viewer.page_robot:show",
    "compose": "morphgen.viewer.page_compose:show",
    "chosen": "morphgen.viewer.page_chosen:show",
    "compare": "morphgen.viewer.page_compare:show",
    "split": "morphgen.viewer.page_split:show",
    "play": "morphgen.viewer.page_play:show",
}
"""The function that builds each page, by the page's key in the address (``?robot=...``)."""


def load_page(name: str) -> Callable[[Any], None]:
    """Import and return the function that builds a page for a ``Session``.

    Pages are imported when they are first opened: ``play`` loads PyTorch and the simulators, which
    takes seconds and much memory.
    """
    module, _, function = PAGES[name].partition(":")
    show: Callable[[Any], None] = getattr(import_module(module), function)
    return show
