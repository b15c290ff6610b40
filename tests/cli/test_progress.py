"""Progress output: a line on a terminal, several in a file, failures in both."""

import re
import sys
import time
from dataclasses import fields, replace
from types import SimpleNamespace

import pytest

from helpers.runs import small_config
from morphgen.cli import progress
from morphgen.cli.progress import training_progress
from morphgen.progress import interrupts, part_of, report, stage
from morphgen.rl.ppo import UpdateMetrics

FLOATS = [each.name for each in fields(UpdateMetrics) if each.type == "float"]
REPORT = UpdateMetrics(
    update=1,
    transitions=32,
    scores=(1.0,),
    episodes=7,
    unstable=0,
    terms={},
    **dict.fromkeys(FLOATS, 0.5),
)


def test_updates_say_how_many_episodes_diverged(capsys):
    with training_progress() as display:
        show = display.training(SimpleNamespace(config=small_config()))
        for update, count in enumerate((0, 1, 4), start=1):
            show(replace(REPORT, update=update, transitions=32 * update, unstable=count), 3)
    first, last = capsys.readouterr().err.splitlines()
    assert "diverged" not in first
    assert "simulation diverged in 5 of 21 episodes, " in last


def test_progress_is_printed_every_ten_seconds(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(progress, "FIRST_LINE", 2.0)
    with training_progress(), stage("stochastic on test", "episode"):
        for i in range(1, 13):
            now[0] += 2
            report(i / 2, 6)
    out, err = capsys.readouterr()
    counts = ("0 of 6 episodes, 2 s, 22 s left", "3 of 6 episodes, 12 s, 12 s left")
    lines = [f"stochastic on test: {t}" for t in (*counts, "6 of 6 episodes, 22 s, 2 s left")]
    assert (out, err.splitlines()) == ("", lines)


@pytest.mark.parametrize("on_terminal", [True, False])
def test_a_stage_takes_the_place_of_the_bar(on_terminal, capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: on_terminal)
    for name in ("FIRST_LINE", "LINE_INTERVAL", "REDRAW_INTERVAL"):
        monkeypatch.setattr(progress, name, 0.01)
    with progress.bar(SimpleNamespace(), "sampling", total=9), part_of(9):
        with stage("drawing"):
            report(2, 40)
            time.sleep(0.2)
        drawing = capsys.readouterr().err
        time.sleep(0.1)
        report(1, None)
    sampling = capsys.readouterr().err
    assert "drawing" in drawing
    assert "2 of 40 robots" in drawing
    assert "sampling" in sampling
    assert "drawing" not in sampling


@pytest.mark.parametrize("json", [False, True])
def test_long_work_says_in_a_pipe_what_it_is_and_goes_on_saying_it(json, capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(progress, "REDRAW_INTERVAL", 0.01)
    monkeypatch.setattr(progress, "FIRST_LINE", 2.0)
    printed = []
    args = SimpleNamespace(json=json)
    with progress.status(args, "composing"):
        for now[0] in (1.9, 2.0, 11.9, 12.0):
            wait_for_the_clock()
            printed += capsys.readouterr().err.splitlines()
    assert printed == ([] if json else ["composing, 2 s", "composing, 12 s"])


def wait_for_the_clock():
    """Wait until the thread that prints has looked at the time, if there is one."""
    time.sleep(0.2)


@pytest.mark.parametrize("on_terminal", [True, False])
def test_updates_are_printed_at_once_every_ten_seconds_and_at_the_end(
    on_terminal, capsys, monkeypatch
):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: on_terminal)
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    with training_progress() as display:
        show = display.training(SimpleNamespace(config=small_config()))
        for update in range(1, 9):
            show(replace(REPORT, update=update, transitions=32 * update), 8)
            now[0] += 3
    err = capsys.readouterr().err
    lines = re.findall(r"update (\d) of 8, [\d,]+ steps, score 0.50, success 50%, ", err)
    assert lines == ["1", "5", "8"]


def test_the_line_of_a_terminal_is_removed_at_the_end(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setattr(progress, "REDRAW_INTERVAL", -1.0)
    with training_progress():
        with stage("train"):
            report(0.5, 2)
            report(2, 2)
        with stage("test"):
            report(1, 2)
    err = capsys.readouterr().err
    assert "train" in err
    assert "test" in err
    assert err.endswith(progress.ERASE)
    assert err.count("\n") == 0


def test_a_ctrl_c_that_an_import_lost_ends_the_next_progress(capsys):
    nothing = SimpleNamespace()

    def shown():
        with training_progress() as display:
            yield lambda: report(1, 2)
            yield lambda: stage("test").__enter__()
            yield lambda: display.training(SimpleNamespace(config=small_config()))
        with progress.bar(nothing, "reading"):
            yield lambda: report(1, None)
        yield lambda: list(progress.track([1], nothing, "reading", "robot", 1))
        yield lambda: progress.status(nothing, "reading").__enter__()

    for show in shown():
        interrupts.append(2)
        with pytest.raises(KeyboardInterrupt):
            show()
        assert interrupts == []
