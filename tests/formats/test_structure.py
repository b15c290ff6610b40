"""Findings about the structure of a URDF have line numbers; recoverable faults still load."""

import io

import pytest
import yourdfpy
from lxml import etree

from morphgen.checks import fix
from morphgen.formats.resolve import PackageFinder
from morphgen.formats.urdf.read import robot_from_xml
from morphgen.formats.urdf.schema import structure_findings
from morphgen.formats.xml import parse_xml

SOUND = """<robot name="r">
<material name="grey"><color rgba="0.5 0.5 0.5 1"/></material>
<link name="a"/>
<link name="b">
<inertial><origin xyz="0 0 0.1"/><mass value="1"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
<visual><origin rpy="0 0 1"/><geometry><box size="1 1 1"/></geometry></visual>
<visual><geometry><mesh filename="m.stl" scale="-1 1 1"/></geometry></visual>
<collision><geometry><cylinder radius="1" length="2"/></geometry></collision>
<collision><geometry><sphere radius="1"/></geometry></collision>
</link>
<joint name="j" type="revolute"><parent link="a"/><child link="b"/>
<axis xyz="0 0 1"/><limit lower="-1" upper="1e0" effort="1" velocity=".5"/>
<dynamics damping="0.1"/></joint>
<link name="c"/>
<joint name="k" type="continuous"><parent link="b"/><child link="c"/>
<mimic joint="j" multiplier="-1." offset="+0.1"/></joint>
</robot>
"""

INERTIA = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'

# code, what of SOUND is replaced, by what, line of the finding
FAULTS = [
    ("root-not-robot", ("robot", "sdf"), 1),
    ("root-not-robot", ('<robot name="r"', '<robot name="r" xmlns="http://x.org"'), 1),
    ("link-missing", None, 1),
    ("attribute-missing", (' name="r"', ""), 1),
    ("attribute-missing", ('<link name="a"/>', '<link name="a"/><link/>'), 3),
    ("attribute-missing", (' type="revolute"', ""), 12),
    ("attribute-missing", ('<mass value="1"/>', "<mass/>"), 5),
    ("attribute-missing", (' size="1 1 1"', ""), 7),
    ("attribute-missing", (' filename="m.stl"', ""), 8),
    ("attribute-missing", ('<parent link="a"/>', "<parent/>"), 12),
    ("attribute-missing", ('joint="j" ', ""), 17),
    ("element-missing", ('<parent link="a"/>', ""), 12),
    ("element-missing", ('<child link="b"/>', ""), 12),
    ("rotation-invalid", ('rpy="0 0 1"', 'rpy="0 0 1" quat_xyzw="0 0 0 1"'), 7),
    ("rotation-invalid", ('rpy="0 0 1"', 'quat_xyzw="0 0 0 0"'), 7),
    ("number-count", ('rpy="0 0 1"', 'quat_xyzw="0 0 1"'), 7),
    ("number-malformed", ('rpy="0 0 1"', 'rpy="0 0 nan"'), 7),
    ("number-malformed", ('upper="1e0"', 'upper="inf"'), 13),
    ("number-malformed", ('upper="1e0"', 'upper="1e999"'), 13),
    ("number-malformed", ('<mass value="1"', '<mass value="1kg"'), 5),
    ("number-count", ('xyz="0 0 0.1"', 'xyz="0 0.1"'), 5),
    ("number-count", ('size="1 1 1"', 'size=""'), 7),
    ("number-count", ('scale="-1 1 1"', 'scale="1 1"'), 8),
    ("number-count", ('"0.5 0.5 0.5 1"', '"0.5 0.5 0.5"'), 2),
    ("number-commas", ('xyz="0 0 0.1"', 'xyz="0,0,0.1"'), 5),
    ("size-not-positive", ('size="1 1 1"', 'size="1 -1 1"'), 7),
    ("size-not-positive", ('<sphere radius="1"', '<sphere radius="-1"'), 10),
    ("mesh-scale-invalid", ('scale="-1 1 1"', 'scale="0"'), 8),
    ("link-duplicate", ('<link name="c"/>', '<link name="c"/><link name="a"/>'), 15),
    ("joint-duplicate", ('joint name="k"', 'joint name="j"'), 16),
    ("joint-link-unknown", ('<parent link="a"/>', '<parent link="z"/>'), 12),
    ("joint-link-unknown", ('<child link="c"/>', '<child link="z"/>'), 16),
    ("link-two-parents", ('<child link="c"/>', '<child link="b"/>'), 16),
    ("cycle", ('<parent link="a"/>', '<parent link="c"/>'), 16),
    ("cycle", ('<parent link="b"/>', '<parent link="c"/>'), 16),
    ("disconnected", ('<link name="c"/>', '<link name="c"/>\n<link name="d"/>'), 16),
    ("mimic-cycle", ('mimic joint="j"', 'mimic joint="k"'), 16),
    ("joint-type-unsupported", ('type="continuous"', 'type="floating"'), 16),
    ("joint-type-unknown", ('type="revolute"', 'type="revolut"'), 12),
    ("text-invalid", ('link name="c"', 'link name="c&#10;d"'), 15),
    ("text-invalid", ('robot name="r"', 'robot name="r&#x202e;"'), 1),
    ("text-invalid", ('joint name="k"', f'joint name="{1001 * "k"}"'), 16),
]

XACRO = '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arm/>'
SUSPICIOUS = [
    ("number-commas", ('size="1 1 1"', 'size="1, 1, 1"')),
    ("element-repeated", ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 1"/><axis xyz="1 0 0"/>')),
    ("element-repeated", ('<box size="1 1 1"/>', '<box size="1 1 1"/><sphere radius="1"/>')),
    ("xacro-unexpanded", ('<robot name="r">', XACRO)),
]


def findings(text):
    return structure_findings(parse_xml(text.encode(), "r.urdf"), "r.urdf")


def load(text):
    data = io.BytesIO(etree.tostring(parse_xml(text.encode(), "r.urdf")))
    return yourdfpy.URDF.load(data, load_meshes=False)


def changed(change):
    if change is None:
        return '<robot name="r"/>'
    assert change[0] in SOUND
    return SOUND.replace(*change) if change[0] == "robot" else SOUND.replace(*change, 1)


@pytest.fixture
def read(tmp_path):
    """Read the text of a URDF beside its mesh."""
    (tmp_path / "m.stl").touch()

    def read(text):
        return robot_from_xml(text.encode(), tmp_path / "r.urdf", PackageFinder())

    return read


def test_a_valid_document_has_no_findings_and_loads():
    assert findings(SOUND) == ()
    assert load(SOUND).robot.name == "r"


@pytest.mark.parametrize(("code", "change", "line"), FAULTS)
def test_faults_are_reported_with_their_line(code, change, line):
    faults = [finding for finding in findings(changed(change)) if finding.code == code]
    assert faults, findings(changed(change))
    assert faults[0].severity == "error"
    assert faults[0].where.startswith(f"r.urdf:{line} ")
    if code == "joint-type-unknown":
        assert faults[0].where.endswith("joint 'j'")
        assert "did you mean 'revolute'" in faults[0].fix
    assert faults[0].fix
    assert "\n" not in faults[0].why + faults[0].fix


@pytest.mark.parametrize(("code", "change"), SUSPICIOUS)
def test_recoverable_faults_are_warnings_and_load(code, change):
    kinds = {(f.code, f.severity) for f in findings(changed(change))}
    assert kinds - {("element-unread", "info")} == {(code, "warning")}
    load(changed(change))


def test_an_unexpanded_xacro_is_reported_instead_of_the_faults_it_causes():
    text = SOUND.replace('<robot name="r">', XACRO)
    (finding,) = findings(text.replace('damping="0.1"', 'damping="${d}"'))
    assert (finding.code, finding.severity) == ("xacro-unexpanded", "error")


def test_every_cycle_is_reported_once():
    links = "".join(f'<link name="{name}"/>' for name in "abcdef")
    pairs = [("b", "c"), ("c", "b"), ("d", "e"), ("e", "f"), ("f", "d")]
    joints = "".join(
        f'<joint name="{p}{c}" type="fixed"><parent link="{p}"/><child link="{c}"/></joint>'
        for p, c in pairs
    )
    faults = findings(f'<robot name="r">{links}{joints}</robot>')
    cycles = [finding.why for finding in faults if finding.code == "cycle"]
    assert [why.partition(": ")[2] for why in cycles] == ["b -> c -> b", "f -> d -> e -> f"]


# code, what of SOUND is replaced, by what, what is left on link b: visuals, collisions, mass
REPAIRED = [
    ("element-missing", ('<mass value="1"/>', ""), (2, 2, None)),
    ("element-missing", (INERTIA, ""), (2, 2, 1.0)),
    ("element-missing", ('<geometry><box size="1 1 1"/></geometry>', ""), (1, 2, 1.0)),
    ("geometry-missing", ('<box size="1 1 1"/>', ""), (1, 2, 1.0)),
    ("geometry-unknown", ('<sphere radius="1"/>', '<plane normal="0 0 1"/>'), (2, 1, 1.0)),
    ("geometry-unknown", ('<sphere radius="1"/>', '<material/><sphere radius="1"/>'), (2, 2, 1.0)),
    ("size-not-positive", ('<sphere radius="1"', '<sphere radius="0.0"'), (2, 1, 1.0)),
    ("size-not-positive", ('size="1 1 1"', 'size="1 0 1"'), (1, 2, 1.0)),
    ("size-not-positive", ('length="2"', 'length="0"'), (2, 1, 1.0)),
    ("number-count", ('scale="-1 1 1"', 'scale="-1 1 1 1"'), (2, 2, 1.0)),
    ("mimic-unknown", ('mimic joint="j"', 'mimic joint="z"'), (2, 2, 1.0)),
]


@pytest.mark.parametrize(("code", "change", "left"), REPAIRED)
def test_faults_that_ros_tolerates_are_read_with_a_warning(read, code, change, left):
    robot = read(changed(change))
    (finding,) = robot.source_findings
    assert (finding.code, finding.severity) == (code, "warning")
    assert finding.repair
    assert finding.where.startswith("r.urdf:")
    body = robot.link("b")
    mass = None if body.inertial is None else body.inertial.mass
    assert (len(body.visuals), len(body.collisions), mass) == left
    assert robot.dof == (2 if code == "mimic-unknown" else 1)
    repaired, gone = fix(robot)
    assert finding in gone
    assert repaired.source_findings == ()
    assert f"{finding.where}: {finding.repair}" in repaired.provenance["repairs"]


@pytest.mark.parametrize("tag", ["link", "joint"])
def test_a_robot_with_too_many_elements_is_an_error(tag):
    (finding,) = findings(f'<robot name="r">{f"<{tag}/>" * 10_000}</robot>')
    assert finding.code == "robot-too-large"
    assert "10000" in finding.why
