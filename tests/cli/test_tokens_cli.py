"""``morphgen tokens``: output, written files and rejected input."""

import json
from pathlib import Path

import numpy as np
import pytest

import morphgen
from helpers.commands import tree
from helpers.robots import arm
from morphgen.benchmark.tokens import LAYOUT, robot_from_tokens, tokens
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.bundle import write_bundle

WORDS = ("base=gantry", "ee=plane")


def rows_of(table):
    """Cells of a printed table, by the header's columns."""
    _, rule, *rows = table.splitlines()
    starts = [i for i in range(len(rule)) if rule[i] == "-" and (i == 0 or rule[i - 1] == " ")]
    ends = [*starts[1:], None]
    return [
        [row[a:b].strip() for a, b in zip(starts, ends, strict=True)]
        for row in rows
        if row[:1].isdigit()
    ]


@pytest.fixture
def bundle(tmp_path):
    return write_bundle(arm(), tmp_path / "arm", picture=False).relative_to(tmp_path)


def test_tokens_are_printed_link_by_link(run, bundle):
    code, out, err = run("tokens", bundle)
    assert (code, err) == (0, "")
    cylinder, twice = "cylinder r 0.02, length", "0.04 | prismatic | 0 1 0"
    assert [" | ".join(row) for row in rows_of(out)] == [
        "0 | base |  |  | box 0.1 x 0.1 x 0.04 |  |  |  |  | ",
        f"1 | upper | 0 |  | {cylinder} 0.24 | revolute | 0 1 0 | 0 0 0.05 | 0 0 0 | 0.200",
        f"2 | lower | 1 |  | {cylinder} 0.24 | revolute | 1 0 0 | 0 0 0.3 | 0 0 0 | 0.250",
        f"3 | slider | 2 | tool | {cylinder} 0.14 | prismatic | 0 0 1 | 0 0 0.3 | 0 0 0 | -0.500",
        f"4 | left | 3 |  | {cylinder} {twice} | 0 0.05 0.2 | 0 0 0 | 0.000",
        f"5 | right | 3 |  | {cylinder} {twice} | 0 -0.05 0.2 | 0 0 0 | 0.000",
    ]
    assert out.splitlines()[-1] == "arm: (6, 48), indices over 22"


def test_robot_can_be_given_as_urdf_or_parts(run, robot_urdf):
    code, out, _ = run("tokens", robot_urdf(arm()))
    assert (code, len(rows_of(out))) == (0, 6)
    assert {row[3] for row in rows_of(out)} == {""}
    code, out, _ = run("tokens", *WORDS, "ee.size=0.2")
    assert (code, len(rows_of(out))) == (0, 7)
    assert rows_of(out)[-1][3:6] == ["tool", "box 0.01 x 0.2 x 0.2", "fixed"]
    code, out, _ = run("tokens", "chain", "beads=2")
    assert (code, len(rows_of(out))) == (0, 10)
    drawn = [row[4].split()[0] for row in rows_of(out) if row[4]]
    assert {*drawn} == {"cylinder", "sphere"}


def test_options_may_stand_between_parts(run):
    assert run("tokens", WORDS[0], "--max-links", 7, WORDS[1])[0] == 0


def test_layout_option_prints_the_fields(run, bundle):
    code, out, err = run("tokens", "--layout")
    assert (code, err) == (0, "")
    lines = out.splitlines()[2:]
    assert [line.split("  ")[0] for line in lines] == [field.name for field in LAYOUT]
    assert " 19:22 " in next(line for line in lines if line.startswith("joint axis"))
    _, both, _ = run("tokens", bundle, "--layout")
    assert both == f"{run('tokens', bundle)[1]}\n{out}"
    _, data, _ = run("tokens", "--layout", "--json")
    assert sum(field["size"] for field in json.loads(data)) == 48


def test_json_option_prints_only_json(run):
    code, out, err = run("tokens", *WORDS, "--json", "--max-links", 10)
    assert (code, err) == (0, "")
    data = json.loads(out)
    robot = morphgen.compose(" ".join(WORDS))
    expected = tokens(robot, token_shapes(robot), max_links=10)
    np.testing.assert_array_equal(np.array(data["tokens"]), expected)
    assert data["links"] == [link.name for link in robot.links]
    assert (data["name"], data["shape"], data["max_links"]) == (robot.name, [7, 48], 10)
    assert [field["name"] for field in data["layout"]] == [field.name for field in LAYOUT]


def test_written_file_is_reproducible(run, bundle, tmp_path):
    before = set(tree(tmp_path))
    code, out, err = run("tokens", bundle, "--out", "arm.npz")
    assert (code, err) == (0, "")
    assert out.endswith("\narm.npz\n")
    assert set(tree(tmp_path)) - before == {"arm.npz"}
    first = Path("arm.npz").read_bytes()
    assert json.loads(run("tokens", bundle, "--out", "arm.npz", "--json")[1])["file"] == "arm.npz"
    assert Path("arm.npz").read_bytes() == first
    with np.load("arm.npz", allow_pickle=False) as data:
        assert data["tokens"].shape == (6, 48)
        back, _ = robot_from_tokens(data["tokens"], "back", max_links=int(data["max_links"]))
        assert data["links"].tolist() == [link.name for link in arm().links]
    assert back.parents == arm().parents


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ("", "name a robot, such as arm=ur5 ee=plane, or say --layout"),
        ("--layout --out x.npz", "name a robot"),
        ("--layout --max-links 5", "name a robot"),
        ("base=gantry ee=plane --out x.txt", "--out x.txt: expected a name that ends in .npz"),
        ("base=gantry ee=plane --out no/x.npz", "--out no/x.npz: there is no folder no"),
        ("base=gantry ee=plane --out folder.npz", "--out folder.npz: it is a folder"),
        ("base=gantry ee=plane --max-links 6", "has 7 links, more than max_links 6"),
        ("base=gantry ee=plnae", "unknown ee 'plnae'; did you mean 'plane'?"),
        ("robots/nowhere", "robots/nowhere: no such file or folder"),
        ("nowhere.urdf", "nowhere.urdf: no such file or folder"),
        ("nowhere.grammar", "nowhere.grammar: no such file"),
        ("chian", "'chian' is not a part; did you mean 'chain'?"),
        ("./folder.npz", "folder.npz holds no robot"),
    ],
)
def test_invalid_arguments_are_rejected(refused, tmp_path, argv, message):
    (tmp_path / "folder.npz").mkdir()
    assert message in refused("tokens", *argv.split())


def test_interrupted_run_keeps_the_old_file(run, bundle, tmp_path, monkeypatch):
    Path("arm.npz").write_text("old")
    before = tree(tmp_path)

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", interrupted)
    code, out, _ = run("tokens", bundle, "--out", "arm.npz")
    assert (code, out) == (130, "")
    assert tree(tmp_path) == before
