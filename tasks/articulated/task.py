"""The tasks drawer, door and dial: one class, three objects, and starts with certificates."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from morphgen.errors import MorphgenError, NoGoalsError, SimulationError, TaskError
from morphgen.formats.mjcf.write import MujocoKinematics
from morphgen.formats.resolve import default_finder
from morphgen.formats.rounding import as_written
from morphgen.formats.urdf.read import robot_from_xml
from morphgen.formats.urdf.write import urdf_text
from morphgen.grammar.catalogue import source_digest
from morphgen.grammar.compose import compose
from morphgen.grammar.library import default_library
from morphgen.grammar.manifest import Manifest
from morphgen.grammar.syntax import Derivation
from morphgen.model.geometry import Mesh, Pose
from morphgen.model.inertia import bounding_box, box_corners
from morphgen.model.kinematics import joint_limits, solve_position_ik
from morphgen.model.robot import TOOL, Robot
from morphgen.tasks.configs import ArticulatedConfig, DialConfig, DoorConfig, DrawerConfig
from morphgen.tasks.free_space import FreeSpace, outside_limits
from morphgen.tasks.push.task import BEHIND, draw_starts, sample_tools_in_box, work_region
from morphgen.tasks.scenes.obstacles import no_obstacles
from morphgen.tasks.sim.articulated import ArticulatedObject, rotated
from morphgen.tasks.sim.base import Block, Scene
from morphgen.tasks.task import OBJECT, EnvSpec, GoalSet, Marker, ObjectTask, ObservationField
from morphgen.typing import Array

if TYPE_CHECKING:
    import torch

    from morphgen.tasks.articulated.envs import ArticulatedEnvs

POINTS = 5  # configurations of a certificate, from the start of the motion to its end
CLOSE = 1e-3  # largest distance of a tool of a certificate from where it should be [m]

_HEIGHTS = 0.5  # heights at which tools push, in half heights of the box at the contact point
_NEARER = (0.0, 0.4)
"""Distances by which the object is moved against its motion, beyond where its contact point meets
the tool, to test that the robot is in its way: in one of them it touches the robot's links [sizes].
"""
_NEAREST = (1, 3, 8, 20)
"""Numbers of nearest configurations of the bank from which paths begin, in turn: between the
fingers of an open hand many miss the object."""
_FINGERS = 3
"""Copies of the bank with fingers at random limits: closed fingers let nothing between them."""
_LARGEST_STEP = 1.0  # largest change of a joint between configurations of a certificate [rad or m]
_ARRIVED = 1e-6  # distance from its goal at which inverse kinematics leaves a tool [m]
_MARGIN = 0.02  # distance of starts and ends from the object's joint limits, in ranges of the joint
_PLACES = 24  # places of the object to try
_BATCH = 20  # starts that are drawn at a time
_FEASIBLE = 0.25  # fraction of the first batch that must be feasible at a place
_TRIES = 10  # starts to test per required one at a place before giving up
_SIZE, _TRAVEL = "size", "travel"  # parameters of objects that the task sets
_PLACED = 1e-6  # largest height of an object above the ground [m]


@dataclass(frozen=True, eq=False)
class ArticulatedStartSet(GoalSet):
    """Starts of a robot's episodes with an articulated object, which stands at one place."""

    robot: str
    key: str
    q: Array  # configurations at the start, free with the object, shape (S, dof) [rad or m]
    urdf: str  # the object
    place: Array  # pose of its root in the world: x, y, z, qw, qx, qy, qz, shape (7,)
    friction: float  # of its surfaces
    start: Array  # position of its joint at the start, shape (S,) [rad or m]
    goal: Array  # position that its joint must pass, shape (S,) [rad or m]
    edge: float  # size of the object [m]
    scale: float  # scale of lengths: 1, or less for robots that reach less than 0.4 m
    ground: float  # height of the ground [m]
    obstacles: tuple[Block, ...]
    layouts: Array
    usable: NDArray[np.bool_]
    tried: int
    accepted: int
    seed: int
    distance: Array
    """Certificates: distance of the tool behind the object's surface, shape (S,) [m]."""
    path: Array
    """Certificates: free configurations with the tool behind the object as it moves from start to
    goal, in equal steps, shape (S, POINTS, dof), in single precision to be small."""

    @cached_property
    def thing(self) -> ArticulatedObject:
        """The object where it stands; a SimulationError if the text is not of one."""
        x, y, z, qw, qx, qy, qz = self.place.tolist()
        pose = Pose((x, y, z), (qw, qx, qy, qz))
        return ArticulatedObject(read_body(self.urdf), pose, self.friction)

    @property
    def goal_poses(self) -> Array:
        """Poses of the object at its goals, shape (S, 7)."""
        return self.thing.placed_joint.poses(self.goal)

    def motions(self, gap: float) -> Array:
        """Return rows: start, goal, poses there, points on the surface and before, (S, 22).

        The points before are ``gap`` [m] away, scaled.
        """
        thing, sign = self.thing, np.sign(self.goal - self.start)
        ends = [thing.placed_joint.poses(each) for each in (self.start, self.goal)]
        points = [thing.behind(sign, each) for each in (0.0, gap * self.scale)]
        return np.concatenate([self.start[:, None], self.goal[:, None], *ends, *points], axis=1)


def read_body(text: str) -> Robot:
    """Return the object of a URDF's text, which may come from strangers: it has no files."""
    if "<mesh" in text:
        raise SimulationError("the object has meshes; expected primitives")
    where = Path("object.urdf")
    try:
        return robot_from_xml(text.encode(), where, default_finder(), written_frames=True)
    except MorphgenError as error:
        raise SimulationError(f"the object: {error}") from error


def object_manifest(config: ArticulatedConfig) -> Manifest:
    """Return the part that is a task's object."""
    manifest = default_library().manifest(config.object, "object")
    if _SIZE not in manifest.parameters:
        raise TaskError(f"object {config.object!r} has no parameter {_SIZE!r}, which the task sets")
    return manifest


def draw_object(manifest: Manifest, edge: float, travel: float, rng: np.random.Generator) -> Robot:
    """Draw an object of a size [m] whose joint can move by more than ``travel`` [m or rad].

    Parameters besides size and travel are uniform in the ranges of the part's manifest.
    """
    wanted = {_SIZE: edge, _TRAVEL: 1.5 * travel}
    values = {}
    for name, parameter in manifest.parameters.items():
        value = wanted.get(name)
        if value is None:
            value = float(rng.uniform(parameter.minimum, parameter.maximum))
            value = round(value) if parameter.integer else value
        elif not parameter.minimum <= value <= parameter.maximum:
            raise NoGoalsError(
                f"object {manifest.name!r} of a {name} of {value:.3g} m: expected "
                f"{parameter.minimum:g} to {parameter.maximum:g}"
            )
        values[name] = value
    derivation = Derivation("object", manifest.name, tuple(values.items()))
    return as_written(compose(derivation, default_library(), manifest.name))


def sample_starts(
    robot: Robot,
    config: ArticulatedConfig,
    ground: float,
    seeds: np.random.SeedSequence,
    identity: Mapping[str, Any],
) -> ArticulatedStartSet:
    """Draw an object, a place from which a robot can move it, and starts with certificates.

    The place is uniform in the ``work_region``, turned at random. A start is feasible if there is
    a free configuration with the tool behind the object's contact point, and further ones as the
    object moves, near enough to each other to be one motion. Places where less than a quarter of
    the starts are feasible give way to others.
    """
    rng = np.random.default_rng(seeds.spawn(1)[0])
    size = float(rng.uniform(*config.size))
    edge, scale, x_range = work_region(robot, size, config.arm_x, config.free_x, ground)
    manifest = object_manifest(config)
    is_scaled = _TRAVEL in manifest.parameters
    travel = config.travel * scale if is_scaled else config.travel
    text = urdf_text(draw_object(manifest, edge, travel, rng), _no_mesh)
    body = read_body(text)
    y_range = (config.y[0] * scale, config.y[1] * scale)
    low = np.array([x_range[0] - 2 * edge, y_range[0] - 2 * edge, ground])
    high = np.array([x_range[1] + 2 * edge, y_range[1] + 2 * edge, ground + 1.5 * edge])
    finder = PathFinder(robot, edge, low, high, rng)
    most = 0.0
    for _ in range(_PLACES):
        x, y, yaw = rng.uniform(*x_range), rng.uniform(*y_range), rng.uniform(-np.pi, np.pi)
        draws = np.random.default_rng(rng.integers(2**63))
        thing = _standing(ArticulatedObject(body, friction=config.friction), (x, y, ground), yaw)
        if not finder.stand(thing):
            continue
        found: list[tuple[float, float, float, Array]] = []
        tried, suits = 0, True
        while suits and len(found) < config.num_goals and tried < _TRIES * config.num_goals:
            start, goal = _draw_motions(thing, travel, draws)
            distance, path = finder(start, goal)
            tried += len(start)
            found += [
                row for row in zip(start, goal, distance, path, strict=True) if row[2] == row[2]
            ]
            most = max(most, len(found) / tried)
            # Of the first batch only: smaller sets, which need no other, have the same place.
            suits = tried > _BATCH or len(found) >= _FEASIBLE * tried
        if not suits or len(found) < config.num_goals:
            continue
        columns = zip(*found[: config.num_goals], strict=True)
        starts, goals, distances, paths = (np.array(column) for column in columns)
        q = draw_starts(finder.space, thing.placed_joint.poses(starts), seeds.spawn(1)[0])
        pose = thing.pose
        return ArticulatedStartSet(
            q=q,
            urdf=text,
            place=np.array([*pose.position, *pose.quaternion]),
            friction=config.friction,
            start=starts,
            goal=goals,
            edge=edge,
            scale=scale,
            ground=ground,
            tried=tried,
            accepted=len(q),
            distance=distances,
            path=paths.astype(np.float32),
            **no_obstacles(len(q)),
            **identity,
        )
    raise NoGoalsError(
        f"robot {robot.name!r} can hardly move a {config.object} of {edge:.3g} m: at {_PLACES} "
        f"places with x in ({x_range[0]:.3g}, {x_range[1]:.3g}) and y in ({y_range[0]:.3g}, "
        f"{y_range[1]:.3g}) it touches the robot, or the tool gets behind it and along its path in "
        f"{most:.0%} of the starts at most; {_FEASIBLE:.0%} are needed"
    )


def _no_mesh(mesh: Mesh) -> NoReturn:
    raise TaskError(f"the object has a mesh, {mesh.path}; expected primitives")


def _standing(
    thing: ArticulatedObject, place: tuple[float, float, float], yaw: float
) -> ArticulatedObject:
    """Return an object on the ground, turned, with its contact point at home at x and y."""
    turned = replace(thing, pose=Pose.from_xyz_rpy((0.0, 0.0, 0.0), (0.0, 0.0, yaw)))
    x, y = turned.placed_joint.poses(np.array(thing.body.home))[0, :2].tolist()
    return replace(
        turned, pose=replace(turned.pose, position=(place[0] - x, place[1] - y, place[2]))
    )


def _draw_motions(
    thing: ArticulatedObject, travel: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Draw starts and ends of motions within the joint's limits, to either side, (n,) each."""
    limits = thing.joint.limits
    low, high = limits if limits is not None else (-np.pi, np.pi)
    margin = _MARGIN * (high - low)
    room = high - low - 2 * margin - travel
    if room < 0:
        raise TaskError(
            f"object {thing.body.name!r}: its joint moves by {high - low:.3g}, less than the "
            f"travel of {travel:.3g} needs"
        )
    part, side = rng.random((_BATCH, 2)).T
    first = low + margin + part * room
    second = first + travel
    return np.where(side < 0.5, first, second), np.where(side < 0.5, second, first)


def points_behind(
    thing: ArticulatedObject, poses: Array, sign: Array, distance: Array | float
) -> Array:
    """Return points from where tools push along motions (n, P, 7), (n, P, 3) [m]; see ``behind``.

    Signs and distances are those of the motions, (n,).
    """
    n, count, _ = poses.shape
    flat, distances = poses.reshape(-1, 7), np.broadcast_to(distance, n).repeat(count)
    offsets = rotated(flat[:, 3:], thing.behind(sign.repeat(count), distances))
    return np.asarray(flat[:, :3] + offsets).reshape(n, count, 3)


class PathFinder:
    """Finds configurations of a robot whose tool follows an object from behind.

    Attributes:
        space: The robot with the object, for tests of collisions.
        links: The same without the tool point, to test what touches the object.
        bank: Free configurations without the object, with the tool near it, shape (B, dof).
        tools: Positions of their tools, shape (B, 3) [m].
    """

    def __init__(
        self, robot: Robot, edge: float, low: Array, high: Array, rng: np.random.Generator
    ) -> None:
        """Sample the bank in a box from ``low`` to ``high`` that stands on the ground."""
        self._robot, self._edge, self._ground = robot, edge, float(low[2])
        empty = FreeSpace(Scene(robot, ground=self._ground))
        bank, tools = sample_tools_in_box(empty, low, high, rng)
        limits, banks, rows = joint_limits(robot), [bank], [np.arange(len(bank))]
        fingers = [
            j
            for j, k in enumerate(robot.independent_joints)
            if k not in robot.joint_chain(robot.frame(TOOL).link)
        ]
        for _ in range(_FINGERS if fingers else 0):
            moved = bank.copy()
            side = rng.integers(0, 2, (len(bank), len(fingers)))
            moved[:, fingers] = np.take_along_axis(limits[fingers].T, side, axis=0)
            rows.append(np.flatnonzero(empty.free(moved)))
            banks.append(moved[rows[-1]])
        self.bank, self.tools = np.concatenate(banks), tools[np.concatenate(rows)]

    def stand(self, thing: ArticulatedObject) -> bool:
        """Put the object there; return whether the robot at home does not touch it."""
        self.thing = thing
        scene = Scene(self._robot, object=thing, ground=self._ground)
        self.space, self.links = FreeSpace(scene), FreeSpace(without_tool(scene))
        pose = thing.placed_joint.poses(np.array(thing.body.home))
        return len(self.bank) > 0 and bool(self.space.free([self._robot.home], pose)[0])

    def __call__(self, start: Array, goal: Array) -> tuple[Array, Array]:
        """Return distances (n,) and paths (n, POINTS, dof) of motions (n,); NaN where none is."""
        n = len(start)
        distances = np.full(n, np.nan)
        paths = np.full((n, POINTS, self._robot.dof), np.nan)
        sign = np.sign(goal - start)
        for distance in BEHIND:
            rows = np.flatnonzero(np.isnan(distances))
            motions = self.motions(start[rows], goal[rows], distance)
            behind = points_behind(self.thing, motions[0], sign[rows], distance * self._edge)
            near = self.nearest(behind[:, 0])[:, : sum(_NEAREST)]
            begin = 0
            for count in _NEAREST:  # most succeed from the nearest, which spares the others
                missing = np.isnan(distances[rows])
                rows, behind, near = rows[missing], behind[missing], near[missing]
                motions = [each[missing] for each in motions]
                candidates = near[:, begin : begin + count]
                begin += count
                m, k = candidates.shape
                if not candidates.size:
                    break
                repeated = [np.repeat(each, k, axis=0) for each in (behind, *motions)]
                found = self.follow(candidates.ravel(), *repeated).reshape(m, k, POINTS, -1)
                is_whole = np.isfinite(found[:, :, -1, 0])
                of, first = np.flatnonzero(is_whole.any(axis=1)), is_whole.argmax(axis=1)
                distances[rows[of]] = distance * self._edge
                paths[rows[of]] = found[of, first[of]]
        return distances, paths

    def nearest(self, points: Array) -> NDArray[np.int64]:
        """Return indices of the bank, those first whose tools are near points (n, 3), (n, B)."""
        apart = np.linalg.norm(self.tools - points[:, None], axis=2)
        return np.argsort(apart, axis=1, kind="stable")

    def motions(
        self, start: Array, goal: Array, distance: float, count: int = POINTS
    ) -> list[Array]:
        """Return poses of the object along motions (n,), and where it is in the robot's way.

        Each has the shape (n, count, 7); the distance is that of the tool [sizes].
        """
        backs = against(self.thing, start, goal, distance * self._edge, self._edge)
        shifts = (np.zeros_like(start), *backs)
        return [motion_poses(self.thing, start + each, goal + each, count) for each in shifts]

    def follow(
        self, candidates: NDArray[np.int64], goals: Array, poses: Array, *nearer: Array
    ) -> Array:
        """Follow P points (n, P, 3) from configurations of the bank by their indices, (n,).

        The tool stays at its height, as far as the object has that height. Return configurations
        that are free with the object at its poses (n, P, 7), and whose links touch it at one of
        those that are nearer, shape (n, P, dof). They are NaN from where there is none, or where
        it is not near the one before.
        """
        q = self.bank[candidates]
        half = _HEIGHTS * half_height(self.thing, poses[:, 0])
        lift = np.clip(self.tools[candidates, 2] - goals[:, 0, 2], -half, half)
        paths = np.full((*goals.shape[:2], self._robot.dof), np.nan)
        rows = np.arange(len(q))
        for point in range(goals.shape[1]):
            before, wanted = q, goals[rows, point]
            wanted[:, 2] += lift[rows]
            q, error = solve_position_ik(self._robot, q, wanted, tolerance=_ARRIVED)
            q = self._in_single_precision(q)
            good = np.abs(error).max(axis=1) < CLOSE
            if point > 0:
                good &= np.abs(q - before).max(axis=1) < _LARGEST_STEP
            good[good] = self.space.free(q[good], poses[rows[good], point])
            beside = np.flatnonzero(good)
            for each in nearer:
                beside = beside[self.links.free(q[beside], each[rows[beside], point])]
            good[beside] = False
            q, rows = q[good], rows[good]
            paths[rows, point] = q
        return paths

    def _in_single_precision(self, q: Array) -> Array:
        """Return configurations (n, dof) as certificates hold them, within the joint limits."""
        low, high = joint_limits(self._robot).T
        single = q.astype(np.float32)
        up, down = np.float32(np.inf), np.float32(-np.inf)
        single = np.where(single < low, np.nextafter(single, up), single)
        return np.where(single > high, np.nextafter(single, down), single).astype(np.float64)


def against(
    thing: ArticulatedObject, start: Array, goal: Array, distance: Array | float, edge: float
) -> list[Array]:
    """Return changes of the joint's position to where the object is in the way, (n,) each.

    The tool is at a distance behind the surface, for motions from starts to goals (n,).
    """
    sign = np.sign(goal - start)
    meets = thing.extent(sign) + distance
    return [-sign * (meets + nearer * edge) / thing.lever for nearer in _NEARER]


def without_tool(scene: Scene) -> Scene:
    """Return a scene whose tests of collisions are of links alone, not of the tool point."""
    return replace(scene, robot=replace(scene.robot, frames=()))


def half_height(thing: ArticulatedObject, poses: Array) -> Array:
    """Return half of the height of the box at the contact point, at poses (n, 7), (n,) [m]."""
    size, _ = np.array(thing.contact_box)
    axes = [rotated(poses[:, 3:], np.eye(3)[[i]].repeat(len(poses), axis=0)) for i in range(3)]
    return np.asarray(sum(np.abs(axis[:, 2]) * size[i] / 2 for i, axis in enumerate(axes)))


def motion_poses(thing: ArticulatedObject, start: Array, goal: Array, count: int = POINTS) -> Array:
    """Return poses of an object in equal steps from starts to goals (n,), (n, count, 7)."""
    positions = start[:, None] + (goal - start)[:, None] * np.linspace(0, 1, count)
    return thing.placed_joint.poses(positions.ravel()).reshape(len(start), count, 7)


def start_faults(starts: ArticulatedStartSet, space: FreeSpace) -> Iterator[str]:
    """Yield the faults of each start: of the object's joint, and of its certificates.

    Tools are placed by MuJoCo, not by our kinematics, which found the certificates.
    """
    thing, n = starts.thing, len(starts.q)
    poses = motion_poses(thing, starts.start, starts.goal)
    low, high = thing.joint.limits or (-np.pi, np.pi)
    ends = np.stack([starts.start, starts.goal])
    behind = points_behind(thing, poses, np.sign(starts.goal - starts.start), starts.distance)
    path = starts.path.reshape(n * POINTS, -1).astype(np.float64)
    tools = MujocoKinematics(space.scene.robot).frame_pose(path)[:, :3, 3].reshape(n, POINTS, 3)
    away = np.abs(tools - behind)
    steps = np.abs(np.diff(starts.path, axis=1)).max(axis=(1, 2))
    along = space.free(path, poses.reshape(-1, 7)).reshape(n, POINTS)
    links = FreeSpace(without_tool(space.scene))
    touched = np.zeros((n, POINTS), dtype=np.bool_)
    for back in against(thing, starts.start, starts.goal, starts.distance, starts.edge):
        nearer = motion_poses(thing, starts.start + back, starts.goal + back).reshape(-1, 7)
        touched |= ~links.free(path, nearer).reshape(n, POINTS)
    for fault, is_sound in (
        ("the object's joint leaves its limits", ((ends >= low) & (ends <= high)).all(axis=0)),
        ("it starts in collision", space.free(starts.q, poses[:, 0])),
        ("its path is in collision", along.all(axis=1)),
        ("its path jumps", steps < _LARGEST_STEP),
        ("its path does not touch the object", touched.all(axis=1)),
        (
            "the tool is not behind the object",
            (away[..., :2] < 2 * CLOSE).all(axis=(1, 2))
            & (away[..., 2].max(axis=1) < half_height(thing, poses[:, 0]) + CLOSE),
        ),
    ):
        yield from (f"start {i}: {fault}" for i in np.flatnonzero(~is_sound).tolist())
    if abs(thing.pose.position[2] - starts.ground) > _PLACED:
        yield "the object does not stand on the ground"


BASE = ObservationField("object_base", 13, "joint_mask")
"""Token of a box around what stands still of the object, see ``observation.box_tokens``."""
JOINT = ObservationField("object_joint", 9, "joint_mask")
"""Joint of the object: its axis and a point on it in the root frame, whether it is a slide, its
position, and how far it is from the goal [rad or m]."""


class Articulated(ObjectTask[ArticulatedConfig, ArticulatedStartSet]):
    """Move the joint of an object, which has no motor, by contact within 6 s."""

    goal_set_type = ArticulatedStartSet
    goal_format = 1
    fields = (OBJECT, BASE, JOINT)

    def __init__(self, config_type: type[ArticulatedConfig]) -> None:
        """Make the task of a type of constants, which names it and its object."""
        self.name = config_type.task
        self.config_type = config_type
        self.cache_folder = f"{self.name}s"

    def key_parts(self, config: ArticulatedConfig) -> list[object]:
        """Return the number of starts, the constants that they depend on, and the object's hash."""
        ranges = [*config.size, *config.arm_x, *config.free_x, *config.y]
        numbers = [*map(float, ranges), float(config.travel), float(config.friction)]
        return [config.num_goals, numbers, config.object, source_digest(object_manifest(config))]

    def sample(
        self,
        robot: Robot,
        config: ArticulatedConfig,
        *,
        obstacles: bool,
        ground: float,
        seeds: np.random.SeedSequence,
        identity: Mapping[str, Any],
    ) -> ArticulatedStartSet:
        """Sample an object, its place and starts; see ``sample_starts``."""
        if obstacles:
            raise TaskError(f"task {self.name!r} has no obstacles; expected one without")
        return sample_starts(robot, config, ground, seeds, identity)

    def certify(self, goals: ArticulatedStartSet, robot: Robot, scene: Scene) -> list[str]:
        """Test that the object can be moved as each start says, by the set's configurations."""
        n, dof = len(goals.q), robot.dof
        arrays = [goals.q, goals.path, goals.start, goals.goal, goals.distance, goals.place]
        shapes = [(n, dof), (n, POINTS, dof), (n,), (n,), (n,), (7,)]
        if [array.shape for array in arrays] != shapes:
            found = ", ".join(str(array.shape) for array in arrays)
            return [f"arrays {found} are not starts of robot {robot.name!r} with {dof} joints"]
        if not all(np.isfinite(array).all() for array in arrays):
            return ["not all numbers are finite"]
        try:
            thing = goals.thing
        except MorphgenError as error:
            return [str(error)]
        faults = []
        for name, q in (("start", goals.q), ("path", goals.path.reshape(-1, dof))):
            faults += [f"{name} {i}: {reason}" for i, reason in outside_limits(robot, q)]
        space = FreeSpace(replace(scene, robot=robot, object=thing, obstacles=()))
        return [*faults, *start_faults(goals, space)]

    def scene(self, robot: Robot, goals: ArticulatedStartSet, ground: float) -> Scene:
        """Return the scene with the object."""
        return Scene(robot, object=goals.thing, ground=ground)

    def make_envs(
        self, specs: Sequence[EnvSpec], env_spec_index: torch.Tensor, num_joints: int
    ) -> ArticulatedEnvs:
        """Make the environments of a batch that are at this task."""
        from morphgen.tasks.articulated.envs import ArticulatedEnvs

        return ArticulatedEnvs(specs, env_spec_index, num_joints)

    def markers(self, config: ArticulatedConfig, goals: ArticulatedStartSet) -> tuple[Marker, ...]:
        """Return a box around the contact shape, which stands where the motion ends."""
        return (Marker("goal", "box", goals.thing.contact_box[0]),)

    def points_in_view(self, goals: ArticulatedStartSet) -> NDArray[np.float64]:
        """Return contact points at starts and goals, and corners of what stands still."""
        joints = goals.thing.placed_joint
        contacts = [joints.poses(goals.start)[:, :3], goals.goal_poses[:, :3]]
        if not goals.thing.base_shapes:
            return np.concatenate(contacts)
        T = goals.thing.pose.matrix
        corners = box_corners(*bounding_box(goals.thing.base_shapes)) @ T[:3, :3].T + T[:3, 3]
        return np.concatenate([*contacts, corners])


DRAWER, DOOR, DIAL = (Articulated(config) for config in (DrawerConfig, DoorConfig, DialConfig))
