"""Progress of commands on stderr: a line that is redrawn on a terminal, several elsewhere."""

from __future__ import annotations

import argparse
import math
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from typing import TYPE_CHECKING, TypeVar

from morphgen.errors import shortened
from morphgen.progress import Progress, raise_if_interrupted, show_progress
from morphgen.tasks.registry import TASKS

if TYPE_CHECKING:
    from morphgen.rl.ppo import UpdateMetrics
    from morphgen.rl.runs.training import ShowMetrics, Subrun

T = TypeVar("T")

FIRST_LINE = 2.0  # time after which a line says what is done, where there is no terminal [s]
LINE_INTERVAL = 10.0  # time between two further lines [s]
REDRAW_INTERVAL = 1.0  # time after which a line appears on a terminal, and is drawn again [s]
ERASE = "\r\x1b[K"  # what removes it


@contextmanager
def bar(
    args: argparse.Namespace, title: str, unit: str = "robot", total: int | None = None
) -> Iterator[None]:
    """Show the progress of this block in a bar, and that of its stages in others; see ``_bar``."""
    with closing(_StagedBar(args, title, unit, total)) as shown, show_progress(shown):
        yield


class _StagedBar:
    """A bar that gives its place to the bars of stages."""

    _show: Progress | None = None

    def __init__(
        self, args: argparse.Namespace | None, title: str, unit: str, total: int | None = None
    ) -> None:
        self._bar = args, title, unit, total
        self._shown = ExitStack()
        self._show = self._open()

    def _open(self) -> Progress:
        self.close()
        return self._shown.enter_context(_bar(*self._bar))

    def __call__(self, done: float, total: int | None) -> None:
        """Set the bar, which is shown again if something else has taken its place."""
        self._show = self._show or self._open()
        self._show(done, total)

    @contextmanager
    def stage(self, title: str, unit: str = "") -> Iterator[None]:
        """Show the reports of a block in a bar of its own."""
        self.close()
        args, _, own_unit, _ = self._bar
        with _bar(args, title, unit or own_unit) as show, show_progress(show):
            yield
        self._show = self._open()

    def note(self, text: str) -> None:
        """Print a line above the bar."""
        note(text)

    def close(self) -> None:
        """Remove what is shown."""
        self._shown.close()
        self._show = None


@contextmanager
def _bar(
    args: argparse.Namespace | None, title: str, unit: str = "robot", total: int | None = None
) -> Iterator[Progress]:
    """Yield the function that counts what is done, which is shown if the work takes long.

    On a terminal a line is redrawn, and removed at the end; elsewhere there is one now and then.
    Nothing is shown with ``--json``.
    """
    raise_if_interrupted()
    if getattr(args, "json", False):
        yield lambda done, total: raise_if_interrupted()
        return
    on_terminal, begin = sys.stderr.isatty(), time.monotonic()
    first, interval = (REDRAW_INTERVAL,) * 2 if on_terminal else (FIRST_LINE, LINE_INTERVAL)
    counted, due, lock = 0.0, begin + first, threading.Lock()

    def tell() -> None:
        nonlocal due
        with lock:
            if (now := time.monotonic()) < due:
                return
            due = now + interval
        if total and counted >= total:
            count = f": all {total} {unit}s, finishing"
        else:
            of = "" if total is None else f" of {total}"
            count = f": {counted:.0f}{of} {unit}s" if counted or total else ""
        left = (now - begin) * (total / counted - 1) if total and counted else 0
        text = f"{title}{count}, {now - begin:.0f} s" + (f", {left:.0f} s left" if left else "")
        if on_terminal:
            _draw(text)
        else:
            note(text)

    def show(done: float, new_total: int | None) -> None:
        nonlocal counted, total
        raise_if_interrupted()
        counted, total = done, total if new_total is None else new_total
        tell()

    try:
        with _repeated(tell):
            yield show
    finally:
        _erase()


@contextmanager
def _repeated(show: Callable[[], object]) -> Iterator[None]:
    """Call a function again and again, so that a clock runs while one item takes long."""
    finished = threading.Event()

    def repeat() -> None:
        while not finished.wait(REDRAW_INTERVAL):
            show()

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        finished.set()
        thread.join()


def track(
    items: Iterable[T], args: argparse.Namespace, title: str, unit: str, total: int
) -> Iterator[T]:
    """Yield the items, and show in a bar how many of them are finished."""
    with _bar(args, title, unit, total) as show:
        for done, item in enumerate(items, 1):
            yield item
            show(done, None)


def note(text: str) -> None:
    """Print a line that is no part of the command's result, which alone goes to stdout."""
    _erase()
    print(text, file=sys.stderr, flush=True)


def print_line(line: str) -> None:
    """Print a line above the one that is redrawn."""
    _erase()
    print(line, flush=True)


_is_drawn = False  # whether a line stands on the terminal


def _draw(text: str) -> None:
    global _is_drawn
    width = shutil.get_terminal_size().columns - 1  # a full line would begin another one
    print(f"{ERASE}{shortened(text, width)}", end="", file=sys.stderr, flush=True)
    _is_drawn = True


def _erase() -> None:
    global _is_drawn
    if _is_drawn:
        print(ERASE, end="", file=sys.stderr, flush=True)
    _is_drawn = False


def status(args: argparse.Namespace | None, text: str) -> AbstractContextManager[object]:
    """Show what the command does and for how long, until the work is done."""
    return _bar(args, text)


@contextmanager
def training_progress(how_to_resume: str | None = None) -> Iterator[TrainingProgress]:
    """Yield a display of trainings and evaluations; Ctrl-C says how to resume them."""
    display = TrainingProgress(None, "preparing", "goal set")
    try:
        with show_progress(display):
            yield display
    except KeyboardInterrupt as interrupt:
        if how_to_resume is None:
            raise
        text = f"it continues from its last checkpoint, if there is one, {how_to_resume}"
        raise KeyboardInterrupt(text) from interrupt
    finally:
        display.close()


class TrainingProgress(_StagedBar):
    """Shows goal sets, trainings and evaluations, one after the other."""

    def training(self, subrun: Subrun) -> ShowMetrics:
        """Begin with a subrun; return the function that prints its updates at intervals."""
        from morphgen.rl.runs.robot_source import RecordedSource, SplitSource, tasks_of

        raise_if_interrupted()
        self.close()
        source = subrun.config.source
        name = source.name
        if isinstance(source, SplitSource) and source.member:
            name = source.member
        # The score of a step of push is 1 where it succeeds, else 0: its mean says nothing.
        is_relative = any(TASKS[task].relative_to_random for task in tasks_of(source))
        metric = "score" if is_relative else "reward"
        last, episodes, diverged = -math.inf, 0, 0

        def update(report: UpdateMetrics, total: int) -> None:
            nonlocal last, episodes, diverged
            episodes, diverged = episodes + report.episodes, diverged + report.unstable
            if time.monotonic() < last + LINE_INTERVAL and report.update < total:
                return
            last = time.monotonic()
            success = f"{report.success:.0%}" if report.episodes else "unknown"
            facts = f"{metric} {getattr(report, metric):.2f}, success {success}"
            if isinstance(source, RecordedSource):  # nothing acts
                facts = f"loss {report.policy_loss:.3f}"
            if diverged:
                facts += f", simulation diverged in {diverged} of {episodes} episodes"
            # Every update has equally many transitions.
            seconds_left = (total - report.update) * report.transitions / report.update
            seconds_left /= report.steps_per_second
            note(
                f"{name}: update {report.update} of {total}, {report.transitions:,} steps, "
                f"{facts}, {report.steps_per_second:,.0f} steps/s, {seconds_left / 60:.1f} min left"
            )

        return update
