"""Tokens: encoding, padding, files, and errors of invalid robots."""

import io
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.robots import arm, arm_tokens, field_of, shapes_of
from morphgen.encoding.tokens import (
    LAYOUT,
    MAX_LINKS,
    TOKEN_SIZE,
    encode_joint_positions,
    normalize_positions,
    pad_tokens,
    tokens,
    tokens_npz,
)
from morphgen.errors import BenchmarkError, RobotError
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere
from morphgen.model.kinematics import random_configurations
from morphgen.model.robot import Frame, Joint, Link, Robot


def hinge(kind="revolute", limits=(-1.0, 1.0), **changes):
    """A robot with one joint."""
    joint = Joint("j", kind, "a", "b", axis=(0, 0, 1), limits=limits, **changes)
    home = () if kind == "fixed" else (0.0,)
    return Robot("hinge", (Link("a"), Link("b")), (joint,), home=home)


PAGE = (Path(__file__).parents[2] / "docs" / "tokens.md").read_text(encoding="utf-8")


def test_fields_have_the_order_and_size_of_the_paper():
    sizes = [field.size for field in LAYOUT]
    assert sizes == [1, 1, 4, 6, 7, 3, 7, 3, 16]
    assert [field.start for field in LAYOUT] == [sum(sizes[:i]) for i in range(len(sizes))]
    assert sum(sizes) == TOKEN_SIZE == 48
    assert MAX_LINKS == 23


def test_every_number_of_an_arm():
    token_array = arm_tokens()
    assert token_array.shape == (6, 48)
    np.testing.assert_allclose(token_array[:, 0], np.arange(6) / 22)
    np.testing.assert_allclose(token_array[:, 1], np.array([-1, 0, 1, 2, 3, 3]) / 22)
    flags = np.arange(6)[:, None] == [3] * 4
    np.testing.assert_array_equal(token_array[:, 2:6], flags)
    np.testing.assert_allclose(token_array[0, 6:12], [0, 0, 1, 0.1, 0.1, 0.04])
    np.testing.assert_allclose(token_array[1, 6:12], [0, 1, 0, 0.02, 0.02, 0.24])
    np.testing.assert_allclose(token_array[1, 12:19], [0, 0, 0.15, 1, 0, 0, 0])
    axes = [(0, 0, 0), (0, 1, 0), (1, 0, 0), (0, 0, 1), (0, 1, 0), (0, 1, 0)]
    np.testing.assert_array_equal(token_array[:, 19:22], axes)
    np.testing.assert_allclose(token_array[0, 22:29], [0, 0, 0, 1, 0, 0, 0])
    np.testing.assert_allclose(token_array[5, 22:29], [0, -0.05, 0.2, 1, 0, 0, 0])
    slide, turn, fixed = np.eye(3)
    np.testing.assert_array_equal(token_array[:, 29:32], [fixed, turn, turn, slide, slide, slide])
    # The home (0.4, 0.5, 0.01, 0.02) within (-2, 2), (-2, 2), (0, 0.04), (0, 0.04); "right"
    # mimics "left" and is at -0.02 within (-0.04, 0).
    x = np.array([0.2, 0.25, -0.5, 0.0, 0.0])
    angles = x[:, None] * math.pi / 2 * np.array([1, 2, 4, 8, 16, 32, 64, 128])
    code = np.hstack([np.sin(angles), np.cos(angles)])
    np.testing.assert_allclose(token_array[:, 32:], np.vstack([np.zeros(16), code]), atol=1e-12)


@pytest.mark.parametrize(
    ("geometry", "numbers"),
    [
        (Sphere(0.2), [1, 0, 0, 0.2, 0.2, 0.2]),
        (Cylinder(0.2, 0.5), [0, 1, 0, 0.2, 0.2, 0.5]),
        (Capsule(0.2, 0.5), [0, 1, 0, 0.2, 0.2, 0.9]),
        (Box((0.1, 0.2, 0.3)), [0, 0, 1, 0.1, 0.2, 0.3]),
    ],
)
def test_a_primitive_is_encoded_as_one_hot_and_sizes(geometry, numbers):
    token_array = tokens(hinge(), {"b": Shape(geometry)})
    np.testing.assert_allclose(field_of(token_array, "geometry")[1], numbers)
    assert not field_of(token_array, "geometry")[0].any()
    assert not field_of(token_array, "geometry pose")[0].any()


def test_only_the_link_of_the_tool_frame_is_flagged():
    frames = (Frame("left_tool", "left"), Frame("tool", "right"), Frame("camera", "base"))
    flags = field_of(arm_tokens(frames=frames), "end-effector")
    assert flags.tolist() == [[0] * 4] * 5 + [[1] * 4]
    assert not field_of(arm_tokens(frames=frames[:1]), "end-effector").any()


@pytest.mark.parametrize(
    ("robot", "q", "x"),
    [
        (hinge(limits=(-0.5, 1.5)), [-0.5, 0.5, 1.0, 1.5, 2.5], [-1, 0, 0.5, 1, 2]),
        (hinge("prismatic", (0.0, 0.04)), [0.0, 0.01, 0.04], [-1, -0.5, 1]),
        (hinge("prismatic", None), [-0.5, 0.5, 2.0], [-0.5, 0.5, 2]),
        (hinge("continuous", None), [0.5 * math.pi, 1.5 * math.pi, -7 * math.pi], [0.5, -0.5, 1]),
        (hinge("continuous", (-9.0, 9.0)), [math.pi, -math.pi, 0.0], [1, 1, 0]),
        (hinge("revolute", None), [-0.25 * math.pi, 4.25 * math.pi], [-0.25, 0.25]),
        (hinge("revolute", (-6.4, 6.4)), [6.4, -3.2], [1, -0.5]),
    ],
)
def test_q_is_normalized_by_the_joint_limits(robot, q, x):
    normalized = normalize_positions(robot, np.array(q)[:, None])
    np.testing.assert_allclose(normalized[:, 0], x, atol=1e-12)
    q = random_configurations(arm(), 20, np.random.default_rng(0))
    x = normalize_positions(arm(), q)  # the last joint mimics the fourth
    np.testing.assert_allclose(x[:, 3], (q[:, 3] - 0.02) / 0.02)
    np.testing.assert_allclose(x[:, 4], (-q[:, 3] + 0.02) / 0.02)


def test_tokens_are_batched_over_q():
    robot = arm()
    q = random_configurations(robot, 12, np.random.default_rng(0)).reshape(3, 4, 4)
    token_array = tokens(robot, shapes_of(robot), q)
    assert token_array.shape == (3, 4, 6, 48)
    assert encode_joint_positions(robot, q).shape == (3, 4, 6, 16)
    np.testing.assert_array_equal(token_array[..., 32:], encode_joint_positions(robot, q))
    np.testing.assert_array_equal(token_array[2, 1], tokens(robot, shapes_of(robot), q[2, 1]))
    np.testing.assert_array_equal(arm_tokens(), tokens(robot, shapes_of(robot), robot.home))
    assert tokens(robot, {}, np.zeros((0, 4))).shape == (0, 6, 48)


@pytest.mark.parametrize(
    ("robot", "shapes", "options", "message"),
    [
        (arm(), {}, {"max_links": 5}, "robot 'arm' has 6 links, more than max_links 5"),
        (hinge(), {}, {"max_links": 1}, "max_links 1: expected 2 to 10000"),
        (hinge(), {"b": Shape(Mesh(Path("x.stl")))}, {}, "link 'b': a mesh has no token"),
        (hinge(), {"b": Shape(Sphere(0.0))}, {}, "link 'b': sizes [0, 0, 0] are not all positive"),
        (
            hinge(),
            {"b": Shape(Sphere(1.0), Pose((0.0, math.nan, 0.0)))},
            {},
            "link 'b': geometry pose: [0, nan, 0, 1, 0, 0, 0] is not finite",
        ),
        (hinge(T_parent_joint=Pose((math.inf, 0.0, 0.0))), {}, {}, "link 'b': joint origin:"),
        (
            hinge(T_parent_joint=Pose(quaternion=(0, 0, 0, 0))),
            {},
            {},
            "link 'b': invalid rotation quaternion: (0, 0, 0, 0)",
        ),
        (hinge(limits=(1.0, -1.0)), {}, {}, "joint 'j': limits (1, -1) leave no range"),
        (hinge(limits=(-math.inf, math.inf)), {}, {}, "joint 'j': limits (-inf, inf) leave no"),
        (hinge(), {}, {"q": [[0.0], [math.nan]]}, "robot 'hinge': joint 'j': q is not finite"),
    ],
)
def test_invalid_robots_and_shapes_are_errors(robot, shapes, options, message):
    with pytest.raises(BenchmarkError, match=re.escape(message)):
        tokens(robot, shapes, **options)
    with pytest.raises(RobotError, match="joint 'j': its axis"):
        tokens(replace(hinge(), joints=(replace(hinge().joints[0], axis=(0, 0, 0)),)), {})
    with pytest.raises(ValueError, match=r"needs \(\.\.\., 1\)"):
        tokens(hinge(), {}, [0.0, 0.0])


def test_padding_adds_rows_of_zeros_and_a_mask():
    batch = np.stack([arm_tokens()] * 3)
    all_, mask = pad_tokens(batch, 9)
    assert all_.shape == (3, 9, 48)
    assert mask.tolist() == [True] * 6 + [False] * 3
    np.testing.assert_array_equal(all_[:, mask], batch)
    assert not all_[:, ~mask].any()
    with pytest.raises(BenchmarkError, match="has 6 links, more than max_links 5"):
        pad_tokens(batch, 5)


def test_token_files_are_reproducible_and_need_no_pickle():
    links = [link.name for link in arm().links]
    content = tokens_npz(arm_tokens(), links, "arm", 23)
    assert content == tokens_npz(arm_tokens(), links, "arm", 23)
    with np.load(io.BytesIO(content), allow_pickle=False) as data:
        np.testing.assert_array_equal(data["tokens"], arm_tokens())
        assert data["links"].tolist() == links
        assert data["layout"].tolist() == [field.name for field in LAYOUT]
        assert data["columns"].tolist() == [[f.start, f.start + f.size] for f in LAYOUT]
        assert (data["name"].item(), data["max_links"].item()) == ("arm", 23)


def test_the_page_documents_every_field():
    for field in LAYOUT:
        columns = f"{field.start}:{field.columns.stop}"
        assert f"| {field.name} | {columns} | {field.content} |" in PAGE
