"""Every template is valid over its whole range; chains match the benchmark's categories."""

from collections.abc import Iterator, Mapping

import numpy as np
import pytest

from morphgen.checks import check
from morphgen.grammar.compose import join
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.library import default_library
from morphgen.grammar.manifest import Manifest, resolve_values
from morphgen.grammar.part import load_part
from morphgen.model.inertia import inertial_from_density, union_integrals
from morphgen.model.kinematics import forward_kinematics, random_configurations
from morphgen.model.robot import Robot

LIBRARY = default_library()
TEMPLATES = [manifest for manifest in LIBRARY.manifests() if manifest.is_template]
PORTS = ("top", "flange", "end")
Range = tuple[float, float]
Step = tuple[str, Mapping[str, float | Range]]


def test_templates_of_every_kind_exist():
    assert {manifest.kind for manifest in TEMPLATES} == {"base", "arm", "ee", "segment", "body"}


def extremes(manifest: Manifest) -> Iterator[dict[str, float]]:
    parameters = manifest.parameters.items()
    yield {}
    yield {name: parameter.minimum for name, parameter in parameters}
    yield {name: parameter.maximum for name, parameter in parameters}
    for name, parameter in parameters:
        yield {name: parameter.minimum}
        yield {name: parameter.maximum}


def troubles(robot: Robot, *, tool_required: bool = True) -> list[str]:
    return [
        f"{finding.severity} {finding.code} {finding.where}: {finding.why}"
        for finding in check(robot, tool_required=tool_required)
        if finding.severity != "info"
    ]


RANGES = [pytest.param(manifest, id=manifest.name) for manifest in TEMPLATES]


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
        mass = union_integrals(shapes).volume * manifest.density if shapes else 0.0
        assert (link.inertial.mass if link.inertial else 0.0) == pytest.approx(mass)


@pytest.mark.parametrize("values", [{}, {"length": 0.5, "mass": 1.5}, {"length": 1.5}])
def test_cartpole_pole_inertia_matches_its_shapes(values):
    pole = load_part(LIBRARY.manifest("cartpole"), values).fragment.link("pole")
    assert pole.inertial.mass == values.get("mass", 1)
    solid = inertial_from_density(
        pole.collisions, pole.inertial.mass / union_integrals(pole.collisions).volume
    )
    assert pole.inertial.com == pytest.approx(solid.com, abs=1e-6)
    assert pole.inertial.inertia == pytest.approx(solid.inertia, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("fingers", [2, 3, 4, 5])
@pytest.mark.parametrize("gather", [0.0, 1.0])
def test_hand_fingers_do_not_collide(fingers, gather):
    part = load_part(LIBRARY.manifest("hand"), {"fingers": fingers, "gather": gather})
    names = [link.name for link in part.fragment.links if link.name.endswith("proximal")]
    assert len(names) == fingers
    T_root_link = forward_kinematics(part.fragment, part.fragment.home)
    outwards = np.array([T_root_link[part.fragment.link_index[name], :3, 0] for name in names])
    cosines = (outwards @ outwards.T)[np.triu_indices(fingers, 1)]
    widest = np.pi / 4 if gather and fingers > 2 else 2 * np.pi / fingers
    assert cosines.max() == pytest.approx(np.cos(widest))


def test_hand_fingers_curl_towards_the_tool():
    body = load_part(LIBRARY.manifest("hand")).fragment
    open_hand, fist = forward_kinematics(body, [np.zeros(body.dof), np.full(body.dof, 0.5)])
    tips = [i for i, link in enumerate(body.links) if link.name.endswith("distal")]
    assert (fist[tips, 2, 3] > open_hand[tips, 2, 3] + 0.01).all()


POST: Step = ("post", {})
BEAM: Step = ("beam", {"length": (0.1, 0.5)})
TUBES = {"v1": (0.03, 0.06), "v2": (0.07, 0.14), "v3": (0.2, 0.4), "v4": (0.07, 0.14)}
TUBES |= {"v5": (0.1, 0.2), "v6": (0.1, 0.2), "radius": (0.025, 0.05)}
TUBES_ED = {"v1": (0.07, 0.2), "v2": (0.03, 0.1), "v3": (0.2, 0.5), "v4": (0.15, 0.3)}
TUBES_ED |= {"v5": (0.1, 0.25), "margin": (0.01, 0.02), "radius": (0.03, 0.06)}
TUBES_ED |= {"ee_radius": (0.02, 0.05)}
BARS = {"length": (0.1, 0.5), "radius": (0.05, 0.1)}
FLAPS = {"first": (0.05, 0.1), "second": (0.05, 0.1)}
ROOM = {"travel_x": 0.7, "travel_y": 0.7, "stroke": 0.5}
BALLS = {"radius": (0.01, 0.05)}


def hand(**choices: float) -> Step:
    lengths = {name: (0.02, 0.05) for name in ("proximal", "middle", "distal")}
    return ("hand", {"gather": (0, 1), **lengths, **choices})


def prims(part: str, **ranges: Range) -> tuple[list[Step], tuple[int, int]]:
    return [("gantry", {}), (part, ranges)], (7, 5)


CATEGORIES: dict[str, tuple[list[Step], tuple[int, int]]] = {
    "arm3": ([("fixed", {}), ("arm3", BARS), ("claw", {"size": (0.02, 0.07)})], (10, 9)),
    "arm5": (
        [
            ("fixed", {}),
            ("arm5", TUBES),
            ("fingers", {"length": (0.03, 0.06), "radius": (0.025, 0.05)}),
        ],
        (23, 8),
    ),
    "stick": (
        [("slide_tilt", {}), ("beam", {"length": (0.1, 0.8)}), ("sphere", {"radius": 0.03})],
        (5, 3),
    ),
    **{
        f"nlink-{n}": ([POST, *[BEAM] * n, ("sphere", {"radius": 0.02})], (n + 2, n))
        for n in (2, 5)
    },
    "prims-plane": prims("plane", size=(0.4, 0.8)),
    "prims-cylinder": prims("cylinder", length=(0.4, 0.8)),
    "prims-cube": prims("cube", size=(0.2, 0.4)),
    "prims-sphere": prims("sphere", radius=(0.1, 0.2)),
    **{
        f"chain-{n}": (
            [("slides", BALLS), *[("bead", BALLS | {"rod": (0.02, 0.1)})] * n],
            (3 * n + 4, 3 + 2 * n),
        )
        for n in (2, 7)
    },
    **{
        f"thin_chain-{n}": (
            [("slides", {"radius": 0.01})]
            + [("bead", {"radius": 0.01, "rod": (0.001, 0.005)})] * n,
            (3 * n + 4, 3 + 2 * n),
        )
        for n in (2, 7)
    },
    "cubes": ([("cubes", {"size": (0.02, 0.2)})], (3, 2)),
    **{
        f"planar_arm-jaw-{n}": (
            [POST, *[BEAM] * n, ("jaw", {"length": (0.03, 0.06)})],
            (n + 4, n + 2),
        )
        for n in (2, 5)
    },
    **{
        f"planar_arm-claw-{n}": (
            [POST, *[BEAM] * n, ("claw", {"size": (0.03, 0.06)})],
            (n + 5, n + 4),
        )
        for n in (2, 5)
    },
    "arm_ed": (
        [
            ("xy_table", {}),
            ("arm_ed", TUBES_ED),
            ("fingers", {"length": (0.05, 0.15), "radius": (0.02, 0.05)}),
        ],
        (19, 8),
    ),
    **{
        f"multi_finger-v{1 + knuckles}-{n}x{m}": (
            [("slides", {}), hand(palm=0, fingers=n, phalanges=m, knuckles=knuckles)],
            (4 + n * m, 3 + n * (m - 1 + knuckles)),
        )
        for n, m in ((2, 2), (5, 3))
        for knuckles in (0, 1)
    },
    **{
        f"multi_finger-arm-{n}x{m}": (
            [("fixed", {}), ("arm3", BARS | {"wrist": 0}), hand(fingers=n, phalanges=m)],
            (6 + n * m, 4 + n * m),
        )
        for n, m in ((3, 3), (4, 2))
    },
    "tongs-v1": ([("gantry", ROOM), ("tongs", FLAPS | {"hinges": 2})], (12, 9)),
    "tongs-v2": ([("gantry", ROOM), ("tongs", FLAPS | {"hinges": 1})], (10, 7)),
    "cartpole": ([("cartpole", {"length": (0.5, 1.5), "mass": (0.5, 1.5)})], (3, 2)),
}
"""Parts of a category with the ranges that the benchmark draws from, and its count of links and
movable joints."""


def derivation(steps: list[Step], u: np.random.Generator | float) -> Derivation:
    """Return a chain with every range at the fraction ``u``, or sampled."""

    def chosen(value: float | Range) -> float:
        if not isinstance(value, tuple):
            return value
        return value[0] + (value[1] - value[0]) * (u if isinstance(u, float) else float(u.random()))

    below: Derivation | None = None
    for i, (part, ranges) in reversed(list(enumerate(steps))):
        manifest = LIBRARY.manifest(part)
        values = {name: chosen(value) for name, value in ranges.items()}
        values = resolve_values(values, manifest.parameters, part)
        port = next((port for port in PORTS if port in manifest.ports), "")
        children = ((port, below),) if below is not None else ()
        below = Derivation(f"{part}{i}", part, tuple(values.items()), children)
    assert below is not None
    return below


@pytest.mark.parametrize("name", CATEGORIES)
def test_category_matches_the_benchmark_and_is_valid(name):
    steps, counts = CATEGORIES[name]
    rng = np.random.default_rng(0)
    for u in (0.0, 0.5, 1.0, rng, rng, rng):
        robot = join(derivation(steps, u), LIBRARY, "robot")
        assert (len(robot.links), len(robot.movable_joints)) == counts
        assert troubles(robot) == []


@pytest.mark.parametrize("name", CATEGORIES)
@pytest.mark.parametrize("u", [0.0, 1.0])
def test_joint_efforts_are_at_least_twice_the_gravity_load(name, u):
    robot = join(derivation(CATEGORIES[name][0], u), LIBRARY, "robot")
    load = gravity_load(robot, random_configurations(robot, 200, np.random.default_rng(0)))
    effort = np.array([robot.joints[k].effort for k in robot.independent_joints])
    assert (effort >= 2 * load).all()


def gravity_load(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Return the largest gravity load per joint, from finite differences of the energy."""
    moves = 1e-5 * np.eye(robot.dof)
    rise = [potential(robot, q + move) - potential(robot, q - move) for move in moves]
    return np.abs(rise).max(axis=1) / 2e-5


def potential(robot: Robot, q: np.ndarray) -> np.ndarray:
    T_root_link = forward_kinematics(robot, q)
    return sum(
        9.81
        * link.inertial.mass
        * (T_root_link[:, i, 2, :3] @ link.inertial.com + T_root_link[:, i, 2, 3])
        for i, link in enumerate(robot.links)
        if link.inertial is not None
    )
