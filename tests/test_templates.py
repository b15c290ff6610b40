"""Every template is valid over its whole range; motors carry the robots of all grammars."""

from collections.abc import Iterator

import numpy as np
import pytest

from helpers.grammars import CATEGORIES, LIBRARY, shipped
from morphgen.checks import check
from morphgen.grammar.manifest import PART_KINDS, Manifest
from morphgen.grammar.part import load_part
from morphgen.grammar.sampling import sample_robot
from morphgen.model.inertia import inertial_from_density, union_volume
from morphgen.model.kinematics import forward_kinematics, random_configurations
from morphgen.model.robot import Robot

TEMPLATES = [manifest for manifest in LIBRARY.manifests() if manifest.is_template]


def test_templates_of_every_kind_exist():
    assert {manifest.kind for manifest in TEMPLATES} == {*PART_KINDS}


def extremes(manifest: Manifest) -> Iterator[dict[str, float]]:
    parameters = manifest.parameters.items()
    yield {}
    for end in ("minimum", "maximum"):
        yield {name: getattr(parameter, end) for name, parameter in parameters}
        yield from ({name: getattr(parameter, end)} for name, parameter in parameters)


def troubles(robot: Robot, *, tool_required: bool = True) -> list[str]:
    return [
        f"{finding.severity} {finding.code} {finding.where}: {finding.why}"
        for finding in check(robot, tool_required=tool_required)
        if finding.severity != "info"
    ]


RANGES = [
    pytest.param(manifest, id=manifest.name) for manifest in TEMPLATES if manifest.kind != "object"
]
"""Objects have tests of their own: that they have no motor is accepted when they are composed."""


@pytest.mark.parametrize("manifest", RANGES)
def test_template_is_valid_at_the_ends_of_its_ranges(manifest):
    for values in extremes(manifest):
        assert troubles(load_part(manifest, values).fragment, tool_required=False) == [], values


@pytest.mark.parametrize("manifest", TEMPLATES, ids=lambda manifest: manifest.name)
def test_template_masses_match_its_shapes(manifest):
    if manifest.name == "cartpole":
        pytest.skip("its pole has a mass of its own, see below")
    for link in load_part(manifest).fragment.links:
        shapes = link.collisions or link.visuals
        mass = union_volume(shapes) * manifest.density if shapes else 0.0
        assert (link.inertial.mass if link.inertial else 0.0) == pytest.approx(mass)


@pytest.mark.parametrize("values", [{}, {"length": 0.5, "mass": 1.5}, {"length": 1.5}])
def test_cartpole_pole_inertia_matches_its_shapes(values):
    pole = load_part(LIBRARY.manifest("cartpole"), values).fragment.link("pole")
    assert pole.inertial.mass == values.get("mass", 1)
    solid = inertial_from_density(
        pole.collisions, pole.inertial.mass / union_volume(pole.collisions)
    )
    assert pole.inertial.com == pytest.approx(solid.com, abs=1e-6)
    assert pole.inertial.inertia == pytest.approx(solid.inertia, rel=1e-6, abs=1e-9)


def test_hand_fingers_curl_towards_the_tool():
    body = load_part(LIBRARY.manifest("hand")).fragment
    open_hand, fist = forward_kinematics(body, [np.zeros(body.dof), np.full(body.dof, 0.5)])
    tips = [i for i, link in enumerate(body.links) if link.name.endswith("distal")]
    assert (fist[tips, 2, 3] > open_hand[tips, 2, 3] + 0.01).all()


@pytest.mark.parametrize("category", sorted({*CATEGORIES} - {"panda_variations"}))  # a real arm
def test_joint_efforts_are_at_least_twice_the_gravity_load(category):
    for index in range(3):
        robot = sample_robot(shipped(category), LIBRARY, index, seed=1).robot
        load = gravity_load(robot, random_configurations(robot, 200, np.random.default_rng(0)))
        effort = np.array([robot.joints[k].effort for k in robot.independent_joints])
        assert (effort >= 2 * load).all()


def gravity_load(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Return the largest gravity load per joint, from finite differences of the energy."""
    moves = 1e-5 * np.eye(robot.dof)
    rise = [potential(robot, q + move) - potential(robot, q - move) for move in moves]
    return np.abs(rise).max(axis=1) / 2e-5


def potential(robot: Robot, q: np.ndarray) -> np.ndarray:
    solid = [(i, link.inertial) for i, link in enumerate(robot.links) if link.inertial is not None]
    T = forward_kinematics(robot, q)
    heights = [T[:, i, 2, :3] @ inertial.com + T[:, i, 2, 3] for i, inertial in solid]
    return 9.81 * np.array([inertial.mass for _, inertial in solid]) @ heights
