"""Decoding tokens to robots, and errors of invalid tokens."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import morphgen
from helpers.robots import arm
from helpers.tokens import arm_tokens, field_of, shapes_of
from morphgen.benchmark.tokens import normalize_positions, pad_tokens, robot_from_tokens, tokens
from morphgen.errors import BenchmarkError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.grammar.library import default_library
from morphgen.model import rotation
from morphgen.model.geometry import Box, Capsule, Cylinder, Pose, Shape, Sphere
from morphgen.model.kinematics import forward_kinematics, random_configurations
from morphgen.model.robot import Frame, Joint, Link, Mimic, Robot

COMPOSED = (
    "arm=ur5 ee=plane",
    "arm=kinova_gen3 ee=robotiq_2f85",
    "base=planar arm=lwr ee=stick",
    "base=pedestal left.arm=ur5 left.ee=stick right.arm=lwr right.ee=cube",
    "chain beads=3",
    "arm3",
)

NUMBERS = st.floats(-2, 2)
SIZES = st.floats(1e-4, 3)
UNIT3 = st.tuples(NUMBERS, NUMBERS, NUMBERS).filter(lambda v: math.hypot(*v) > 0.1)
QUATERNIONS = (
    st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS)
    .filter(lambda q: math.hypot(*q) > 0.1)
    .map(rotation.normalize)
)
POSES = st.builds(Pose, st.tuples(NUMBERS, NUMBERS, NUMBERS), QUATERNIONS)
SHAPES = st.builds(
    Shape,
    st.one_of(
        st.builds(Sphere, SIZES),
        st.builds(Cylinder, SIZES, SIZES),
        st.builds(Capsule, SIZES, SIZES),
        st.builds(Box, st.tuples(SIZES, SIZES, SIZES)),
    ),
    POSES,
)
LIMITS = st.none() | st.tuples(st.floats(-7, 3), st.floats(0.01, 4)).map(
    lambda pair: (pair[0], pair[0] + pair[1])
)
KINDS = st.sampled_from(["revolute", "continuous", "prismatic", "fixed"])


@st.composite
def bodies(draw):
    """A small robot, shapes of some of its links, and two configurations."""
    n = draw(st.integers(1, 7))
    joints = []
    for i in range(1, n):
        mimic = None
        leaders = [joint.name for joint in joints if joint.is_movable]
        if leaders and draw(st.booleans()):
            mimic = draw(st.builds(Mimic, st.sampled_from(leaders), NUMBERS, NUMBERS))
        joints.append(
            Joint(
                f"j{i}",
                draw(KINDS),
                f"l{draw(st.integers(0, i - 1))}",
                f"l{i}",
                draw(POSES),
                draw(UNIT3),
                draw(LIMITS),
                mimic=mimic,
            )
        )
    links = tuple(Link(f"l{i}") for i in range(n))
    tool = draw(st.none() | st.integers(0, n - 1))
    frames = () if tool is None else (Frame("tool", f"l{tool}", draw(POSES)),)
    dof = sum(joint.is_independent for joint in joints)
    q = draw(st.lists(st.floats(-4, 4), min_size=2 * dof, max_size=2 * dof))
    robot = Robot("r", links, tuple(joints), frames, tuple(q[:dof]))
    shapes = {link.name: draw(SHAPES) for link in links if draw(st.booleans())}
    return robot, shapes, np.reshape(q, (2, dof))


def assert_read_back(token_array, **options):
    back, shapes = robot_from_tokens(token_array, "back", **options)
    again = tokens(back, shapes, **options)
    np.testing.assert_allclose(again, token_array, rtol=0, atol=1e-9)
    assert shapes == shapes_of(back)
    return back


@settings(deadline=None)
@given(bodies())
def test_decoded_robots_have_the_same_tokens(body):
    robot, shapes, q = body
    for token_array in tokens(robot, shapes, q):
        back = assert_read_back(token_array)
        assert back.parents == robot.parents
        assert back.movable_joints == robot.movable_joints
        assert {frame.link[4:] for frame in back.frames} == {f.link[1:] for f in robot.frames}
        assert {name[4:] for name in shapes_of(back)} == {name[1:] for name in shapes}
        for name in ("geometry pose", "joint origin"):
            assert (field_of(token_array, name)[:, 3] >= 0).all()


@pytest.mark.slow
@settings(deadline=None)
@given(bodies())
def test_decoded_robots_have_the_same_link_poses_at_zero(body):
    robot, shapes, _ = body
    joints = tuple(replace(joint, mimic=None) for joint in robot.joints)
    robot = replace(robot, joints=joints, home=(0.0,) * sum(j.is_movable for j in joints))
    back, _ = robot_from_tokens(tokens(robot, shapes), "back")
    ours, theirs = (forward_kinematics(body, np.zeros(body.dof)) for body in (robot, back))
    np.testing.assert_allclose(theirs, ours, atol=1e-9)


@pytest.mark.parametrize("request_", COMPOSED)
def test_composed_robots_are_decoded(request_):
    robot = morphgen.compose(request_)
    shapes = token_shapes(robot, default_library().folders)
    q = random_configurations(robot, 5, np.random.default_rng(0))
    for token_array in (
        *tokens(robot, shapes, q, max_links=40),
        tokens(robot, shapes, max_links=40),
    ):
        back = assert_read_back(token_array, max_links=40)
        assert back.dof == len(robot.movable_joints)
        assert len(back.frames) == 1
    assert [tuple(value) for value in field_of(token_array, "joint axis")[1:]] == [
        pytest.approx(joint.unit_axis if joint.is_movable else (0, 0, 0)) for joint in robot.joints
    ]


def test_decoded_robots_move_in_normalized_positions():
    back, shapes = robot_from_tokens(arm_tokens(), "back")
    assert back.name == "back"
    assert [link.name for link in back.links] == [f"link{i}" for i in range(6)]
    assert [joint.name for joint in back.joints] == [f"joint{i}" for i in range(1, 6)]
    assert {joint.limits for joint in back.joints} == {(-1.0, 1.0)}
    assert back.home == pytest.approx((0.2, 0.25, -0.5, 0.0, 0.0))
    np.testing.assert_allclose(normalize_positions(back, back.home), back.home)
    assert back.frames == (Frame("tool", "link3"),)
    assert shapes["link0"] == Shape(Box((0.1, 0.1, 0.04)))


def test_single_precision_tokens_are_decoded():
    token_array = arm_tokens()
    back, shapes = robot_from_tokens(token_array.astype(np.float32), "back")
    np.testing.assert_allclose(tokens(back, shapes), token_array, atol=2e-5)


def spoilt(row, column, value):
    token_array = arm_tokens()
    token_array[row, column] = value
    return token_array


@pytest.mark.parametrize(
    ("token_array", "message"),
    [
        (spoilt(2, 20, math.nan), "link 2: joint axis: [1, nan, 0] is not finite"),
        (spoilt(0, 0, math.inf), "link 0: link index: [inf] is not finite"),
        (np.zeros((3, 47)), "shape (3, 47); expected (n_links, 48)"),
        (np.zeros((2, 3, 48)), "shape (2, 3, 48); expected (n_links, 48)"),
        (np.zeros((0, 48)), "shape (0, 48); expected (n_links, 48)"),
        (np.zeros((24, 48)), "has 24 links, more than max_links 23"),
        (spoilt(2, 0, 0.5), "link 2: link index: 0.5, not 2/22: made with another max_links"),
        (arm_tokens()[[0, 2, 1, 3, 4, 5]], "link 1: link index: 0.0909091, not 1/22"),
        (pad_tokens(arm_tokens(), 8)[0], "link 6: link index: 0, not 6/22: "),
        (spoilt(0, 1, 0.0), "link 0: parent index: 0 makes no tree; expected -1/22"),
        (spoilt(1, 1, -1 / 22), "link 1: parent index: -0.0454545 makes no tree; expected 0/22"),
        (
            spoilt(3, 1, 3 / 22),
            "link 3: parent index: 0.136364 makes no tree; expected k/22, k = 0",
        ),
        (spoilt(3, 1, 1.5 / 22), "link 3: parent index: 0.0681818 makes no tree"),
        (spoilt(3, 3, 0.0), "link 3: end-effector: [1, 0, 1, 1] is neither four times 0 nor"),
        (spoilt(1, slice(2, 6), 2.0), "link 1: end-effector: [2, 2, 2, 2] is neither"),
        (spoilt(5, slice(2, 6), 1.0), "link 5: end-effector: link 3 is flagged, too"),
        (
            spoilt(0, 6, 1.0),
            "geometry: [1, 0, 1] is not one-hot over [sphere, cylinder, box]",
        ),
        (spoilt(0, 8, 0.0), "link 0: geometry: [0, 0, 0] is not one-hot"),
        (spoilt(0, 9, -0.1), "link 0: geometry: sizes [-0.1, 0.1, 0.04] are not all positive"),
        (
            spoilt(1, 9, 0.03),
            "link 1: geometry: a cylinder has 2 times its radius, not [0.03, 0.02]",
        ),
        (spoilt(0, slice(6, 9), (1, 0, 0)), "link 0: geometry: a sphere has 3 times its radius"),
        (
            spoilt(0, slice(6, 12), 0.0),
            "link 0: geometry pose: it is not zero, but the link has no",
        ),
        (
            spoilt(1, 15, 0.9),
            "link 1: geometry pose: the quaternion [0.9, 0, 0, 0] is of length 0.9",
        ),
        (spoilt(2, 25, 0.0), "link 2: joint origin: the quaternion [0, 0, 0, 0] is of length 0"),
        (spoilt(0, 22, 0.1), "link 0: joint origin: the base has no parent"),
        (
            spoilt(0, slice(29, 32), (0, 1, 0)),
            "link 0: joint axis: the axis [0, 0, 0] is of length 0",
        ),
        (spoilt(1, 19, 1.0), "link 1: joint axis: the axis [1, 1, 0] is of length 1.41421, not 1"),
        (
            spoilt(1, slice(29, 32), 0.0),
            "link 1: joint type: [0, 0, 0] is not one-hot over [prismatic,",
        ),
        (
            spoilt(1, slice(29, 32), (0, 0.5, 0.5)),
            "link 1: joint type: [0, 0.5, 0.5] is not one-hot",
        ),
        (
            spoilt(1, slice(29, 32), (0, 0, 1)),
            "link 1: joint axis: it is not zero, but the joint is fixed",
        ),
        (spoilt(0, 35, 1.0), "link 0: joint position: it is not zero, but the joint is fixed"),
        (spoilt(1, slice(32, 48), 0.0), "link 1: joint position: number 8 is 0, but the first"),
        (spoilt(1, 35, 0.0), "link 1: joint position: number 3 is 0, but the first frequency says"),
        (spoilt(1, 32, 2.0), "link 1: joint position: number "),
    ],
)
def test_invalid_tokens_are_errors_that_name_link_and_field(token_array, message):
    with pytest.raises(BenchmarkError, match=re.escape(message)) as refusal:
        robot_from_tokens(token_array, "x")
    assert str(refusal.value).startswith("tokens of 'x'")


def test_a_movable_base_is_an_error():
    token_array = arm_tokens()
    token_array[0, 19:] = token_array[1, 19:]
    with pytest.raises(BenchmarkError, match="link 0: joint type: revolute, but the base is fixed"):
        robot_from_tokens(token_array, "x")


def test_tokens_of_another_max_links_are_an_error():
    token_array = tokens(arm(), {}, max_links=30)
    assert_read_back(token_array, max_links=30)
    with pytest.raises(BenchmarkError, match="made with another max_links than 23"):
        robot_from_tokens(token_array, "x")
