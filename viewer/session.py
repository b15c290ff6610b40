"""One browser's session: its page, what it may see, and the threads that work for it."""

from __future__ import annotations

import sys
import threading
import traceback
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

import viser

from morphgen.errors import MorphgenError
from morphgen.viewer import browser, markup
from morphgen.viewer.address import Address
from morphgen.viewer.robot_uri import FileAccess
from morphgen.viewer.workers import Workers

BUG = "something is wrong with morphgen itself; what it is stands where the viewer was started"
"""What a page says of an error that should not happen."""

Work = Callable[[], object]
T = TypeVar("T")


class Status(Protocol):
    """Where a page says what it is doing."""

    content: str


@dataclass(eq=False)
class Session:
    """One browser. What its user does is worked off in order by a thread of its own."""

    client: viser.ClientHandle
    places: FileAccess
    workers: Workers
    """Processes for what takes long."""
    address: Address
    shared: dict[str, object] = field(default_factory=dict)
    """What took long to find, for all browsers."""
    closed: threading.Event = field(default_factory=threading.Event)
    """Set when the browser is gone; long work looks at it."""
    events: ThreadPoolExecutor = field(
        default_factory=lambda: ThreadPoolExecutor(1, "morphgen-events")
    )
    background: ThreadPoolExecutor = field(
        default_factory=lambda: ThreadPoolExecutor(1, "morphgen-background")
    )
    waiting: set[str] = field(default_factory=set)
    """Keys of work that is not begun yet."""
    lock: threading.Lock = field(default_factory=threading.Lock)
    ends: list[Work] = field(default_factory=list)
    """What is to be done when the browser is gone."""
    status: Status | None = None


def post(session: Session, work: Work, key: str = "") -> None:
    """Do something after what was posted before.

    Args:
        session: The browser.
        work: What is done; a ``MorphgenError`` of it is shown to the user.
        key: If work of the same key waits already, this is left out: it will see the newest state.
    """
    _submit(session, session.events, work, key)


def later(session: Session, work: Work, key: str = "") -> None:
    """Do something that takes long, after other such work; see ``post``."""
    _submit(session, session.background, work, key)


def soon(session: Session, seconds: float, work: Work, key: str) -> None:
    """Post work after a while, once for all that is asked for until then."""
    with session.lock:
        if session.closed.is_set() or f"soon {key}" in session.waiting:
            return
        session.waiting.add(f"soon {key}")

    def begin() -> None:
        with session.lock:
            session.waiting.discard(f"soon {key}")
        post(session, work, key)

    timer = threading.Timer(seconds, begin)
    timer.daemon = True
    timer.start()


def when(handle: Any, session: Session, work: Work, key: str = "") -> None:  # noqa: ANN401
    """Post work whenever the user changes or clicks a control of viser's.

    What the server sets itself is no such change.
    """

    async def changed(event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            post(session, work, key)

    attach = getattr(handle, "on_click", None) or handle.on_update
    attach(changed)


def at_end(session: Session, work: Work) -> None:
    """Do something quick when the browser is gone; at once if it has gone already."""
    with session.lock:
        if not session.closed.is_set():
            session.ends.append(work)
            return
    work()


def close(session: Session) -> None:
    """End a session's work; what is being done ends by itself."""
    with session.lock:
        session.closed.set()
        ends, session.ends = session.ends, []
    for work in ends:
        work()
    session.events.shutdown(wait=False, cancel_futures=True)
    session.background.shutdown(wait=False, cancel_futures=True)


def in_worker(session: Session, work: Callable[..., T], *arguments: object) -> T:
    """Have a worker process do something, and wait for it.

    Raises:
        MorphgenError: What the work raises, or that the worker died.
    """
    return session.workers.result(session.workers.submit(work, *arguments))


def show_state(session: Session, title: str, **changes: str) -> None:
    """Put a page's state into its address."""
    session.address = session.address.with_state(**changes)
    browser.show_query(session.client, session.address.query, title)


def say(session: Session, text: str, share: float | None = None) -> None:
    """Show what is being done, and how much of it is; an empty text when it is done."""
    if session.status is not None and not session.closed.is_set():
        session.status.content = markup.status(text, share)


def notify(session: Session, title: str, text: str, *, error: bool = False) -> None:
    """Show a message for a while."""
    session.client.add_notification(
        title,
        text,
        auto_close_seconds=None if error else 6.0,
        color="red" if error else None,
    )


def set_value(handle: Any, value: float | str) -> None:  # noqa: ANN401
    """Change what a control of viser's shows."""
    handle.value = value


def _submit(session: Session, threads: ThreadPoolExecutor, work: Work, key: str) -> None:
    with session.lock:
        if session.closed.is_set() or (key and key in session.waiting):
            return
        session.waiting.add(key)
        future = threads.submit(_do, session, work, key)
    future.add_done_callback(lambda done: _tell_bug(done, session))


def _do(session: Session, work: Work, key: str) -> None:
    with session.lock:
        session.waiting.discard(key)
    if session.closed.is_set():
        return
    try:
        work()
    except (MorphgenError, RecursionError) as error:
        refuse(session, error)
    except Exception:
        if not session.closed.is_set():
            refuse(session, BUG)
        raise


def refuse(session: Session, error: object) -> None:
    """Say on the page why something was not done."""
    say(session, "")
    notify(session, "That did not work", session.places.told(error), error=True)


def _tell_bug(future: Future[None], session: Session) -> None:
    """Print what should not have happened; a thread's errors are else seen by nobody.

    Where the browser is gone, or the viewer stops, work fails that needs them.
    """
    if future.cancelled() or session.closed.is_set():
        return
    if (error := future.exception()) is not None:
        traceback.print_exception(error, file=sys.stderr)
