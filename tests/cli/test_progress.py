"""What is said of evaluations while they go on."""

import sys

from morphgen.cli import progress


def test_what_takes_minutes_says_how_far_it_is_once_in_each(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    with progress.counted() as count:
        tell = count("stochastic on test")
        for i in range(1, 13):
            now[0] += 11
            tell(i / 2, 6)
    out, err = capsys.readouterr()
    assert (out, err.splitlines()) == (
        "",
        ["stochastic on test: 3 of 6 episodes", "stochastic on test: 6 of 6 episodes"],
    )


def test_on_a_terminal_it_is_a_bar_that_goes_away(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with progress.counted() as count:
        tell = count("train")
        tell(0.5, 2)
        tell(2, 2)
        count("test")(1, 2)
    err = capsys.readouterr().err
    assert "train" in err
    assert "test" in err
    assert err.rsplit("\r", 1)[-1].strip() == ""
