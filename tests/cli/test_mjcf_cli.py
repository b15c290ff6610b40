"""Commands accept an MJCF where they accept a URDF."""

import json

from helpers.mjcf import TWO_JOINTS, write
from morphgen.formats.bundle import read_bundle

BALL = TWO_JOINTS.replace('name="b" range="-1 1"', 'name="b" type="ball"')


def test_check_and_show_read_an_mjcf(run, tmp_path):
    path = write(tmp_path, TWO_JOINTS)
    code, out, err = run("check", path, "--json")
    assert (code, err) == (0, "")
    assert {f["code"] for f in json.loads(out)[str(path)]["findings"]} == {
        *("effort-missing", "velocity-missing", "self-collision"),
    }
    code, out, _ = run("show", "robot.xml")
    assert (code, out.splitlines()[0]) == (0, "test: 3 links, 2 DoF, 12.57 kg")


def test_import_converts_an_mjcf_to_a_bundle(run, tmp_path):
    path = write(tmp_path, TWO_JOINTS)
    code, out, err = run("import", path, "--tool", "right", "--no-picture", "--out", "robots")
    assert (code, err) == (0, "")
    assert out.startswith("robots/test: 3 links, 2 DoF, ")
    assert read_bundle(tmp_path / "robots" / "test").frame("tool").link == "right"


def test_import_keeps_the_excluded_pairs_of_an_mjcf(run, tmp_path):
    apart = TWO_JOINTS.replace('name="right"', 'name="right" pos="1 0 0"')
    for exclude, is_ignored in (("", False), ('<exclude body1="left" body2="right"/>', True)):
        path = write(tmp_path, f"{apart}<contact>{exclude}</contact>")
        assert run("import", path, "--no-picture", "--out", "robots")[0] == 0
        pairs = read_bundle(tmp_path / "robots" / "test").ignore_pairs
        assert (("left", "right") in pairs) == is_ignored


def test_refused_mjcf_is_one_line_and_exit_code_2(refused, tmp_path):
    path = write(tmp_path, BALL)
    message = (
        f"morphgen: {path}: joint 'b': type ball; expected hinge or slide, such as three hinges at "
        "one place\n"
    )
    assert refused("import", path) == message
    assert refused("check", path) == message
