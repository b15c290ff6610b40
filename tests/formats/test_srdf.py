"""SRDF: exact round trips, refusals, and the pairs that it disables."""

import re
from dataclasses import replace

import pytest

from helpers.robots import arm
from morphgen.errors import FormatError
from morphgen.formats.srdf import (
    BoundingSphere,
    Chain,
    EndEffector,
    Group,
    GroupState,
    JointProperty,
    LinkPair,
    LinkSpheres,
    PassiveJoint,
    Srdf,
    UncheckedLink,
    VirtualJoint,
    disabled_link_pairs,
    parse_srdf,
    read_srdf,
    srdf_text,
    with_disabled_pairs,
)

FULL = Srdf(
    'arm & "hand"',
    (VirtualJoint("fixed_base", "fixed", "world", "base"),),
    (
        Group("arm", chains=(Chain("base", "tool"),)),
        Group("hand", ("left", "right"), ("left",)),
        Group("all", subgroups=("arm", "hand")),
    ),
    (
        GroupState("home", "arm", (("shoulder", (0.1 + 0.2,)), ("elbow", (-1e-17,)))),
        GroupState("away", "all", (("floating", (1.0, 2.0, 1 / 3, 0.0, 0.0, 0.0, 1.0)),)),
    ),
    (EndEffector("hand", "slider", "hand", "arm"), EndEffector("other", "slider", "hand")),
    (PassiveJoint("right"),),
    (JointProperty("floating", "motion_model", "diff_drive"),),
    (
        LinkSpheres(
            "upper",
            (BoundingSphere((0.1, -0.2, 1 / 7), 0.05), BoundingSphere((0.0, 0.0, 0.0), 0.0)),
        ),
        LinkSpheres("lower", ()),
    ),
    (UncheckedLink("right"),),
    (LinkPair("base", "right"),),
    (LinkPair("base", "upper", "Adjacent"), LinkPair("lower", "upper")),
)


def document(content):
    return f'<robot name="arm">\n{content}\n</robot>'.encode()


def test_written_content_is_read_back_exactly(tmp_path):
    text = srdf_text(FULL, "found by counting")
    path = tmp_path / "arm.srdf"
    path.write_text(text)
    assert "<!-- found by counting -->\n  <disable_collisions" in text
    assert read_srdf(path) == FULL
    assert srdf_text(read_srdf(path), "found by counting") == text
    assert parse_srdf(srdf_text(Srdf("r")).encode(), "r") == Srdf("r")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<grup/>", "x:2: <grup> is unknown in <robot>; did you mean 'group'? valid:"),
        ('<group name="g"><chain base_link="a"/></group>', "<chain>: missing attribute 'tip_link'"),
        ('<group name="g"><link/></group>', "x:2: <link>: missing attribute 'name'"),
        ('<group name="g"><link name="a"><b/></link></group>', "<b> is unknown in <link>"),
        ('<group name="g"/><group name="g"/>', "x: two groups are named 'g'"),
        ('<group name="g" nmae="h"/>', "<group>: unknown attribute 'nmae'; did you mean 'name'?"),
        (
            '<group_state name="home" group="arm"/>',
            "x: group_state 'home' names the unknown group 'arm'; valid: (none)",
        ),
        (
            '<group name="g"/><group_state name="s" group="g"><joint name="j" value="a"/>'
            "</group_state>",
            "x:2: <joint>: value 'a'; expected finite numbers",
        ),
        (
            '<group name="g"/><end_effector name="e" parent_link="l" group="g" parent_group="h"/>',
            "x: end_effector 'e' names the unknown group 'h'; valid: g",
        ),
        (
            '<link_sphere_approximation link="l"><sphere center="0 0" radius="1"/>'
            "</link_sphere_approximation>",
            "x:2: <sphere>: center '0 0'; expected 3 finite numbers",
        ),
        (
            '<link_sphere_approximation link="l"><sphere center="0 0 0" radius="-1"/>'
            "</link_sphere_approximation>",
            "x:2: <sphere>: radius -1; expected 0 or more",
        ),
        (
            '<link_sphere_approximation link="l"><sphere center="0 0 0" radius="nan"/>'
            "</link_sphere_approximation>",
            "x:2: <sphere>: radius 'nan'; expected a finite number",
        ),
        ('<disable_collisions link1="a"/>', "x:2: <disable_collisions>: missing attribute 'link2'"),
    ],
)
def test_invalid_content_is_refused(content, message):
    with pytest.raises(FormatError, match=re.escape(message)):
        parse_srdf(document(content), "x")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"<robot name='a'>", "x:1:"),
        (b"<sdf/>", "x: root element <sdf>; expected <robot>"),
        (b"<robot/>", "x:1: <robot>: missing attribute 'name'"),
        (b'<!DOCTYPE r [<!ENTITY e "a">]><robot name="r"/>', "x: has a DOCTYPE"),
    ],
)
def test_other_documents_are_refused(data, message):
    with pytest.raises(FormatError, match=re.escape(message)):
        parse_srdf(data, "x")


def test_disabled_pairs_become_ignored_ones():
    robot = replace(arm(), ignore_pairs=(("left", "right"),))
    disabled = (LinkPair("upper", "base", "Adjacent"), LinkPair("tool", "base", "Never"))
    result = with_disabled_pairs(robot, Srdf("arm", disabled_pairs=disabled))
    assert result.ignore_pairs == (("base", "upper"), ("left", "right"))
    unknown = Srdf("arm", disabled_pairs=(LinkPair("uper", "base"),))
    message = "a.srdf: robot 'arm' has no link 'uper'; did you mean 'upper'? valid: base, left,"
    with pytest.raises(FormatError, match=re.escape(message)):
        with_disabled_pairs(robot, unknown, "a.srdf")


def test_unchecked_links_collide_only_in_enabled_pairs():
    srdf = Srdf(
        "r",
        unchecked_links=(UncheckedLink("c"),),
        enabled_pairs=(LinkPair("a", "c"),),
        disabled_pairs=(LinkPair("b", "a"),),
    )
    assert disabled_link_pairs(srdf, ("a", "b", "c", "d")) == (("a", "b"), ("b", "c"), ("c", "d"))
