"""XML as loaders read it, the structure of a description, and references that it makes."""

import io
import os
from contextlib import nullcontext
from pathlib import Path

import pytest
import yourdfpy
from lxml import etree

from morphgen.checks import fix
from morphgen.errors import FormatError
from morphgen.formats.resolve import (
    PackageFinder,
    default_finder,
    distribution_file,
    is_installed,
    require_allowed_text,
    resolve_uri,
)
from morphgen.formats.urdf.read import robot_from_xml
from morphgen.formats.urdf.schema import structure_findings
from morphgen.formats.xacro.evaluator import RefusedError
from morphgen.formats.xml import parse_description, parse_xml


def failure(data):
    with pytest.raises(FormatError) as caught:
        parse_xml(data, "robot.urdf")
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_comments_and_processing_instructions_are_removed():
    root = parse_xml(b"<?p q?><robot><!-- a --><link/><?x y?>te<!-- b -->xt</robot>", "robot.urdf")
    assert [child.tag for child in root] == ["link"]
    assert root[0].tail == "text"


def test_what_is_not_one_xml_document_is_an_error_with_line_and_column():
    message = failure(b"<robot>\n  <link>\n</robot>")
    assert message.startswith("robot.urdf:3:")
    assert "link" in message
    assert "column" not in message
    for data in (b"", b"   ", b"not xml", b"\x00\x01", b"<robot/><robot/>"):
        assert failure(data).startswith("robot.urdf:1:")


BOMB = "".join(f'<!ENTITY i{n} "{f"&i{n - 1};" * 20 if n else "lol"}">' for n in range(10))


@pytest.mark.parametrize(
    "text",
    [
        "<!DOCTYPE r><r/>",
        '<!DOCTYPE r SYSTEM "other.dtd"><r/>',
        '<!DOCTYPE r [<!ENTITY x SYSTEM "file://SECRET">]><r>&x;</r>',
        f"<!DOCTYPE r [{BOMB}]><r>&i9;</r>",
        f'<!DOCTYPE r [{BOMB}]><r a="&i9;"/>',
    ],
)
def test_a_doctype_is_an_error_and_entities_are_not_read(text, tmp_path):
    (tmp_path / "secret").write_text("treasure")
    message = failure(text.replace("SECRET", str(tmp_path / "secret")).encode())
    assert "treasure" not in message
    assert "DOCTYPE" in message or "&i9;" not in text or "entity" in message.lower()


def test_the_declared_encoding_is_respected():
    data = '<?xml version="1.0" encoding="ISO-8859-1"?><robot name="é"/>'.encode("latin-1")
    assert parse_xml(data, "robot.urdf").get("name") == "é"
    assert parse_xml('<robot name="é"/>'.encode("utf-16"), "robot.urdf").get("name") == "é"


@pytest.mark.parametrize(
    ("start", "codes"),
    [
        (b'<?xml version="0.0"?>', ["xml-declaration"]),
        (b'\n\r\n <?xml version="1.0"?>', ["xml-declaration"]),
        (b'\xef\xbb\xbf\n<?xml version="0.0" encoding="utf-8" ?>', ["xml-declaration"]),
        (b'\xef\xbb\xbf<?xml version="1.0"?>', []),
        (b'<?xml version="1.1"?>', []),
        (b"\n", []),
    ],
)
def test_invalid_xml_declarations_are_repaired_with_a_warning(start, codes):
    root, findings = parse_description(start + b'<robot name="\xc3\xa9"><l/></robot>', "r.urdf")
    assert root.get("name") == "é"
    assert [finding.code for finding in findings] == codes
    assert all(finding.severity == "warning" and finding.repair for finding in findings)
    assert root[0].sourceline == start.count(b"\n") + 1


def test_undeclared_prefixes_are_repaired():
    uses = b'<drake:a/><l gazebo:b="1" name="x"/>' * 200
    text = b"<!-- <no:t> > --><?p ?><robot>" + uses + b"<last:c/></robot>"
    root, findings = parse_description(text, "r.urdf")
    assert root.findall("l")[199].get("name") == "x"
    assert [finding.code for finding in findings] == ["prefix-undeclared"] * 3
    assert [finding.why.split("'")[1] for finding in findings] == ["drake", "gazebo", "last"]


def test_a_prefix_that_cannot_be_declared_is_refused():
    message = r"^x\.urdf:1:9: not well-formed XML: error parsing attribute name"
    with pytest.raises(FormatError, match=message):
        parse_description(b'<a:model="m"><b/></a:model>', "x.urdf")


def test_other_errors_are_found_despite_undeclared_prefixes():
    with pytest.raises(FormatError, match=r"^r.urdf:1:\d+: "):
        parse_description(b"<robot><drake:a></robot>", "r.urdf")
    with pytest.raises(FormatError, match="DOCTYPE"):
        parse_description(
            b'\n<?xml version="0.0"?><!DOCTYPE r [<!ENTITY e "x">]><r a:b="1">&e;</r>', "r.urdf"
        )


def described(body=b"", name=b"r", before=b"", after=b""):
    return before + b'<robot name="' + name + b'">\n' + body + b'<link name="l"/></robot>' + after


# What each loader does was tried: Pinocchio 4.1, MuJoCo 4.0, PyBullet 3.2.7 (all three parse by
# tinyxml2) and yourdfpy 0.0.60 (libxml2's recovery).
@pytest.mark.parametrize(
    ("data", "name", "repair"),
    [
        (described(b"<!-- a -- b -->"), "r", "comments with '--'"),
        (described(b"<!-- a --->"), "r", "comments with '--'"),
        (described(before=b"<!-- a -- b -->"), "r", "comments with '--'"),
        (described(b"<!-- \x01 -->"), "r", "comments with '--'"),
        (described(name=b"Arm & Hand"), "Arm & Hand", "bare '&'"),
        (described(b" a & b "), "r", "bare '&'"),
        (described(name=b"a&nbsp;b"), "a&nbsp;b", "bare '&'"),
        (described(name=b"a&amp b &lt;"), "a&amp b <", "bare '&'"),
        (described(after=b"\nthe end"), "r", "text after"),
        (described(after=b"</robot>"), "r", "text after"),
        (described(after=b'<robot name="second"><link name="m"/></robot>'), "r", "text after"),
        (described(after=b"<!-- a -- b -->"), "r", "comments with '--'"),
        (described(before=b"junk"), "r", "text before"),
        (described(before=b"\xef\xbb\xbf\xef\xbb\xbf"), "r", "text before"),
        (described(name=b"a<b>"), "a<b>", "'<' in an attribute"),
        (described(name=b"a\x01b"), "a\ufffdb", "U+FFFD"),
        (described(b" ]]> "), "r", "']]>' in a text"),
        (described(name=b"t\xefp"), "t\xefp", "read as latin1"),
        (described(b"<!-- t\xefp -->"), "r", "read as latin1"),
        (described(before=b'<?xml version="1.0" encoding="foo-8"?>'), "r", "read as utf-8"),
        (described(before=b'<?xml version="1.0" encoding="utf-16"?>'), "r", "read as utf-8"),
        (
            described(before=b'<?xml version="1.0" encoding="us-ascii"?>', name=b"t\xc3\xafp"),
            "t\xefp",
            "read as utf-8",
        ),
        (described(before=b'<?xml encoding="utf-8"?>'), "r", "declaration"),
        (described(b'<?xml version="1.0"?>'), "r", "declaration"),
    ],
)
def test_what_loaders_read_although_it_is_not_xml_is_read_with_a_warning(data, name, repair):
    failure(data)
    root, (finding,) = parse_description(data, "robot.urdf")
    assert root.get("name") == name
    assert [link.get("name") for link in root.iterfind("link")] == ["l"]
    assert root.find("link").sourceline == 2
    assert finding.severity == "warning"
    assert repair in finding.repair
    assert finding.where.startswith("robot.urdf:")


def test_a_declared_encoding_counts_in_a_document_that_is_repaired():
    text = '<?xml version="1.0" encoding="{}"?><robot name="{}"/><!-- a -- b -->'
    for encoding, name in (("ISO-8859-1", "é"), ("gb2312", "机器人"), ("utf-16", "é")):
        root, _ = parse_description(text.format(encoding, name).encode(encoding), "r.urdf")
        assert root.get("name") == name


def test_repairs_of_a_kind_are_one_finding_with_a_count():
    data = described(b"\n<!-- a -- b -->" * 3 + b" x & y ")
    _, (comments, ampersand) = parse_description(data, "r.urdf")
    assert "(3 times)" in comments.why
    assert comments.where == "r.urdf:3 document"
    assert "times" not in ampersand.why


@pytest.mark.parametrize(
    "data",
    [
        described(b'<link name="a" name="b"/>'),
        described(b'<a b="1"c="2"/>'),
        described(b'<a b="<"/>' * 100),
        described(b"< a/>"),
        described(b"<!foo>"),
        described(b"<link name/>"),
        described(b"<link name=a/>"),
        described(b"a < b"),
        described(b"<a></b>"),
        described()[:-8],
        described(b"<!-- a"),
        described(b"<!--" * 2**18),  # in hours, if each is searched for an end
        described(b"<? " * 2**18),
        described(b"<![CDATA[ a"),
        b"<!-- a -- b -->",
    ],
)
def test_what_has_two_meanings_stays_an_error(data):
    with pytest.raises(FormatError, match=r"^robot.urdf:\d+:\d+: "):
        parse_description(data, "robot.urdf")


@pytest.mark.parametrize("fault", [b"<!-- a -- b -->", b"x & y", b'<a b="<"/>', b""])
@pytest.mark.parametrize("doctype", [b"<!DOCTYPE r>", b'<!doctype r [<!ENTITY e "x">]>'])
@pytest.mark.parametrize("place", ["before", "body", "after"])
def test_a_doctype_is_an_error_beside_other_faults(fault, doctype, place):
    pieces = {"before": b"", "body": b"", "after": b"", place: doctype}
    body = pieces.pop("body") + fault
    with pytest.raises(FormatError, match="DOCTYPE"):
        parse_description(described(body, **pieces), "robot.urdf")


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


NOWHERE = PackageFinder()


def touch(path, text=""):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def failure_of(uri, base, finder=NOWHERE):
    with pytest.raises(FormatError) as caught:
        resolve_uri(uri, base, finder)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture
def urdf(tmp_path):
    return touch(tmp_path / "ws" / "arm_description" / "urdf" / "arm.urdf")


@pytest.mark.parametrize(
    ("file", "uri"),
    [
        ("arm_description/meshes/a.stl", "package://arm_description/meshes/a.stl"),
        ("arm_description/meshes/a.stl", "package:///arm_description/meshes/a.stl"),
        ("arm_description/meshes/a.stl", "model://arm_description/meshes/a.stl"),
        ("arm_description/a.stl", "package://other_name/a.stl"),  # by its package.xml
        ("hand_description/a.stl", "package://hand_description/a.stl"),  # beside
        ("arm_description/a.stl", "package://arm_support/a.stl"),  # a copy without ROS's suffix
        ("root/a.stl", "package://root/a.stl"),
        ("root/one/a.stl", "package://one/a.stl"),
        ("root/repository/src/a.stl", "package://two/a.stl"),  # two levels down
        ("arm_description/urdf/my mesh.stl", "my%20mesh.stl"),
        ("arm_description/urdf/100%20.stl", "100%20.stl"),
        ("arm_description/urdf/my mesh.stl", r"..\urdf\my mesh.stl"),
    ],
)
def test_files_are_found_by_package_and_spelling(file, uri, tmp_path):
    folder = "arm" if "arm_support" in uri else "arm_description"
    urdf = touch(tmp_path / "ws" / folder / "urdf" / "arm.urdf")
    mesh = touch(tmp_path / "ws" / file.replace("arm_description", folder))
    manifests = {"other_name": urdf.parents[1], "two": tmp_path / "ws" / "root/repository/src"}
    for name, path in manifests.items():
        if name in uri:
            text = f"<package format='3'>\n <name> {name} </name></package>"
            touch(path / "package.xml", text)
    assert resolve_uri(uri, urdf, PackageFinder((tmp_path / "ws" / "root",))) == mesh


@pytest.mark.parametrize(
    ("uri", "reason"),
    [
        ("package://lost/a.stl", "package 'lost' not found: looked "),
        *((f"package://{name}/id", "not a package name") for name in (".ssh", "..", "a b", "%2e")),
        ("package://etc/hostname", "not found"),  # the root of the file system is not searched
        *((uri, repr(uri)) for uri in ("", " ", "http://host/a.stl", "package://", "C:/a.stl")),
        ("../urdf", "does not exist"),
        ("base.stl", "did you mean 'Base.STL'?"),
        ("../../secret.stl", "leaves"),
        ("%2e%2e/%2e%2e/secret.stl", "leaves"),
        ("package://arm_description/../secret.stl", "leaves"),
    ],
)
def test_other_references_are_refused(uri, reason, urdf):
    touch(urdf.parents[2] / "secret.stl")
    touch(urdf.parent / "Base.STL")
    message = failure_of(uri, urdf, PackageFinder((urdf.parents[2] / "root",)))
    assert reason in message
    assert message.startswith(f"{urdf}: ")


def test_a_plain_folder_above_the_description_is_no_package(tmp_path):
    """A stranger's file in a download folder must not read from the user's home."""
    home = tmp_path / "alice"
    urdf = touch(home / "Downloads" / "robot" / "robot.urdf")
    touch(home / "secret" / "part.stl")
    for uri in ("package://alice/secret/part.stl", "package://secret/part.stl"):
        assert "not found" in failure_of(uri, urdf)
    beside = touch(home / "Downloads" / "hand" / "part.stl")
    assert resolve_uri("package://hand/part.stl", urdf, NOWHERE) == beside
    touch(home / "secret" / "package.xml", "<package><name>other</name></package>")
    assert resolve_uri("package://secret/part.stl", urdf, NOWHERE).is_file()


def test_paths_start_at_the_folder_of_the_description_and_stay_near(urdf, tmp_path, monkeypatch):
    own_file = touch(urdf.parent / "a.stl")
    beside = touch(urdf.parent.parent / "meshes" / "b.stl")
    packaged = touch(tmp_path / "opt" / "hand_description" / "a.stl")
    private = touch(tmp_path / "elsewhere" / "a.stl")
    monkeypatch.chdir(tmp_path / "elsewhere")
    for uri in ("a.stl", "file://a.stl", str(own_file), own_file.as_uri()):
        assert resolve_uri(uri, urdf, NOWHERE) == own_file
    assert resolve_uri("../meshes/b.stl", urdf, NOWHERE) == beside
    assert resolve_uri(packaged.as_uri(), urdf, NOWHERE) == packaged
    assert "leaves" in failure_of(private.as_uri(), urdf)
    assert resolve_uri(str(private), urdf, PackageFinder((private.parent,))) == private


def test_ros_environment_is_searched_after_the_given_root(tmp_path, urdf, monkeypatch):
    classic = touch(tmp_path / "classic" / "one" / "a.stl")
    ament = touch(tmp_path / "prefix" / "share" / "two" / "a.stl")
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "classic"))
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "prefix"))
    assert resolve_uri("package://one/a.stl", urdf, default_finder()) == classic
    assert resolve_uri("package://two/a.stl", urdf, default_finder()) == ament
    mine = touch(tmp_path / "mine" / "one" / "a.stl")
    finder = default_finder(root=tmp_path / "mine")
    assert resolve_uri("package://one/a.stl", urdf, finder) == mine


def test_only_files_that_lie_in_an_installed_package_are_installed(tmp_path):
    file = distribution_file("rtb-data", "rtbdata/xacro/ur_description/urdf/ur5_robot.urdf.xacro")
    (tmp_path / "link.xacro").symlink_to(file)
    mine = touch(tmp_path / "mine.xacro")
    through = file.parent / os.path.relpath(mine.resolve(), file.parent.resolve())
    assert through.is_file()
    found = [is_installed(each) for each in (file, tmp_path / "link.xacro", mine, through)]
    assert found == [True, True, False, False]


def test_distribution_files_are_found_and_missing_ones_are_errors(monkeypatch):
    path = distribution_file("rtb-data", "rtbdata/xacro/ur_description/urdf/ur5_robot.urdf.xacro")
    assert path.is_absolute()
    assert path.is_file()
    with pytest.raises(FormatError, match=r"did you mean 'ur5_robot.urdf.xacro'"):
        distribution_file("rtb-data", "rtbdata/xacro/ur_description/urdf/ur5_robott.urdf.xacro")
    for relative in ("../x", "/etc/hostname", "rtbdata/../../x"):
        with pytest.raises(FormatError, match="not a path below"):
            distribution_file("rtb-data", relative)
    monkeypatch.setattr("sys.path", [])
    with pytest.raises(FormatError, match=r"pip install rtb-data==1\.1\.0"):
        distribution_file("rtb-data", "rtbdata/x.urdf")


def test_a_symbolic_link_cannot_leave_the_tree(tmp_path, urdf):
    private = touch(tmp_path / "private" / "a.stl")
    inside = touch(urdf.parent.parent / "meshes" / "b.stl")
    (urdf.parent / "out.stl").symlink_to(private)
    (urdf.parent / "in.stl").symlink_to(inside)
    (urdf.parent / "folder").symlink_to(private.parent)
    for uri in ("out.stl", "folder/a.stl", "package://arm_description/urdf/out.stl"):
        assert "is a symbolic link that leaves" in failure_of(uri, urdf)
    assert resolve_uri("in.stl", urdf, NOWHERE) == urdf.parent / "in.stl"
    assert resolve_uri("out.stl", urdf, default_finder(root=private.parent)).name == "out.stl"


def test_links_between_packages_are_followed(tmp_path, urdf):
    """``colcon build --symlink-install`` makes such."""
    source = touch(tmp_path / "src" / "arm" / "meshes" / "a.stl")
    touch(tmp_path / "src" / "arm" / "package.xml", "<package><name>arm</name></package>")
    (urdf.parent / "a.stl").symlink_to(source)
    assert resolve_uri("a.stl", urdf, NOWHERE) == urdf.parent / "a.stl"


def test_a_symlinked_description_may_reference_files_beside_its_target(tmp_path):
    """Download caches store every file as a link into a folder of blobs."""
    store, shown = tmp_path / "store" / "blobs", tmp_path / "shown" / "snapshot"
    shown.mkdir(parents=True)
    for name in ("robot.urdf", "a.stl"):
        touch(store / f"{name}-blob")
        (shown / name).symlink_to(store / f"{name}-blob")
    assert resolve_uri("a.stl", shown / "robot.urdf", NOWHERE) == shown / "a.stl"


def test_a_root_extends_the_permitted_tree(tmp_path):
    urdf = touch(tmp_path / "data" / "robots" / "x" / "x.urdf")
    mesh = touch(tmp_path / "data" / "meshes" / "a.stl")
    packaged = touch(tmp_path / "data" / "hand" / "b.stl")
    touch(tmp_path / "c.stl")
    assert "or name the folder" in failure_of("../../meshes/a.stl", urdf)
    finder = default_finder(root=tmp_path / "data")
    assert resolve_uri("../../meshes/a.stl", urdf, finder) == mesh
    assert resolve_uri("package://hand/b.stl", urdf, finder) == packaged
    assert "leaves" in failure_of("../../../c.stl", urdf, finder)
    assert resolve_uri("meshes/a.stl", urdf, finder) == mesh, "a name from the root, too"
    near = touch(urdf.parent / "meshes" / "a.stl")
    assert resolve_uri("meshes/a.stl", urdf, finder) == near, "the own folder comes first"
    with pytest.raises(FormatError, match="no such folder"):
        default_finder(root=tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("file", "finder", "is_allowed"),
    [
        ("downloads/config/a.yaml", {}, True),
        ("ws/arm/a.yaml", {}, True),
        ("secret.yaml", {}, False),
        ("hand_description/a.yaml", {}, False),
        ("secret.yaml", {"root": Path()}, True),
    ],
)
def test_text_files_are_limited_to_own_folder_packages_and_roots(
    file, finder, is_allowed, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    touch(tmp_path / "ws" / "arm" / "package.xml", "<package><name>arm</name></package>")
    path, finder = touch(tmp_path / file), default_finder(**finder)
    for place in ("downloads", "downloads/urdf"):
        origin = touch(tmp_path / place / "x.xacro")
        with nullcontext() if is_allowed else pytest.raises(RefusedError):
            require_allowed_text(path, finder, origin, origin)
