"""``morphgen sample``, ``grammar`` and grammars in ``compose``."""

import json
import re
from pathlib import Path

import pytest

from helpers.grammars import CATEGORIES
from helpers.parts import write_part
from morphgen.formats.bundle import read_bundle
from morphgen.grammar.library import LIBRARY_VARIABLE

GRAMMAR = """\
# a plate or a cube on a gantry
robot -> gantry ee
ee -> plane(size=uniform(5cm, 15cm)) | cube
"""


def records(folder):
    """The lines of a set's index."""
    return [json.loads(line) for line in Path(folder, "index.jsonl").read_text().splitlines()]


@pytest.fixture
def mine():
    """A user grammar in the current folder."""
    path = Path("mine.grammar")
    path.write_text(GRAMMAR)
    return path


@pytest.fixture
def cubes(run):
    """The folder of a light set of four cubes."""
    assert run("sample", "cubes", "-n", 4, "--light", "--out", "set")[0] == 0
    return Path("set")


def test_sample_creates_a_set_and_prints_its_size(run, tmp_path):
    code, out, err = run("sample", "cubes", "-n", 3, "--light")
    assert (code, out, err) == (0, "robots/cubes: 3 robots written, 0 already existed\n", "")
    assert len(list((tmp_path / "robots" / "cubes").glob("cubes-*"))) == 3
    code, out, _ = run("sample", "cubes", "-n", 4, "--light")
    assert (code, out) == (0, "robots/cubes: 1 robots written, 3 already existed\n")


def test_sample_reads_a_grammar_file_and_prints_its_report_as_json(ok, mine):
    report = json.loads(ok("sample", mine, "-n", 2, "--light", "--json", "--where", "mass < 900"))
    assert report == {
        "folder": "robots/mine",
        "made": 2,
        "kept": 0,
        "distinct": 1,
        "rejected": {},
    }
    assert [record["name"] for record in records("robots/mine")] == ["mine-000000", "mine-000001"]


def test_light_set_and_its_robots_are_accepted_by_other_commands(run, ok, cubes):
    for robot in (cubes / "cubes-000001", cubes / "cubes-000001" / "robot.urdf"):
        assert run("show", robot)[1].startswith("cubes-000001: ")
    out = ok("check", cubes)
    number = len(list(cubes.glob("cubes-*")))
    assert out.count(": 0 error, 0 warning") == number
    assert out.splitlines()[-1] == f"{number} robots: 0 with errors, 0 with warnings"


def test_sample_writes_pictures_unless_no_picture_is_given(run):
    assert run("sample", "cubes", "-n", 1, "--out", "a")[0] == 0
    assert run("sample", "cubes", "-n", 1, "--out", "b", "--no-picture")[0] == 0
    assert Path("a/cubes-000000/preview.png").is_file()
    assert not Path("b/cubes-000000/preview.png").exists()
    assert read_bundle(Path("a/cubes-000000")).dof == 2


def test_sample_prints_the_number_of_rejected_draws(ok):
    out = ok("sample", "cubes", "-n", 5, "--light", "--where", "mass < 0.5")
    assert re.fullmatch(r"  (\d+) of \d+ draws rejected: where \(mass < 0.5\)", out.splitlines()[1])


def test_grammar_list_names_the_categories(run):
    rows = json.loads(run("grammar", "list", "--json")[1])
    assert [row["name"] for row in rows] == CATEGORIES
    listed = run("grammar", "list")[1].splitlines()[2:]
    for line, row in zip(listed, rows, strict=True):
        assert line.split(maxsplit=1) == [row["name"], row["robots"]]


def test_grammar_check_prints_sound_or_the_faults(run, mine):
    assert run("grammar", "check", mine) == (0, "mine: sound\n", "")
    assert json.loads(run("grammar", "check", mine, "--json")[1]) == []
    mine.write_text("robot -> cubes\nx -> cubes\nlet r = 1\n")
    code, out, err = run("grammar", "check", mine)
    assert (code, err) == (1, "")
    assert out.splitlines() == [
        "mine.grammar:2:1: 'x' cannot be reached from 'robot'",
        "mine.grammar:3:5: 'r' is never used",
    ]
    code, out, _ = run("grammar", "check", mine, "--json")
    assert (code, len(json.loads(out))) == (1, 2)


def test_grammar_count_prints_the_number_of_structures(ok, mine):
    assert ok("grammar", "count", mine) == "mine: 2 structures\n"
    data = json.loads(ok("grammar", "count", mine, "--json"))
    assert data == {"structures": 2, "finite": True}


def test_counts_without_a_number_are_named(run, mine):
    mine.write_text(f"robot -> slides a{{1,100}}\na -> {' | '.join(['bead'] * 11)}\n")
    line = "mine: more than 10^100 structures"
    assert run("grammar", "count", mine)[1].splitlines() == [line]
    data = json.loads(run("grammar", "count", mine, "--json")[1])
    assert (data["structures"], data["finite"]) == (None, True)
    mine.write_text("robot -> slides tail\ntail -> bead | bead tail\n")
    assert run("grammar", "count", mine)[1].startswith("mine: infinitely many structures")
    assert json.loads(run("grammar", "count", mine, "--json")[1])["structures"] is None


def test_grammar_print_is_a_grammar_without_includes(run, ok, mine):
    Path("more.grammar").write_text('include "mine.grammar"\nrobot -> slides down:ee\n')
    out = ok("grammar", "print", "more.grammar")
    assert out == "robot -> slides down:ee\nee -> plane(size=uniform(5cm, 15cm)) | cube\n"
    assert json.loads(run("grammar", "print", "more.grammar", "--json")[1]) == out
    mine.write_text(out)
    assert run("grammar", "print", mine)[1] == out


def test_compose_follows_a_grammar(run):
    code, out, _ = run("compose", "chain", "beads=5", "bead.radius=0.02", "--no-picture")
    assert (code, out.splitlines()[0].split(": ")[1][:16]) == (0, "19 links, 13 DoF")
    (folder,) = Path("robots").iterdir()
    assert folder.name.startswith("chain-")
    assert read_bundle(folder).dof == 13
    card = json.loads((folder / "card.json").read_text())
    assert card["derivation"].count("radius=0.02") == 5


@pytest.mark.parametrize("by_environment", [True, False])
def test_parts_and_grammars_are_read_from_the_user_library(run, monkeypatch, by_environment):
    folder = Path("library")
    write_part(folder)
    (folder / "held.grammar").write_text("robot -> fixed ur5 pincer(length=uniform(0.15, 0.3))\n")
    words = ("--library", folder)
    if by_environment:
        monkeypatch.setenv(LIBRARY_VARIABLE, str(folder))
        words = ()
    assert run("grammar", "check", "held", *words) == (0, "held: sound\n", "")
    assert run("sample", "held", "-n", 2, "--light", *words)[0] == 0
    derivation = Path("robots/held/held-000001/derivation.txt").read_text()
    assert "flange: pincer=pincer(length=0." in derivation
