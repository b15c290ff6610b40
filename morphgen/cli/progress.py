"""Progress of commands on stderr: bars on a terminal, a few lines elsewhere."""

from __future__ import annotations

import argparse
import math
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import TYPE_CHECKING, NoReturn, TypeVar

from tqdm import tqdm

from morphgen.progress import Progress, raise_if_interrupted, show_progress
from morphgen.tasks.registry import TASKS

if TYPE_CHECKING:
    from morphgen.rl.distributed import UpdateMetrics
    from morphgen.rl.runs.training import ShowMetrics, Subrun

T = TypeVar("T")

LINE_INTERVAL = 10.0
"""Time between two lines about an evaluation where there is no terminal [s]."""
REDRAW_INTERVAL = 1.0
"""Time after which a bar appears, and between its updates if nothing else happens [s]."""
GOAL_LINE_INTERVAL = 5.0
"""Time between two lines about goal sets that are made, where there is no terminal [s]."""
UPDATE_LINE_INTERVAL = 10.0
"""Time between two lines about a training where there is no terminal [s]."""


@contextmanager
def bar(
    args: argparse.Namespace, title: str, unit: str = "robot", total: int | None = None
) -> Iterator[None]:
    """Show the progress of this block in a bar; see ``_bar``."""
    with _bar(args, title, unit, total) as shown, show_progress(shown):
        yield


@contextmanager
def _bar(
    args: argparse.Namespace | None,
    title: str,
    unit: str = "robot",
    total: int | None = None,
    layout: str | None = None,
    delay: float = REDRAW_INTERVAL,
) -> Iterator[Progress]:
    """Yield the function that sets a bar, which disappears at the end.

    Nothing is shown without a terminal or with ``--json``.

    delay: Time before the bar appears, so that quick commands do not flicker [s].
    """
    raise_if_interrupted()
    hidden = getattr(args, "json", False) or None  # None: shown on a terminal only
    shown: tqdm[NoReturn] = tqdm(
        desc=title,
        unit=f" {unit}",
        total=total,
        bar_format=layout,
        file=sys.stderr,
        disable=hidden,
        delay=delay,
        leave=False,
    )

    def show(done: float, total: int | None) -> None:
        raise_if_interrupted()
        shown.total = shown.total if total is None else total
        shown.update(done - shown.n)  # tqdm counts steps, reports are sums

    with shown, _redrawn(shown):
        yield show


@contextmanager
def _redrawn(shown: tqdm[NoReturn]) -> Iterator[None]:
    """Redraw a bar at regular intervals, so that its clock runs while one item takes long."""
    if shown.disable:
        yield
        return
    finished = threading.Event()

    def redraw() -> None:
        while not finished.wait(REDRAW_INTERVAL):
            shown.refresh()

    thread = threading.Thread(target=redraw, daemon=True)
    thread.start()
    try:
        yield
    finally:
        finished.set()
        thread.join()
        shown.clear()  # closing it would not: tqdm takes a bar for hidden that others redrew


def track(
    items: Iterable[T], args: argparse.Namespace, title: str, unit: str, total: int
) -> Iterator[T]:
    """Yield the items, and show in a bar how many of them are finished."""
    with _bar(args, title, unit, total) as show:
        for done, item in enumerate(items, 1):
            raise_if_interrupted()
            yield item
            show(done, None)


def note(text: str) -> None:
    """Print a line that is no part of the command's result, which alone goes to stdout."""
    with tqdm.external_write_mode(file=sys.stderr):  # above the bars that are shown
        print(text, file=sys.stderr, flush=True)


def print_line(line: str) -> None:
    """Print a line above the bars that are shown."""
    with tqdm.external_write_mode():
        print(line, flush=True)


@contextmanager
def status(args: argparse.Namespace | None, text: str) -> Iterator[None]:
    """Show on a terminal what the command does and for how long, until the work is done."""
    with _bar(args, text, layout="{desc} [{elapsed}]"):
        yield


@contextmanager
def training_progress(how_to_resume: str | None = None) -> Iterator[TrainingProgress]:
    """Yield a display of trainings and evaluations; Ctrl-C says how to resume them."""
    display = TrainingProgress()
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


class TrainingProgress:
    """Shows the progress of trainings and evaluations, one after the other."""

    def __init__(self) -> None:
        self._shown = ExitStack()
        self._shown.enter_context(status(None, "preparing"))
        self._goal_bar: Progress | None = None
        self._print_goals = _at_intervals(GOAL_LINE_INTERVAL, "goal sets: {:.0f} of {} robots")

    def __call__(self, done: float, total: int | None) -> None:
        """Show how many of the robots have their goal set."""
        raise_if_interrupted()
        if not sys.stderr.isatty():
            if total and done < total:
                self._print_goals(done, total)
            return
        if self._goal_bar is None:
            self.close()
            self._goal_bar = self._shown.enter_context(_bar(None, "goal sets"))
        self._goal_bar(done, total)
        if done == total:
            self.close()
            self._shown.enter_context(status(None, "preparing"))

    def training(self, subrun: Subrun) -> ShowMetrics:
        """Begin with a subrun; return the function that shows its metrics.

        A line at its end says how many of its episodes diverged, if any did.
        """
        from morphgen.rl.runs.robot_source import SplitSource, tasks_of

        raise_if_interrupted()
        self.close()
        config, source = subrun.config, subrun.config.source
        name = source.name
        if isinstance(source, SplitSource) and source.member:
            name = source.member
        counts = Counter[str]()
        self._shown.callback(_print_divergence, name, counts)
        # The score of a step of push is 1 where it succeeds, else 0: its mean says nothing.
        is_relative = any(TASKS[task].relative_to_random for task in tasks_of(source))
        metric = "score" if is_relative else "reward"
        show = _update_lines(name)
        if sys.stderr.isatty():
            shown: tqdm[NoReturn] = tqdm(
                desc=name,
                total=config.num_updates * config.ppo.num_steps * config.num_envs,
                unit="step",
                unit_scale=True,
                file=sys.stderr,
                dynamic_ncols=True,
            )
            self._shown.callback(shown.close)
            show = partial(_draw_update, shown)

        def update(report: UpdateMetrics, total: int) -> None:
            counts.update(episodes=report.episodes, diverged=report.unstable)
            success = f"{report.success:.0%}" if report.episodes else "unknown"
            show(report, total, {metric: f"{getattr(report, metric):.2f}", "success": success})

        return update

    @contextmanager
    def stage(self, title: str) -> Iterator[None]:
        """Show how many episodes of an evaluation ended."""
        raise_if_interrupted()
        self.close()
        if not sys.stderr.isatty():
            with show_progress(_at_intervals(LINE_INTERVAL, f"{title}: {{:.0f}} of {{}} episodes")):
                yield
            return
        layout = "{l_bar}{bar}| {n:.1f}/{total_fmt} [{elapsed}<{remaining}]"
        with _bar(None, title, "episode", layout=layout, delay=0) as show, show_progress(show):
            yield

    def note(self, text: str) -> None:
        """Print a line above the bar."""
        note(text)

    def close(self) -> None:
        """Finish the bar that is shown."""
        self._shown.close()
        self._goal_bar = None


def _draw_update(
    shown: tqdm[NoReturn], report: UpdateMetrics, total: int, facts: Mapping[str, str]
) -> None:
    if shown.n == 0:  # a resumed run: the bar begins where the run was interrupted
        shown.initial = report.transitions - report.transitions // report.update
        shown.n = shown.initial
    shown.set_postfix(facts, refresh=False)
    shown.update(report.transitions - shown.n)


def _update_lines(name: str) -> Callable[[UpdateMetrics, int, Mapping[str, str]], None]:
    """Return a function that prints the first update, the last one, and others at intervals."""
    last = -math.inf

    def show(report: UpdateMetrics, total: int, facts: Mapping[str, str]) -> None:
        nonlocal last
        if time.monotonic() < last + UPDATE_LINE_INTERVAL and report.update < total:
            return
        last = time.monotonic()
        # Every update has equally many transitions.
        seconds_left = (total - report.update) * report.transitions / report.update
        seconds_left /= report.steps_per_second
        note(
            f"{name}: update {report.update} of {total}, {report.transitions:,} steps, "
            f"{', '.join(map(' '.join, facts.items()))}, "
            f"{report.steps_per_second:,.0f} steps/s, {seconds_left / 60:.1f} min left"
        )

    return show


def _at_intervals(interval: float, line: str) -> Progress:
    """Return a function that prints a line, but not more often than at an interval [s]."""
    last = time.monotonic()

    def update(done: float, total: int | None) -> None:
        nonlocal last
        if time.monotonic() - last > interval:
            last = time.monotonic()
            note(line.format(done, total))

    return update


def _print_divergence(name: str, counts: Counter[str]) -> None:
    if counts["diverged"]:
        note(
            f"{name}: {counts['diverged']} of {counts['episodes']} episodes ended because their "
            "simulation diverged"
        )
