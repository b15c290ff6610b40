"""Imported robots become parts; robots of collections are imported."""

import sys
from pathlib import Path

import pytest

import morphgen
from helpers.commands import tree
from helpers.mjcf import write
from morphgen.formats.bundle import find_description

SITE = '<site name="tool" pos="0 0 0.2" euler="0 90 0"/>'
ARM = f"""<worldbody>
  <body name="base"><geom size="0.1"/>
    <body name="left" pos="0 0 0.2"><joint name="a" axis="0 1 0" range="-1 1"/><geom size="0.1"/>
      <body name="right" pos="0 0 0.2"><joint name="b" axis="0 1 0" range="-1 1"/>
        <geom size="0.1"/>{SITE}
      </body>
    </body>
  </body>
</worldbody>"""


def test_the_urdf_of_a_bundle_is_imported_with_its_frames(run, tmp_path):
    assert run("compose", "base=gantry", "ee=plane", "--no-picture", "--out", "a")[0] == 0
    for name, before in (("b", "a/gantry-plane"), ("c", "b/gantry-plane")):
        words = ("import", f"{before}/robot.urdf", "--no-picture", "--out", name)
        assert run(*words)[0] == 0
    composed, again = (morphgen.read(tmp_path / name / "gantry-plane") for name in "ac")
    assert [frame.name for frame in again.frames] == ["tool"]
    assert [link.name for link in again.links] == [link.name for link in composed.links]


def test_a_tool_link_is_renamed_even_if_its_new_name_is_taken(run, tmp_path):
    (tmp_path / "arm.urdf").write_text(
        "<robot name='arm'><link name='base'/><link name='tool_link'/><link name='tool'/>"
        "<joint name='tool_link_joint' type='fixed'><parent link='base'/>"
        "<child link='tool_link'/></joint><joint name='tool_joint' type='fixed'>"
        "<parent link='tool_link'/><child link='tool'/></joint></robot>"
    )
    assert run("import", "arm.urdf", "--no-picture")[0] == 0
    robot = morphgen.read(tmp_path / "robots" / "arm")
    assert [link.name for link in robot.links] == ["base", "tool_link", "tool_link_"]
    assert [(frame.name, frame.link) for frame in robot.frames] == [("tool", "tool_link_")]


def test_an_imported_arm_carries_an_end_effector(run, tmp_path):
    write(tmp_path, ARM, "my_arm.xml")
    words = ("import", "my_arm.xml", "--name", "my_arm", "--part", "arm", "--licence", "MIT")
    code, out, err = run(*words, "--no-picture", "--out", "imported")
    assert (code, err, out.splitlines()[-1]) == (0, "", "parts/my_arm.yaml")
    robot = morphgen.compose("arm=my_arm ee=stick", library=[tmp_path / "parts"])
    alone = morphgen.compose("arm=my_arm", library=[tmp_path / "parts"])
    assert len(alone.links) == 4  # the base, and the three bodies without a link for the site
    assert alone.frame("tool").link == "arm_right"
    assert alone.frame("tool").T_link_frame.position == (0.0, 0.0, 0.2)
    stick = robot.joints[robot.parents.index(robot.link_index["arm_right"]) - 1]
    assert stick.T_parent_joint.rpy == pytest.approx((0, 1.5707963, 0), abs=1e-6)
    (tmp_path / "parts" / "my_arm.yaml").write_bytes(b"# mine \xff")
    write(tmp_path, ARM.replace("0 0 0.2", "0 0 0.18"), "my_arm.xml")
    before = tree(tmp_path)
    for folder in ("parts", "my_arm.xml"):
        again = (*words, "--parts", folder, "--no-picture", "--out", "imported")
        assert run(*again)[0] == 2
    assert tree(tmp_path) == before


def test_bodies_become_parts_of_a_split(ok, tmp_path):
    write(tmp_path, ARM, "body_1.xml")
    write(tmp_path, ARM.replace("0 0 0.2", "0 0 0.18"), "body_2.xml")
    for body in ("body_1", "body_2"):
        words = ("--name", body, "--part", "body", "--licence", "MIT", "--no-picture")
        ok("import", f"{body}.xml", *words)
    assert {path.name for path in (tmp_path / "parts").iterdir()} == {"body_1.yaml", "body_2.yaml"}
    (tmp_path / "set.grammar").write_text("robot -> body_1 | body_2\n")
    words = ("--library", "parts", "--train", "1", "--test", "1", "--name", "my/set")
    bodies = "set.grammar robot={body_1,body_2}"
    ok("split", "new", "--from", bodies, "--hold-out", "body=body_2", *words)
    assert "body_2" in (tmp_path / "my" / "set.yaml").read_text()


def test_a_module_of_robot_descriptions_names_its_file(refused, tmp_path, monkeypatch):
    folder = tmp_path / "packages" / "robot_descriptions"
    folder.mkdir(parents=True)
    (folder / "__init__.py").touch()
    (folder / "toy_description.py").write_text(
        "XACRO_PATH = '/toys/toy.xacro'\nXACRO_ARGS = {'length': 2}\n"
    )
    (folder / "lost_description.py").write_text("raise OSError('no network')\n")
    monkeypatch.syspath_prepend(str(tmp_path / "packages"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # nothing else may be written
    for module in ("", ".toy_description", ".lost_description"):
        # Set first, so that what the test imports goes with it.
        monkeypatch.setitem(sys.modules, f"robot_descriptions{module}", None)
        monkeypatch.delitem(sys.modules, f"robot_descriptions{module}")
    found = find_description("robot_descriptions:toy_description")
    assert found == (Path("/toys/toy.xacro"), {"length": "2"})
    for name, reason in (
        ("toi_description", "no such robot; did you mean 'toy_description'?"),
        ("lost_description", "lost_description: cannot be loaded: no network"),
    ):
        assert reason in refused("import", f"robot_descriptions:{name}")
    assert find_description("C:robot.xml") == (Path("C:robot.xml"), {})
