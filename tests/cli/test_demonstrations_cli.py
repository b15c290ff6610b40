"""``morphgen record``, ``verify`` and ``show``: output and exit codes."""

import json

import pytest

pytest.importorskip("pyarrow")
pytestmark = pytest.mark.usefixtures("goal_cache")


def test_record_show_and_verify(run, ok, tmp_path, refused):
    words = ("record", "prims", "--tasks", "reach", "--episodes", "1", "--out", "demos")
    first, _, _, row, *_ = ok(*words).splitlines()
    assert first.startswith("demos: 1 episode of 1 robot, ")
    assert row.split()[:4] == ["reach", "ik", "1", "1"]
    assert ok(*words).splitlines()[0] == first  # finished: nothing is recorded again
    assert ok("show", "demos").splitlines()[0] == first
    facts = json.loads(ok("show", "demos", "--json"))
    assert (facts["episodes"], facts["tasks"][0]["success"]["value"]) == (1, 1.0)
    assert ok("verify", "demos").splitlines()[-1] == "1 of 1 episodes agree within 0.001 rad or m"
    (tmp_path / "demos" / "mine.txt").write_text("mine")
    code, out, _ = run("verify", "demos")
    assert code == 1
    assert "changed: mine.txt" in out
    assert "holds another data set: its seed is " in refused(*words, "--seed", "1")
    err = refused("record", "stick", *words[2:])
    assert "its robots[0].name is 'prims', not 'stick'; name another folder" in err
