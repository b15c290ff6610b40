"""MJCF that has no counterpart, or that reaches for other files, is refused with the reason."""

import re

import pytest

from helpers.mjcf import TWO_JOINTS, read, refusal, write
from morphgen.errors import FormatError
from morphgen.formats.mjcf.read import read_mjcf
from morphgen.formats.resolve import default_finder
from morphgen.formats.urdf.read import UnsoundError

WORLD = '<worldbody><body name="a">{}</body></worldbody>'
INERTIAL = '<inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>'
BODY = '<body name="{}"><geom size="0.1"/>{}</body>'


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<worldbody/>", "it has no bodies; expected at least one in <worldbody>"),
        (
            WORLD.format('<body><joint name="j" type="ball"/><geom size="1"/></body>'),
            "joint 'j': type ball; expected hinge or slide, such as three hinges at one place",
        ),
        (
            f'{TWO_JOINTS}<tendon><fixed name="t"><joint joint="a" coef="1"/>'
            '<joint joint="b" coef="1"/></fixed></tendon>',
            "tendon 't' couples the joints 'a', 'b', which has no counterpart; couple them by "
            "<equality><joint>, or remove the tendon and what uses it",
        ),
        (
            '<worldbody><site name="s"/><body name="a"><geom size="0.1"/><site name="e"/></body>'
            '</worldbody><tendon><spatial name="rope"><site site="s"/><site site="e"/></spatial>'
            "</tendon>",
            "tendon 'rope' is spatial, which has no counterpart; remove it and what uses it",
        ),
        (
            f'{TWO_JOINTS}<equality><connect name="loop" body1="left" body2="right" '
            'anchor="0 0 0"/></equality>',
            "equality 'loop': a connect constraint has no counterpart; expected joint constraints "
            "of degree 1",
        ),
        (
            f'{TWO_JOINTS}<equality><joint joint1="a" joint2="b" polycoef="0 1 0 2 0"/></equality>',
            "equality 'a - b': its polycoef has degree 3; expected degree 1, as of a mimic joint",
        ),
        (
            f'{TWO_JOINTS}<equality><joint joint1="a"/><joint name="e" joint1="a" joint2="b"/>'
            "</equality>",
            "equality 'e': another one couples joint 'a', too; expected one",
        ),
        (
            WORLD.format('<geom name="table" type="plane" size="1 2 3"/><geom size="1"/>'),
            "geom 'table': type plane; expected box, sphere, cylinder, capsule, ellipsoid or mesh",
        ),
        (
            '<extension><plugin plugin="mujoco.pid"/></extension><worldbody/>',
            "<extension> is refused: plugins are code",
        ),
        (
            '<asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1e10"/></asset>'
            + WORLD.format(f'{INERTIAL}<geom type="mesh" mesh="m"/>'),
            "mesh 'm': a vertex is beyond 1e+09 m",
        ),
        (
            '<worldbody><replicate count="200000"><body><geom size="1"/></body></replicate>'
            "</worldbody>",
            "<replicate> makes 400000 elements; at most 10000 are read",
        ),
        (
            f"{TWO_JOINTS}<keyframe>{'<key/>' * 1001}</keyframe>",
            "it has 1001 keyframes; at most 1000 are read",
        ),
        (
            f"<worldbody>{'<body/>' * 1001}</worldbody>",
            "has 1001 <body> elements; at most 1000 are read",
        ),
        (
            '<worldbody><body name="a" pos="0 0 nan"><geom size="0.1"/></body></worldbody>',
            "body_pos of the compiled model has the value nan; expected numbers up to 1e+20",
        ),
        (
            WORLD.format('<geom size="0.1" colour="red"/>'),
            "not MJCF that MuJoCo reads: XML Error: Schema violation: unrecognized attribute: "
            "'colour' Element 'geom'",
        ),
    ],
)
def test_content_without_a_counterpart_is_refused(content, message, tmp_path):
    assert refusal(tmp_path, content) == message


def test_couplings_with_the_rest_of_a_scene_are_refused(tmp_path):
    couplings = {
        '<equality><joint joint1="a" joint2="b"/></equality>': "equality 'a - b'",
        '<tendon><fixed name="t"><joint joint="a" coef="1"/><joint joint="b" coef="1"/></fixed>'
        '</tendon><equality><tendon name="e" tendon1="t"/></equality>': "equality 'e'",
    }
    scene = TWO_JOINTS.replace(
        '<body name="left">', '<body name="arm"><geom size="1"/><body name="left">'
    ).replace('<body name="right">', '</body><body name="right">')
    for coupling, place in couplings.items():
        assert refusal(tmp_path, scene + coupling, root_body="arm") == (
            f"{place}: joint 'b' is not of the robot"
        )


def test_includes_stay_in_the_folder(tmp_path):
    path = tmp_path / "arm" / "robot.xml"
    write(tmp_path, "<worldbody/>", "secret.xml")
    write(tmp_path / "arm", f"<worldbody>{BODY.format('tip', '')}</worldbody>", "a.xml")
    write(tmp_path / "arm", '<include file="a.xml"/>')
    assert read_mjcf(path).root.name == "tip"
    (tmp_path / "arm" / "link.xml").symlink_to(tmp_path / "secret.xml")
    elsewhere = f"is not in {tmp_path / 'arm'}, the folder"
    reasons = {"/etc/passwd": "leaves", "link.xml": elsewhere, "../secret.xml": elsewhere}
    for file, reason in reasons.items():
        write(tmp_path / "arm", f'<include file="{file}"/>')
        with pytest.raises(FormatError, match=re.escape(reason)):
            read_mjcf(path)
    with pytest.raises(FormatError, match="no bodies"):
        read_mjcf(path, default_finder(root=tmp_path))


def test_entities_are_refused(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text('<!DOCTYPE x [<!ENTITY e "lol">]><mujoco model="&e;"/>', encoding="utf-8")
    with pytest.raises(FormatError, match="has a DOCTYPE; a robot description needs none"):
        read_mjcf(path)


def test_user_data_is_left_out(tmp_path):
    content = (
        f'<worldbody><body name="a" user="{"1 " * 100_000}">{"<body/>" * 900}</body></worldbody>'
    )
    assert len(read(tmp_path, content).links) == 901


def test_includes_end(tmp_path):
    write(tmp_path, '<include file="robot.xml"/>')
    with pytest.raises(FormatError, match=r"robot\.xml: is included twice"):
        read_mjcf(tmp_path / "robot.xml")
    for k in range(50):
        write(tmp_path, f'<include file="f{k + 1}.xml"/>', f"f{k}.xml")
    with pytest.raises(FormatError, match="includes are nested deeper than 40 levels"):
        read_mjcf(tmp_path / "f0.xml")


def test_nested_includes_are_relative_to_the_main_file_or_their_own(tmp_path):
    write(tmp_path, '<include file="sub/a.xml"/>')
    write(tmp_path, '<include file="b.xml"/>', "sub/a.xml")
    write(tmp_path, f"<worldbody>{BODY.format('deep', '')}</worldbody>", "sub/b.xml")
    assert read_mjcf(tmp_path / "robot.xml").root.name == "deep"


def test_all_missing_meshes_are_listed(tmp_path):
    with pytest.raises(UnsoundError) as error:
        read(
            tmp_path,
            '<compiler meshdir="meshes"/><asset><mesh file="a.stl"/><mesh name="b" '
            'file="../../b.stl"/></asset><worldbody/>',
        )
    first, second = error.value.findings
    assert first.where == f"{tmp_path / 'robot.xml'}: mesh 'a'"
    assert "'meshes/a.stl' does not exist" in first.why
    assert f"leaves {tmp_path.parent}" in second.why or "does not exist" in second.why


def test_files_of_textures_and_height_fields_are_not_read(tmp_path):
    robot = read(
        tmp_path,
        """<asset><texture name="t" type="2d" file="missing.png"/><material name="m" texture="t"/>
        <hfield name="h" file="missing.png" size="1 1 1 1"/></asset>
        <worldbody><geom type="hfield" hfield="h"/>
        <body name="a"><geom size="1" material="m"/></body></worldbody>""",
    )
    assert robot.root.visuals[0].rgba == (1, 1, 1, 1)
