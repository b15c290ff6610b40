"""How runs that train, and evaluations, are going, as they go."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from tqdm import tqdm

    from morphgen.rl.evaluation import Progress
    from morphgen.rl.metrics import UpdateMetrics
    from morphgen.rl.training import ShowMetrics, Subrun

MINUTE = 60.0
"""Seconds between lines of an evaluation."""


@contextmanager
def shown(again: str = "with --resume") -> Iterator[Shower]:
    """Bars on stderr while there is one to look at, else some lines.

    Args:
        again: What to say after Ctrl-C.
    """
    shower = Shower()
    try:
        yield shower
    except KeyboardInterrupt as interrupt:
        text = f"it goes on from its last checkpoint, if it has one, {again}"
        raise KeyboardInterrupt(text) from interrupt
    finally:
        shower.close()


class Shower:
    """Shows how a run or an evaluation goes."""

    def __init__(self) -> None:
        self._bar: tqdm[NoReturn] | None = None

    def __call__(self, part: Subrun) -> ShowMetrics:
        """Begin with a part."""
        self.close()
        name = part.config.source.member or part.config.source.name
        if not sys.stderr.isatty():
            return lambda report, updates: _print(name, report, updates)
        from tqdm import tqdm

        total = part.config.num_updates * part.config.ppo.num_steps * part.config.num_envs
        self._bar = tqdm(
            total=total,
            desc=name,
            unit="step",
            unit_scale=True,
            file=sys.stderr,
            dynamic_ncols=True,
        )
        return self._show

    def counting(self, name: str) -> Progress:
        """Begin with an evaluation; on no terminal it is a line a minute."""
        self.close()
        if not sys.stderr.isatty():
            return _Minutes(name)
        from tqdm import tqdm

        bar = self._bar = tqdm(
            desc=name,
            unit="episode",
            file=sys.stderr,
            dynamic_ncols=True,
            leave=False,
            bar_format="{l_bar}{bar}| {n:.1f}/{total_fmt} [{elapsed}<{remaining}]",
        )

        def told(done: float, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        return told

    def close(self) -> None:
        """Leave the bar as it is."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def _show(self, report: UpdateMetrics, updates: int) -> None:
        assert self._bar is not None
        if self._bar.n == 0:
            self._bar.initial = report.transitions - report.transitions // report.update
            self._bar.n = self._bar.initial
        self._bar.set_postfix(score=f"{report.score:.2f}", success=_success(report), refresh=False)
        self._bar.update(report.transitions - self._bar.n)
        if report.unstable:
            self._bar.write(_unstable(self._bar.desc, report), file=sys.stderr)


class _Minutes:
    """Says how far an evaluation is, once a minute."""

    def __init__(self, name: str) -> None:
        self._name, self._last = name, time.monotonic()

    def __call__(self, done: float, total: int) -> None:
        """Be told how many episodes are over."""
        if time.monotonic() - self._last > MINUTE:
            self._last = time.monotonic()
            print(f"{self._name}: {done:.0f} of {total} episodes", file=sys.stderr, flush=True)


def _print(name: str, report: UpdateMetrics, updates: int) -> None:
    if report.unstable:
        print(_unstable(name, report), file=sys.stderr, flush=True)
    if report.update % max(updates // 20, 1) and report.update < updates:
        return
    left = (updates - report.update) * report.transitions / report.update / report.steps_per_second
    print(
        f"{name}: update {report.update} of {updates}, {report.transitions:,} steps, "
        f"score {report.score:.2f}, success {_success(report)}, "
        f"{report.steps_per_second:,.0f} steps/s, {left / 60:.1f} min left",
        file=sys.stderr,
        flush=True,
    )


def _unstable(name: str, report: UpdateMetrics) -> str:
    return (
        f"{name}: update {report.update}: {report.unstable} of {report.episodes} episodes ended "
        "because their simulation became unstable"
    )


def _success(report: UpdateMetrics) -> str:
    return f"{report.success:.0%}" if report.episodes else "unknown"
