"""Progress of long work: functions report how far they are, and callers that show it listen.

The listener is in a context variable. A new thread or process has none: its reports go nowhere.
"""

from __future__ import annotations

import logging
import signal
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass
from threading import current_thread, main_thread
from typing import Protocol, runtime_checkable


class Progress(Protocol):
    """Function that receives the number of finished items, and of all items if it is known."""

    def __call__(self, done: float, total: int | None, /) -> None:
        """Receive the numbers; a fraction counts what is done of an item."""


@runtime_checkable
class StagedProgress(Progress, Protocol):
    """A listener that shows stages of work by their titles, and notes."""

    def stage(self, title: str, unit: str = "") -> AbstractContextManager[None]:
        """Show the reports of a block as a stage, which counts units; by default the listener's."""

    def note(self, text: str) -> None:
        """Show a line."""


_listener: ContextVar[Progress | None] = ContextVar("listener", default=None)

STOP_SIGNALS = (signal.SIGTERM, *((signal.SIGHUP,) if hasattr(signal, "SIGHUP") else ()))
"""Signals that stop a command as Ctrl-C does: of a service manager, of a closed terminal."""
interrupts: list[int] = []
"""Signals that stopped the command which is running. Python loses the ``KeyboardInterrupt`` that
Ctrl-C raises while it calls a ``__del__`` or the callback of a weak reference, as each import does,
or imports an extension module; then the next progress raises it again."""


def raise_if_interrupted() -> None:
    """Raise ``KeyboardInterrupt`` if Ctrl-C was pressed, once, in the thread that runs commands."""
    if interrupts and current_thread() is main_thread():
        interrupts.clear()
        raise KeyboardInterrupt


@contextmanager
def show_progress(listener: Progress | None) -> Iterator[None]:
    """Send the reports of this block, or of a decorated function, to a listener; None silences it.

    Examples:
        >>> with show_progress(lambda done, total: print(done, "of", total)):
        ...     report(1, 2)
        1 of 2
    """
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


def report(done: float, total: int | None) -> None:
    """Report the number of finished items, and of all."""
    if listener := _listener.get():
        listener(done, total)


@contextmanager
def own_progress() -> Iterator[Progress]:
    """Yield the function to report with; the functions that are called in this block are silent.

    Else the parts of an item, such as the links of a robot, would be shown as items.
    """
    listener = _listener.get()
    with show_progress(None):
        yield listener or _ignore


@dataclass(frozen=True)
class _Part:
    """Counts items as a part of the work that another listener shows; see ``part_of``."""

    listener: Progress | None
    total: int | None
    first: int

    def __call__(self, done: float, _: int | None) -> None:
        if self.listener is not None:
            self.listener(self.first + done, self.total)

    def stage(self, title: str, unit: str = "") -> AbstractContextManager[None]:
        """Show the reports of a block as a stage, which counts other items."""
        if isinstance(self.listener, StagedProgress):
            return self.listener.stage(title, unit)
        return show_progress(self.listener)

    def note(self, text: str) -> None:
        """Show a line."""
        with show_progress(self.listener):
            note(text)


def part_of(total: int | None, first: int = 0) -> AbstractContextManager[None]:
    """Count the items of a block from ``first`` on, of a total of all blocks."""
    return show_progress(_Part(_listener.get(), total, first))


def stage(title: str, unit: str = "") -> AbstractContextManager[None]:
    """Give the work of a block a title, and a word for its items, for listeners of stages."""
    listener = _listener.get()
    return listener.stage(title, unit) if isinstance(listener, StagedProgress) else nullcontext()


def note(text: str) -> None:
    """Show a line that a user should see: by a listener of stages, else as a logged warning."""
    listener = _listener.get()
    if isinstance(listener, StagedProgress):
        listener.note(text)
    else:
        logging.getLogger("morphgen").warning(text)


def _ignore(done: float, total: int | None) -> None:
    pass
