"""A session: a page in a browser, its URL, and the threads that work for it."""

from __future__ import annotations

import math
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import viser

from morphgen.errors import MorphgenError
from morphgen.progress import show_progress
from morphgen.viewer import markup
from morphgen.viewer.app.address import (
    Address,
    AddressError,
    parse_count,
    require_few_chosen,
)
from morphgen.viewer.app.frame import bar_html, call, shown_address, tray_html
from morphgen.viewer.app.viser_internals import run_javascript
from morphgen.viewer.app.workers import SharedResults, Workers
from morphgen.viewer.robot_uri import FileAccess

DEFAULT_WIDTH = 1400  # width of a window that a browser does not tell [pixels]
ADDRESS_DELAY = 0.5  # delay of URL updates after a move [s]; Safari allows 100 updates in 30 s

BUG = "this is a bug of morphgen; its traceback is in the terminal where the viewer was started"
"""Text that a page shows for an unexpected error."""
Work = Callable[[], object]
T = TypeVar("T")


class SessionClosed(RuntimeError):  # noqa: N818
    """The browser has left the session's page, or has disconnected."""


@dataclass(eq=False)
class Session:
    """A page in a browser. A thread handles the user's actions one after the other.

    The next page in the same browser has a session of its own, see ``next_session``. It shares the
    fields of the browser; those that are not arguments begin anew with each page.
    """

    browser: viser.ClientHandle
    files: FileAccess
    workers: Workers  # processes for slow work, shared by all browsers
    simulator: Workers  # the process of all rollouts
    address: Address  # address of the page with its state, as the URL shows it
    dark: bool = False  # whether the page is dark
    width: int = DEFAULT_WIDTH  # width of the browser's window when the page was opened [pixels]
    chosen: tuple[str, ...] = ()  # URIs of the robots in the tray
    visit: int = 0  # number of the page since the browser has loaded the client
    cache: SharedResults = field(default_factory=SharedResults)  # results for all browsers
    events: ThreadPoolExecutor = field(
        default_factory=partial(ThreadPoolExecutor, 1, "morphgen-events")
    )
    """Thread of all pages in this browser, so that a page's work ends before the next begins."""
    closed: threading.Event = field(init=False, default_factory=threading.Event)
    """Set when the browser has left the page or disconnected; long work has to check it."""
    background: ThreadPoolExecutor = field(
        init=False, default_factory=partial(ThreadPoolExecutor, 1, "morphgen-background")
    )
    pending: set[str] = field(init=False, default_factory=set)  # keys of queued work
    lock: threading.Lock = field(init=False, default_factory=threading.Lock)
    close_callbacks: list[Work] = field(init=False, default_factory=list)
    status: viser.GuiHtmlHandle | None = field(init=False, default=None)
    """Line of the page that shows the current activity."""
    title: str = field(init=False, default="morphgen")  # title of the browser's tab
    tabs: str = field(init=False, default="")
    """Titles of the open tabs, separated by commas; those that are open at first are left out."""
    on_choice: Work | None = field(init=False, default=None)  # called after a choice
    values: dict[str, tuple[Callable[[], str], Callable[[str], object] | None]] = field(
        init=False, default_factory=dict
    )
    """The page's state by its keys in the address; see ``keep``."""

    @property
    def client(self) -> viser.ClientHandle:
        """The browser, for work on the page."""
        if self.closed.is_set():
            raise SessionClosed("the browser has left this page")
        return self.browser

    def next_session(self, visit: int, *, dark: bool, width: int) -> Session:
        """Close the session; return one for another page in the same browser."""
        self.close()
        return replace(self, visit=visit, dark=dark, width=width)

    def enqueue(self, work: Work, key: str = "", *, even_closed: bool = False) -> None:
        """Run work on the session's event thread, after everything that was enqueued before."""
        self._submit(self.events, work, key, even_closed=even_closed)

    def run_in_background(self, work: Work, key: str = "") -> None:
        """Run slow work on the session's background thread; see ``enqueue``."""
        self._submit(self.background, work, key)

    @contextmanager
    def activity(self, text: str) -> Iterator[None]:
        """Show what a block does; with a ``{}`` for the number of items, show its progress."""

        def show(done: float, total: int | None) -> None:
            if total:
                self.set_status(text.format(total), done / total)

        try:
            if "{}" in text:
                with show_progress(show):
                    yield
            else:
                self.set_status(text)
                yield
        finally:
            self.set_status("")

    def cached(self, key: str, make: Callable[[], T], text: str) -> T:
        """Return the result of slow work, which is done once for all browsers; see ``activity``."""

        def made() -> T:
            with self.activity(text):
                return make()

        return self.cache.get(key, made)

    def call_later(self, seconds: float, work: Work, key: str) -> None:
        """Enqueue work after a delay; calls of the same key until then are merged into one."""
        timer_key = f"timer {key}"
        with self.lock:
            if self.closed.is_set() or timer_key in self.pending:
                return
            self.pending.add(timer_key)

        def fire() -> None:
            with self.lock:
                self.pending.discard(timer_key)
            self.enqueue(work, key)

        timer = threading.Timer(seconds, fire)
        timer.daemon = True
        timer.start()

    def on_change(self, handle: Any, work: Work, key: str = "") -> None:  # noqa: ANN401
        """Enqueue work whenever the user, not the server, changes or clicks a control."""

        async def changed(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:
                self.enqueue(work, key)

        attach = getattr(handle, "on_click", None) or handle.on_update
        attach(changed)

    def on_press(self, button: Any, work: Work) -> None:  # noqa: ANN401
        """Run slow work in the background whenever the user presses a button."""
        self.on_change(button, lambda: self.run_in_background(work))

    def on_close(self, work: Work) -> None:
        """Call quick work when the browser leaves the page; immediately if it already has."""
        with self.lock:
            if not self.closed.is_set():
                self.close_callbacks.append(work)
                return
        work()

    def close(self) -> None:
        """Drop the page's queued work; running work ends by itself."""
        with self.lock:
            self.closed.set()
            callbacks, self.close_callbacks = self.close_callbacks, []
        for work in callbacks:
            work()
        self.background.shutdown(wait=False, cancel_futures=True)

    def disconnect(self) -> None:
        """Close the session of a browser that has disconnected."""
        self.close()
        self.events.shutdown(wait=False, cancel_futures=True)

    def open_panel(
        self, width: float, header: str, status: str = "", *, left: bool = False
    ) -> None:
        """Open the page's panel with a header as HTML and the status line; width in pixels."""
        gui = self.client.gui
        gui.set_panel_label("morphgen")
        (gui.main_panel.dock_left if left else gui.main_panel.dock_right)()
        gui.main_panel.set_width(width)
        gui.add_html(header)
        self.status = gui.add_html(markup.status(status))
        if status:  # the page says what it does, so there is something to see
            self.reveal()

    def reveal(self) -> None:
        """Remove the cover that hides the page until its content is there."""
        self.run_script(call("reveal"))

    def run_script(self, source: str) -> None:
        """Run JavaScript in the browser."""
        run_javascript(self.client, source)

    def set_status(self, text: str, fraction: float | None = None) -> None:
        """Show the current activity and its progress in [0, 1]; an empty text clears the line."""
        if self.status is not None and not self.closed.is_set():
            self.status.content = markup.status(text, fraction)

    def notify(self, title: str, text: str, *, error: bool = False) -> None:
        """Show a notification; it closes after six seconds unless it is an error."""
        self.client.add_notification(
            title, text, auto_close_seconds=None if error else 6.0, color="red" if error else None
        )

    def send_file(self, name: str, content: bytes) -> None:
        """Let the browser save a file."""
        self.client.send_file_download(name, content, save_immediately=True)

    def report_error(self, error: object) -> None:
        """Show on the page why an action failed."""
        self.set_status("")
        self.notify("That did not work", self.files.redact(error), error=True)

    def show_address(self, title: str) -> None:
        """Show the address in the browser's URL and top bar, and a title in its tab."""
        self.title = title
        address = shown_address(self.address, self.chosen).with_state(tab=self.tabs)
        bar = bar_html(self.address.with_state(tab=self.tabs), dark=self.dark)
        self.run_script(
            call("address", self.visit, address.query, title) + call("bar", bar, self.dark)
        )

    def keep(
        self,
        key: str,
        write: Callable[[], str] | None = None,
        apply: Callable[[str], object] | None = None,
    ) -> None:
        """Keep a value of the page in its address under a key: ``write`` returns it as text.

        An empty text is the default, which is left out. ``apply`` takes over the value of an
        address, unless the page has read it before.
        """
        self.values[key] = write or (lambda: self.address.state.get(key, "")), apply

    def state(self) -> dict[str, str]:
        """Return the page's state as its controls have it, by key; defaults are empty."""
        return {key: write() for key, (write, _) in self.values.items()}

    def apply_state(self) -> None:
        """Take over the address's state in the order of ``keep``; note what cannot be."""
        asked = self.address.state  # a new value may show the state, which changes the address
        for key, (_, apply) in list(self.values.items()):
            if asked.get(key) and apply is not None:
                try:
                    apply(asked[key])
                except AddressError as error:
                    self.notify("Not all of the address", self.files.redact(error), error=True)

    def show_state(self) -> None:
        """Show the page's state in the address, without keys that the page does not have."""
        state = self.state()
        known = {key: value for key, value in self.address.state.items() if key in state}
        self.address = replace(self.address, state=known).with_state(**state)
        self.show_address(self.title)

    def show_state_later(self) -> None:
        """Show the page's state soon; many changes in a short time are shown once."""
        self.call_later(ADDRESS_DELAY, self.show_state, "address")

    def keep_tabs(self, titles: str) -> None:
        """Keep the open tabs in the address; see ``tabs``."""
        self.tabs = titles
        self.show_address(self.title)

    def open_address(self, address: Address, *, instead: bool = False) -> None:
        """Open another page, as a link would; ``instead``: Back will not lead to this one."""
        self.run_script(call("visit", address.query, instead))

    def choose(self, uris: Sequence[str]) -> None:
        """Put robots into the tray in place of the previous ones."""
        chosen = tuple(dict.fromkeys(uris))
        try:
            require_few_chosen(chosen)
            self.chosen = chosen
        finally:
            self.show_tray()
        self.show_address(self.title)
        if self.on_choice is not None:
            self.on_choice()

    def show_tray(self) -> None:
        """Show the chosen robots in the browser's tray and check boxes."""
        self.run_script(call("tray", tray_html(self.chosen), self.chosen))

    def _submit(
        self, threads: ThreadPoolExecutor, work: Work, key: str, *, even_closed: bool = False
    ) -> None:
        with self.lock:
            if self.closed.is_set() or (key and key in self.pending):
                return
            self.pending.add(key)
            threads.submit(self._run, work, key, even_closed=even_closed)

    def _run(self, work: Work, key: str, *, even_closed: bool) -> None:
        """Run queued work; show its error on the page, and print an unexpected one."""
        with self.lock:
            self.pending.discard(key)
        if self.closed.is_set() and not even_closed:
            return
        try:
            work()
        except (MorphgenError, RecursionError) as error:
            self.report_error(error)
        except Exception:
            if not self.closed.is_set():  # else expected: the work needed the browser
                traceback.print_exc()
                self.report_error(BUG)


def set_value(handle: Any, value: object) -> None:  # noqa: ANN401
    """Set the value of a control, which viser's types declare as read-only."""
    handle.value = value


def bind(session: Session, key: str, control: Any, keys: Sequence[str] = ()) -> None:  # noqa: ANN401
    """Keep the value of a control in the page's address; its present value is the default.

    A value of the address that it cannot have is left out with a note. ``keys`` are the texts of a
    dropdown's options, by default these, or that of a check box that is on.
    """
    default, keys = control.value, tuple(keys)

    def write() -> str:
        value = control.value
        if value == default:
            return ""
        if isinstance(control, viser.GuiDropdownHandle):
            return keys[control.options.index(value)] if keys else str(value)
        if isinstance(control, viser.GuiCheckboxHandle):
            return keys[0]
        return f"{value:g}" if isinstance(value, float) else str(value)

    def apply(text: str) -> None:
        if (value := parse_value(control, text, keys)) is None:
            valid = "a number"
            if isinstance(control, viser.GuiDropdownHandle):
                valid = ", ".join(keys or control.options)
            raise AddressError(f"{key}={text[:40]} was left out; expected {valid[:200]}")
        set_value(control, value)

    session.keep(key, write, apply)


def parse_value(control: Any, text: str, keys: Sequence[str] = ()) -> Any:  # noqa: ANN401
    """Return the value of a control that a text of an address stands for; None for none."""
    match control:
        case viser.GuiDropdownHandle():
            keys = keys or control.options
            return control.options[keys.index(text)] if text in keys else None
        case viser.GuiCheckboxHandle():
            return text in keys
        case viser.GuiNumberHandle():
            count = parse_count(text, -1)
            return None if count < 0 else count
        case viser.GuiSliderHandle():
            try:
                number = float(text)
            except ValueError:
                return None
            low, high = control.min, control.max
            return None if math.isnan(number) else type(low)(min(max(number, low), high))
    return text
