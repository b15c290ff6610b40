"""Provenance of composed robots: derivation, licences and accepted findings."""

import json
from dataclasses import replace

import pytest

from helpers.composed import LIBRARY, derive, joined
from helpers.parts import write_part
from morphgen.checks import check
from morphgen.formats.bundle import read_bundle, write_bundle
from morphgen.grammar.compose import join
from morphgen.grammar.library import default_library
from morphgen.model.robot import Inertial


def test_the_derivation_lists_parts_parameters_and_ports():
    derivation = derive("base=pedestal base.height=40cm arm=ur5 ee=plane ee.mount_yaw=90deg")
    assert str(derivation) == (
        "base=pedestal(height=0.4, radius=0.08, spread=0.6)"
        "[top: arm=ur5[flange: ee=plane(size=0.1, thickness=0.01, mount_yaw=1.57079632679)]]"
    )
    robot = join(derivation, LIBRARY, "robot")
    assert robot.provenance["derivation"] == str(derivation)
    other = derive("base=pedestal base.height=41cm arm=ur5 ee=plane ee.mount_yaw=90deg")
    assert derivation.digest != other.digest


def test_provenance_names_licence_and_citation_of_every_part():
    parts = joined("arm=ur5 ee=robotiq_2f85").provenance["parts"]
    assert [(part["label"], part["part"]) for part in parts] == [
        ("base", "fixed"),
        ("arm", "ur5"),
        ("ee", "robotiq_2f85"),
    ]
    assert parts[1]["licence"] == "BSD-3-Clause"
    assert "universal_robot" in parts[1]["citation"]
    assert "linkage is open" in parts[2]["notes"]
    assert "notes" not in parts[0]


@pytest.mark.slow
def test_a_finding_accepted_by_a_part_has_severity_info_and_a_reason():
    robot = joined("arm=panda")
    by_itself = [f for f in check(replace(robot, provenance={})) if f.severity == "warning"]
    assert ("inertia-implausible", "link arm_panda_link1") in {(f.code, f.where) for f in by_itself}
    (finding,) = [f for f in check(robot) if f.where == "link arm_panda_link1"]
    assert finding.severity == "info"
    assert "; accepted: identified on the real arm" in finding.why


def test_an_accepted_finding_stays_accepted_in_the_bundle(tmp_path):
    robot = joined("arm=panda")
    folder = write_bundle(robot, tmp_path / "panda", check(robot), picture=False)
    card = json.loads((folder / "card.json").read_text())
    assert [f["severity"] for f in card["findings"] if f["code"] == "inertia-implausible"] == [
        "info"
    ]
    assert {f.severity for f in check(read_bundle(folder))} <= {"info"}


def test_accepting_one_finding_accepts_no_other(tmp_path):
    """Neither the same fault of another link, nor another fault of the same link."""
    write_part(tmp_path, accepted={"disc": {"inertia-implausible": "it is a flywheel"}})
    library = default_library([tmp_path])
    robot = join(derive("arm=lwr ee=pincer", library), library, "robot")
    light, odd = robot.link("ee_disc").inertial.mass, (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)
    disc = replace(robot.link("ee_disc"), inertial=Inertial(100 * light, inertia=odd))
    palm = replace(robot.link("ee_palm"), inertial=Inertial(0.08, (0, 0, 0.1), odd))
    severity = {(f.where, f.code): f.severity for f in check(robot.with_links([disc, palm]))}
    assert severity["link ee_disc", "inertia-implausible"] == "info"
    assert severity["link ee_disc", "density-implausible"] == "warning"
    assert severity["link ee_palm", "inertia-implausible"] == "warning"
