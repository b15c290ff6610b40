"""The part library: shipped parts, user folders, lookup errors, and the catalogue of facts."""

import json
import os
import re

import numpy as np
import pytest

from helpers.parts import write_part
from morphgen.checks import check
from morphgen.errors import PartError
from morphgen.grammar import catalogue as module
from morphgen.grammar.catalogue import FACTS_FILE, catalogue, compute_facts, source_digest
from morphgen.grammar.compose import compose
from morphgen.grammar.library import LIBRARY_VARIABLE, Library, default_library
from morphgen.grammar.part import load_part
from morphgen.grammar.request import default_name, parse_request
from morphgen.model.kinematics import forward_kinematics

LIBRARY = default_library()
REQUESTS = {
    "base": "base={} arm=ur5",
    "arm": "arm={}",
    "ee": "arm=ur5 ee={}",
    "object": "object={}",
}
PARTS = {part.name: REQUESTS[part.kind] for part in LIBRARY.manifests() if part.kind in REQUESTS}
DETAILED = {"so101", "so101_gripper", "yumi", "yumi_left", "yumi_right", "z1", "z1_gripper"}
DETAILED |= {"baxter_left", "jaco2", "jaco2_6dof_spherical", "tiago_pro_left", "ur10"}
"""Parts whose meshes take long, and parts much like them whose test is quick."""
ANTHROPOMORPHIC = {"allegro", "dex3"}
"""Hands whose fingers oppose each other beside the axis of the wrist."""


@pytest.fixture(autouse=True)
def _no_library_of_the_users_own(monkeypatch):
    monkeypatch.delenv(LIBRARY_VARIABLE, raising=False)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] if n in DETAILED else []) for n in PARTS]
)
def test_every_part_composes_into_a_robot_without_errors(name):
    derivation = parse_request(PARTS[name].format(name).split(), LIBRARY)
    robot = compose(derivation, LIBRARY, default_name(derivation, LIBRARY))
    assert [finding for finding in check(robot) if finding.severity != "info"] == []
    assert robot.frame("tool")


@pytest.mark.parametrize("name", LIBRARY.names("ee"))
def test_tool_frames_lie_in_front_of_the_mount_and_point_outwards(name):
    part = load_part(LIBRARY.manifest(name))
    T_root_link = forward_kinematics(part.fragment, part.fragment.home)
    T_root_tool_link = T_root_link[part.fragment.link_index[part.tool.link]]
    T_root_tool = T_root_tool_link @ part.tool.T_link_frame.matrix
    T_mount_tool = part.T_root_mount.inverse().matrix @ T_root_tool
    assert T_mount_tool[:3, 2] == pytest.approx([0, 0, 1], abs=1e-3)
    beside, ahead = np.hypot(*T_mount_tool[:2, 3]), T_mount_tool[2, 3]
    assert ahead == 0 if name == "none" else 0.03 < ahead < 0.4
    assert name in ANTHROPOMORPHIC or beside < 0.01


@pytest.mark.parametrize("name", [m.name for m in LIBRARY.manifests() if not m.is_template])
def test_every_real_part_names_its_source_manufacturer_and_licence(name):
    manifest = LIBRARY.manifest(name)
    assert manifest.manufacturer
    assert re.fullmatch(r"[A-Za-z]+-[A-Za-z0-9.-]+|MIT|ISC", manifest.licence)
    assert len(manifest.citation) > 20
    assert manifest.summary


@pytest.mark.parametrize(
    ("kind", "name", "message"),
    [
        ("arm", "plane", "'plane' is of kind ee, not arm"),
        ("arm", "UR5", "unknown arm 'UR5'; did you mean 'ur5'"),
        ("ee", "plan", "unknown ee 'plan'; did you mean 'plane'"),
        (None, "ur55", "unknown part 'ur55'; did you mean 'ur5'"),
    ],
)
def test_unknown_parts_and_those_of_another_kind_are_errors(kind, name, message):
    with pytest.raises(PartError, match=message) as caught:
        LIBRARY.manifest(name, kind)
    assert kind != "ee" or "ur5" not in str(caught.value)


def test_a_user_folder_adds_parts(tmp_path):
    write_part(tmp_path / "deep" / "down").rename(tmp_path / "deep" / "down" / "pincer.yml")
    library = default_library([tmp_path])
    assert "pincer" in library.names("ee")
    assert "pincer" not in default_library().names()


def test_the_environment_variable_lists_folders_like_path(tmp_path, monkeypatch):
    write_part(tmp_path / "a", name="pincer_a")
    write_part(tmp_path / "b", name="pincer_b")
    monkeypatch.setenv(LIBRARY_VARIABLE, os.pathsep.join([f"{tmp_path}/a", f"{tmp_path}/b"]))
    assert {"pincer_a", "pincer_b"} <= set(default_library().names("ee"))


def test_duplicate_folders_are_merged(tmp_path, monkeypatch):
    write_part(tmp_path)
    monkeypatch.setenv(LIBRARY_VARIABLE, str(tmp_path))
    monkeypatch.chdir(tmp_path)
    assert "pincer" in default_library([tmp_path, tmp_path.relative_to(tmp_path)]).names()


def test_duplicate_part_names_are_errors(tmp_path):
    user_part = write_part(tmp_path, name="ur5", kind="arm")
    message = rf"part 'ur5' is in \S*/robots_real/ur5\.yaml and in {re.escape(str(user_part))}"
    with pytest.raises(PartError, match=message):
        default_library([tmp_path]).names()
    write_part(tmp_path / "twice", name="ur5")
    with pytest.raises(PartError, match="part 'ur5' is in"):
        Library([tmp_path]).names()


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(PartError, match=r"library folder .*nowhere does not exist"):
        default_library([tmp_path / "nowhere"]).names()


def test_broken_manifests_hide_no_other_part_and_are_named_once(tmp_path, caplog):
    write_part(tmp_path)
    (tmp_path / "broken.yaml").write_text("name: ]")
    write_part(tmp_path, name="strange", colour="red")
    write_part(tmp_path, name="vanished", file="vanished.xacro")
    write_part(tmp_path, name="rootless", root="stem")
    library = default_library([tmp_path])
    assert library.manifest("pincer", "ee").name == "pincer"
    assert {"pincer", "vanished", "rootless"} == set(library.names("ee")) - set(LIBRARY.names())
    rows = catalogue(library, "ee")
    assert {row["name"] for row in rows} - set(LIBRARY.names()) == {"pincer"}
    library.manifests()
    faults = {
        "broken.yaml:1:7": "invalid YAML",
        "strange.yaml:32": "unknown key 'colour'; valid: ",
        "vanished.yaml": r"part 'vanished': \S*vanished.xacro: no such file",
        "rootless.yaml": "no link 'stem'",
    }
    assert len(caplog.messages) == len(faults)
    for place, fault in faults.items():
        folder = re.escape(str(tmp_path))
        pattern = rf"left out: {folder}/{place}: .*{fault}"
        assert sum(bool(re.match(pattern, line)) for line in caplog.messages) == 1, pattern
    for name in ("broken", "vanished", "rootless"):
        with pytest.raises(PartError, match=name):
            load_part(library.manifest(name))


STORED = json.loads(FACTS_FILE.read_text())


def test_the_catalogue_has_one_row_per_part_with_plausible_values():
    rows = {row["name"]: row for row in catalogue(LIBRARY, "base")}
    assert set(rows) == set(LIBRARY.names("base"))
    assert rows["gantry"]["dof"] == 5
    assert rows["gantry"]["reach"] == pytest.approx(np.hypot(0.8, np.hypot(0.5, 0.5)), abs=0.01)
    assert rows["fixed"]["mass"] == 0
    assert {row["source"] for row in rows.values()} == {"template"}
    assert {row["kind"] for row in rows.values()} == {"base"}


@pytest.mark.parametrize("name", LIBRARY.names())
def test_stored_facts_equal_the_computed_ones(name):
    assert STORED[name] == compute_facts(LIBRARY.manifest(name))


def test_the_shipped_catalogue_loads_no_part(monkeypatch):
    monkeypatch.setattr(module, "compute_facts", None)
    makers = {row["name"]: row["manufacturer"] for row in catalogue(LIBRARY)}
    assert sorted(makers) == sorted(STORED) == LIBRARY.names()
    assert (makers["mico"], makers["lwr"], makers["plane"]) == ("Kinova", "KUKA", "")


def test_facts_of_new_or_changed_parts_are_computed(tmp_path):
    write_part(tmp_path, name="cube")
    (row,) = catalogue(Library([tmp_path]))
    assert (row["name"], row["dof"], row["source"]) == ("cube", 2, "own")
    before = source_digest(Library([tmp_path]).manifest("cube"))
    (tmp_path / "pincer.xacro").write_text((tmp_path / "pincer.xacro").read_text() + "\n")
    assert source_digest(Library([tmp_path]).manifest("cube")) != before
