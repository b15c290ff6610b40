"""What is said while runs train: bars for eyes, lines for files, and what went wrong in both."""

import sys
from dataclasses import fields, replace
from types import SimpleNamespace

import pytest

from morphgen.cli.progress import Shower
from morphgen.rl.report import Report
from small_runs import small_config

FLOATS = [each.name for each in fields(Report) if each.type == "float"]
REPORT = Report(
    update=1,
    transitions=32,
    scores=(1.0,),
    episodes=7,
    unstable=0,
    terms={},
    **dict.fromkeys(FLOATS, 0.5),
)


@pytest.fixture(params=[True, False], ids=["terminal", "file"])
def show(request, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: request.param)
    shower = Shower()
    yield shower(SimpleNamespace(config=small_config()))
    shower.close()


def test_episodes_cut_short_are_told_at_once_and_only_then(show, capsys):
    show(replace(REPORT, update=99, transitions=99 * 32), 100)
    assert "unstable" not in capsys.readouterr().err
    show(replace(REPORT, update=99, transitions=99 * 32, unstable=2), 100)
    told = "update 99: 2 of 7 episodes ended because their simulation became unstable\n"
    assert told in capsys.readouterr().err
