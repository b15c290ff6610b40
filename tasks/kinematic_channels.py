"""Observation channels of a robot's kinematics: a vector for each link.

All positions and directions are in the root frame. Joint frames are canonical: their z axis is the
joint's axis, so that equal joints look equal whatever convention the robot's file has. Numbers are
scaled to about one by the constants below.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from morphgen.encoding.tokens import GEOMETRY, SHAPE_POSE
from morphgen.errors import TaskError
from morphgen.model.geometry import Mesh, half_extents
from morphgen.model.kinematics_torch import (
    FrameChain,
    KinematicTree,
    compile_tree,
    dls_step_within,
    forward_kinematics,
    frame_jacobian,
    frame_pose,
    joint_axes,
    matrix_from_quaternion,
    pose_task,
    rotation_from_z,
    rotvec_from_matrix,
    solve_ik,
)
from morphgen.model.robot import Robot
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.scenes.robot_tables import RobotTables
from morphgen.typing import Array


@dataclass(frozen=True, eq=False)
class ToolTargets:
    """Points and orientations that tasks want the tool at, in the root frame: n environments.

    They are for observation channels such as ``jacobian``; evaluation does not depend on them.
    """

    points: torch.Tensor
    """Target points, in the order in which the tool should visit them, shape (n, P, 3) [m]."""
    exists: torch.Tensor  # points that an environment's task has, shape (n, P), bool
    rotations: torch.Tensor | None = None
    """Orientations for the tool at the first point, shape (n, 3, 3); None if no task wants one."""
    has_rotation: torch.Tensor | None = None
    """Environments whose task wants an orientation, shape (n,), bool; None if none does."""


STARTS = 32  # number of start configurations of a solution
ITERATIONS = 25  # iterations of damped least squares
SOLVED = 0.005  # distance of tool and target that counts as a solution [m]
MOVED = 0.05  # distance that a target moves before it is solved again [m]
AWAY = 0.05
"""Distance of the path's end from the first target, away from the object, whose corners reach past
the target [m]."""
LIFT = 0.2  # height above the path's end from which a second path descends [m]
RAISED = 0.15
"""Height at which the object must not touch the robot at the path's end, if there is a choice: a
link above it would press it to the ground [m]."""


class IkSolutions:
    """A configuration for each environment that brings the tool to its first target.

    It is found by damped least squares from the joint targets and from other starts, which are the
    same for all robots as fractions of their joints' ranges. Of several solutions it is the one
    that the robot reaches first on a straight path without a collision; if all paths collide, the
    nearest. A solution is kept until the episode ends or the target moves.

    Where a task has an object, paths end further away from it, are free of it where it is when they
    are planned, and may lead through a configuration with the tool above the end; those whose ends
    collide are left out. Paths are tested on the CPU: on a GPU, ``update`` copies tensors from it.
    """

    def __init__(
        self,
        tables: RobotTables,
        env_robot_index: torch.Tensor,
        space_of: Callable[[int], FreeSpace],
        has_object: torch.Tensor | None,
    ) -> None:
        """Gather the tables of every environment.

        ``space_of`` returns the scene of an environment, and ``has_object`` says which scenes have
        an object, (n,), bool; None if none has.
        """
        index, self._space_of = env_robot_index, space_of
        self._has_object = torch.zeros_like(index).bool() if has_object is None else has_object
        self._has_objects = bool(self._has_object.any())
        self._tables, self._index = tables, index
        self._lower, self._upper = tables.lower[index], tables.upper[index]
        self._per_step = 1 / tables.max_step[index].clamp(min=1e-6)
        self._moves_tool = tables.moves_tool[index]
        n, J = self._lower.shape
        device = tables.device
        # The first point of the sequence is zero, a corner of the range.
        sobol = torch.quasirandom.SobolEngine(J)  # type: ignore[no-untyped-call]
        sobol.fast_forward(1)  # type: ignore[no-untyped-call]
        self._fractions = sobol.draw(STARTS - 1).to(device)
        self.error = torch.zeros(n, device=device)
        """Distance from tool to target at the paths' ends, shape (n,) [m]."""
        # Configurations on the paths, before their ends, and at their ends, (n, J) [rad or m].
        self._via, self._end = torch.zeros(2, n, J, device=device)
        self._is_past = torch.ones(n, dtype=torch.bool, device=device)  # past the first of them
        self._solved_for = torch.full((n, 3), math.inf, device=device)

    @property
    def waypoint(self) -> torch.Tensor:
        """Configurations to go to in a straight line, shape (n, J) [rad or m]."""
        return torch.where(self._is_past[:, None], self._end, self._via)

    def forget(self, mask: torch.Tensor) -> None:
        """Forget the solutions of environments whose episode begins."""
        self._solved_for.masked_fill_(mask[:, None], math.inf)

    def update(self, targets: torch.Tensor, goals: ToolTargets, object_pose: torch.Tensor) -> None:
        """Solve where an episode has begun or the tool's target has moved.

        The joint targets have the shape (n, J), the poses of objects (n, 7).
        """
        points = goals.points[:, 0]
        moved = torch.linalg.vector_norm(points - self._solved_for, dim=1) > MOVED
        exists = goals.exists[:, 0]
        self._end = torch.where(exists[:, None], self._end, targets)
        posed = torch.zeros_like(exists) if goals.has_rotation is None else goals.has_rotation
        for mask, rotations in ((~posed, None), (posed, goals.rotations)):
            rows = torch.nonzero(moved & exists & mask)[:, 0]
            if len(rows):
                self._solved_for[rows] = points[rows]
                R = None if rotations is None else rotations[rows]
                # The second point is on the object's surface, or the centre of a block.
                away = points[rows] - goals.points[rows, min(1, goals.points.shape[1] - 1)]
                away = away / torch.linalg.vector_norm(away, dim=1, keepdim=True).clamp(min=NEAR)
                away = AWAY * away * self._has_object[rows, None]
                objects = object_pose[rows, None].repeat(1, 2, 1)
                objects[:, 1, :3] += away
                objects[:, 1, 2] += RAISED
                paths, error = self._paths(rows, targets, points[rows] + away, R)
                best = self._best(rows, targets[rows], paths, error[0], objects)
                column = torch.arange(len(rows), device=rows.device)
                self._via[rows], self._end[rows] = paths[:, best, column]
                self.error[rows], self._is_past[rows] = error[1, best, column], False
        left = ((self._via - targets) * self._per_step).abs().amax(dim=1)
        self._is_past |= left < 1

    def _paths(
        self,
        rows: torch.Tensor,
        targets: torch.Tensor,
        points: torch.Tensor,
        rotations: torch.Tensor | None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return paths of k environments to points (k, 3), with rotations (k, 3, 3) if any.

        They are two configurations each, (2, S, k, J). With them are the distances of tools from
        where they should be, (2, S, k) [m]: the larger one of both configurations, and at the end.
        """
        chain, index = self._tables.tool_chain, self._index[rows]
        now, lower, upper = targets[rows], self._lower[rows], self._upper[rows]
        random = lower + (upper - lower) * self._fractions[:, None]
        starts = torch.cat([now[None], torch.where(self._moves_tool[rows], random, now)])
        end, error = solve_ik(
            chain,
            index,
            starts,
            points,
            rotations,
            (lower, upper),
            rotation_weight=ROTATION_LENGTH,
            iterations=ITERATIONS,
        )
        end = self._tables.nearest_turns(index, end, now)
        error = torch.linalg.vector_norm(error, dim=2)
        if not self._has_objects:
            return torch.stack([end, end]), torch.stack([error, error])
        up = points + points.new_tensor([0.0, 0.0, LIFT])
        above, missed = solve_ik(chain, index, end, up, None, (lower, upper), iterations=ITERATIONS)
        missed = torch.maximum(torch.linalg.vector_norm(missed, dim=2), error)
        missed = torch.where(self._has_object[rows], missed, math.inf)
        straight, descending = torch.stack([end, end]), torch.stack([above, end])
        errors = torch.stack([error, error]), torch.stack([missed, error])
        return torch.cat([straight, descending], dim=1), torch.cat(errors, dim=1)

    def _best(
        self,
        rows: torch.Tensor,
        now: torch.Tensor,
        paths: torch.Tensor,
        error: torch.Tensor,
        objects: torch.Tensor,
    ) -> torch.Tensor:
        """Return the indices (k,) of the best paths (2, S, k, J) from configurations (k, J).

        Objects have two poses, (k, 2, 7): where they are, and raised.
        """
        legs = torch.diff(paths, dim=0, prepend=now.expand_as(paths[:1]))
        steps = (legs * self._per_step[rows]).abs().amax(dim=3).sum(dim=0)
        cost = torch.where(error < SOLVED, steps, 1e6 * (1 + error))  # unsolved ones last
        order = cost.argsort(dim=0, stable=True).cpu().numpy()
        count = (error < SOLVED).sum(dim=0).tolist()
        here, there = now.double().cpu().numpy(), paths.permute(2, 1, 0, 3).double().cpu().numpy()
        poses = objects.double().cpu().numpy()
        best = []
        for i, (env, has_object) in enumerate(
            zip(rows.tolist(), self._has_object[rows].tolist(), strict=True)
        ):
            solved = order[: count[i], i]
            blocks = poses[i] if has_object else None
            first = self._space_of(env).best_path(here[i], there[i, solved], blocks)
            best.append(order[first or 0, i])  # without any, the nearest
        return torch.tensor(np.array(best), device=rows.device)


BISECTIONS = 8  # halvings of a capsule's axis, to 1/256 of its length


@dataclass(frozen=True, eq=False)
class Capsules:
    """Capsules around the primitives of R robots, S per robot, padded with ones at the root."""

    link: torch.Tensor  # index of each capsule's link, shape (R, S), int64
    ends: torch.Tensor  # ends of its axis in the link frame, shape (R, S, 2, 3) [m]
    radius: torch.Tensor  # shape (R, S) [m]


def compile_capsules(robots: Sequence[Robot], device: torch.device | str) -> Capsules:
    """Return collision primitives of robots as capsules, but those of links that no joint moves.

    A capsule is about the longest axis of its primitive, with the mean of the other two half
    extents as its radius. It differs from rims of cylinders, edges of boxes and flat shapes: over
    random configurations of arm3, UR5, Panda, xArm7 and Jaco among obstacles, distances below 5 cm
    are off by 3 mm in the mean and 8 mm at most, all others by at most 36 mm.
    """
    rows = [_capsules(robot) for robot in robots]
    size = len(robots), max(1, *map(len, rows))
    link, ends, radius = np.zeros(size, dtype=np.int64), np.zeros((*size, 2, 3)), np.zeros(size)
    for r, row in enumerate(rows):
        for s, capsule in enumerate(row):
            link[r, s], ends[r, s], radius[r, s] = capsule
    values = torch.from_numpy(ends).float(), torch.from_numpy(radius).float()
    return Capsules(torch.from_numpy(link).to(device), *(value.to(device) for value in values))


def _capsules(robot: Robot) -> list[tuple[int, Array, float]]:
    """Return link, ends of the axis (2, 3) and radius of a robot's capsules, in the link frames."""
    capsules = []
    for i, link in enumerate(robot.links):
        if not {*robot.joint_chain(link.name)} & {*robot.movable_joints}:
            continue
        for shape in link.collisions:
            if isinstance(shape.geometry, Mesh):
                raise TaskError(
                    f"observation channels contact and clearance: link {link.name!r} of robot "
                    f"{robot.name!r} has a mesh as its collision shape; expected primitives: see "
                    "morphgen fit"
                )
            half = np.array(half_extents(shape.geometry))
            axis = int(half.argmax())
            radius = float((half.sum() - half[axis]) / 2)
            T = shape.T_link_shape.matrix
            offset = max(half[axis] - radius, 0.0) * T[:3, axis]
            capsules.append((i, np.stack([T[:3, 3] - offset, T[:3, 3] + offset]), radius))
    return capsules


def box_distance(point: torch.Tensor, half: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return signed distances (...) [m] of points (..., 3) from boxes with half edges (..., 3).

    Returns also their gradients, unit vectors of shape (..., 3); points and gradients are in the
    frames of the boxes.
    """
    excess = point.abs() - half
    outside = excess.clamp(min=0)
    length = torch.linalg.vector_norm(outside, dim=-1)
    largest = excess.amax(dim=-1)
    # Inside, the nearest face is the one with the largest, least negative excess.
    axes = torch.arange(3, device=point.device)
    face = (axes == excess.argmax(dim=-1, keepdim=True)).to(point.dtype)
    is_outside = (largest > 0)[..., None]
    direction = torch.where(is_outside, outside / length.clamp(min=1e-9)[..., None], face)
    return length + largest.clamp(max=0), torch.copysign(direction, point)


def capsule_box_distance(
    ends: torch.Tensor, radius: torch.Tensor, half: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return signed distances (...) [m] of capsules with ends (..., 2, 3) from boxes (..., 3).

    Returns also the nearest points on the axes and the distances' gradients there, both (..., 3).
    All are in the frames of the boxes, which have half edges (..., 3). The distance is convex along
    an axis; bisection finds its minimum.
    """
    start, along = ends[..., 0, :], ends[..., 1, :] - ends[..., 0, :]
    fraction = torch.full_like(along[..., :1], 0.5)
    for k in range(2, BISECTIONS + 2):
        _, gradient = box_distance(start + fraction * along, half)
        slope = (gradient * along).sum(dim=-1, keepdim=True)
        fraction = fraction - torch.sign(slope) * 0.5**k
    point = start + fraction * along
    distance, gradient = box_distance(point, half)
    return distance - radius, point, gradient


IK_SHARE = 4  # column of the channel `ik` with the joint's action along the straight path, -1 to 1
MAX_LAG = 3.0
"""Bound of the observed lag [largest steps]; no joint in free motion is further behind."""
STEPS_TO_LIMIT = 10.0  # distance to a joint limit that counts as far [largest steps]
STEP_SCALE = 5.0  # factor on the largest step of a joint [1/rad or 1/m]: 0.2 rad become one
POSITION_SCALE = 3.0  # factor on vectors to targets [1/m]: a third of a metre becomes one
COLUMN_SCALE = 20.0
"""Factor on the tool's displacement by the largest step of a joint [1/m]: 5 cm become one."""
ROTATION_SCALE = 5.0
"""Factor on the tool's rotation by the largest step of a joint [1/rad]: 0.2 rad become one."""
GAINS = (0.25, 1.0, 4.0)
"""Gains of a wanted joint step, in largest steps, before it is squashed by tanh: the highest one
resolves the last millimetres, the lowest one distances of many steps."""
REFERENCE_STEP = 0.045
"""Mean largest step of revolute joints with ``pace``, that of the grammar ``serial`` [rad]."""
SINGULAR = 1e-4
"""Added to the squared length of a Jacobian column, so that short ones ask for no large step."""
NEAR = 1e-3  # distance below which the logarithm of a distance hardly changes [m or rad]
ROTATION_LENGTH = 0.3
"""Length by which rotation errors are multiplied to compare with position errors [m/rad]."""
DAMPING = 0.03
"""Damping of the least squares of ``dls``, in units of the Jacobian's singular values [m/rad]."""

CLEARANCES = (0.05, 0.25)
"""Distances of links from obstacles that count as far, for contacts and for detours [m]."""
MAX_PLACE = 3.0  # bound of the observed place on the object [half edges]
MAX_CLOSENESS = 1.5  # bound of the observed closeness, for penetrations


@dataclass(frozen=True, eq=False)
class _State:
    """Quantities that several channels are computed from; n environments, J joints."""

    tree: KinematicTree
    chain: FrameChain  # chains of the tools
    robot_index: torch.Tensor
    q: torch.Tensor
    targets: torch.Tensor
    goals: ToolTargets
    object_pose: torch.Tensor

    @cached_property
    def T_root_link(self) -> torch.Tensor:
        """Poses of the links, shape (n, L, 4, 4)."""
        return forward_kinematics(self.tree, self.robot_index, self.q)

    @cached_property
    def joint_axes(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Origins and axes of the joints at the links that they move, each (n, L, 3)."""
        return joint_axes(self.tree, self.robot_index, self.T_root_link)

    @cached_property
    def tool(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Pose of the tool, shape (n, 4, 4), and its Jacobian, shape (n, 6, J), at ``q``."""
        return frame_jacobian(self.chain, self.robot_index, self.q)

    @cached_property
    def T_root_target(self) -> torch.Tensor:
        """Pose that the tool will have once the joints are at their targets, shape (n, 4, 4)."""
        return frame_pose(self.chain, self.robot_index, self.targets)


class KinematicChannels:
    """The kinematic channels of a batch's environments, each of shape (n, L, size).

    P is the number of target points of the tasks (``TaskEnvs.target_points``); R is 1 if a task
    wants an orientation of the tool, else 0; B is 1 if a scene has an object, else 0.

    ``lag`` (1)
        Target minus position of the link's joint, in largest steps.
    ``joint`` (10)
        Position, its sine and cosine (zero for prismatic joints), both limits, largest step,
        logarithm of the effort, prismatic or not, and closeness to both limits.
    ``poses`` (12 + 3 P)
        Origin, x and z axes of the canonical joint frame, and vectors from the origin to the tool
        and to the target points; also for links without a joint.
    ``jacobian`` (7 + 13 P + 8 R + 11 B)
        Displacement and rotation of the tool by the joint's largest step, and the length of the
        displacement. For each target point: the error, and twice the product of Jacobian column
        and error (``_products``), for the tool where it is and for the tool where it will be once
        the joints are at their targets. For an orientation: the error and the product. For the
        object, a block's centre or a contact point: the same from the robot's nearest point, and
        that point's displacement.
    ``dls`` (3 (P + R))
        The joint's share of a damped least-squares step of all joints (Wampler 1986) towards each
        target point, and towards the first one with its orientation, at three gains.

    ``ik`` (6)
        The way from the joint's target to the next configuration of a path that brings the tool to
        the first target point, with its orientation if it has one (``IkSolutions``): in largest
        steps at three gains, in rad or m, and as a share of the joint that needs the most steps;
        and the logarithm of the tool's distance from the target at the end. Paths are planned on
        the CPU: on a GPU this channel alone copies tensors from it.

    ``clearance`` (3)
        How near the links that the joint moves are to the obstacles, as ``Capsules``: 1 in contact
        and 0 far away, for two distances that count as far, and more than 1 in penetration; and
        the change of the distance by the joint's largest step, faded out likewise. All are zero
        without obstacles.
    ``contact`` (9)
        The same for the box of the object, from the nearest link that the joint moves: the three
        numbers of ``clearance``, the direction from the box to the link in the root frame, and
        where the link is on the box, in half edges. All fade out like the change of the distance.

    Links without an independent joint have zeros, except in ``poses``. Observations of slow arms
    are unlike those of fast ones, as most are in largest steps. With ``pace`` the steps are those
    of an arm whose joints are faster by a common factor, which is left out.
    """

    def __init__(
        self,
        tables: RobotTables,
        env_robot_index: torch.Tensor,
        names: Sequence[str],
        *,
        pace: bool,
        has_object: torch.Tensor | None,
        obstacles: torch.Tensor,
        obstacle_sizes: torch.Tensor,
        object_boxes: torch.Tensor,
        space_of: Callable[[int], FreeSpace],
    ) -> None:
        """Gather the tables of every environment; ``space_of`` returns its scene.

        With ``pace``, largest steps are multiplied so that their mean is ``REFERENCE_STEP``.
        ``has_object`` says which scenes have an object, (n,), bool; None leaves its columns out.
        ``obstacles`` are the current poses of boxes, (n, O, 7), which the caller updates in place;
        ``obstacle_sizes`` are their edges (n, O, 3) [m], zero for padding.
        ``object_boxes`` are edges and centres of ``Scene.object_box``, (n, 2, 3) [m], or zeros.
        """
        index = env_robot_index
        self._names, self._index, self._tables = tuple(names), index, tables
        self._has_object = has_object
        self._joint, self._link_of_joint = tables.joint_of_link[index], tables.link_of_joint[index]
        self._link_mask = tables.link_mask[index]
        self._lower, self._upper = tables.lower[index], tables.upper[index]
        self._max_step = tables.max_step[index]
        if pace:
            self._max_step = self._max_step * _pace(tables)[index, None]
        # Padding has a largest step of zero; its columns are zero, too.
        self._per_step = 1 / self._max_step.clamp(min=1e-6)
        self._effort = tables.effort[index].clamp(min=NEAR).log() / 5  # 150 N m become one
        self._is_prismatic = tables.is_prismatic[index].float()
        self._solutions: IkSolutions | None = None
        if "ik" in names:
            self._solutions = IkSolutions(tables, index, space_of, has_object)
        self._tree = compile_tree(tables.robots, max_links=tables.max_links, device=tables.device)
        self._R_joint_canonical = rotation_from_z(self._tree.joints.axis)[index]
        self._ancestors, tokens = tables.ancestors[index], tables.tokens[index]
        self._half_extents = _half_extents(tokens[..., GEOMETRY.columns])
        self._shape_pose = tokens[..., SHAPE_POSE.columns]
        self._obstacles, self._obstacle_halves = obstacles, obstacle_sizes / 2
        self._object_halves, self._object_centres = object_boxes[:, 0] / 2, object_boxes[:, 1]
        if {"clearance", "contact"} & {*names}:
            capsules = compile_capsules(tables.robots, tables.device)
            self._capsule_link, self._capsule_radius = capsules.link[index], capsules.radius[index]
            self._capsule_ends = capsules.ends[index]
            rows = torch.arange(len(index), device=tables.device)[:, None]
            above = self._ancestors[rows, self._capsule_link]
            self._moves_capsule = torch.gather(
                above, 2, self._link_of_joint[:, None].expand(-1, above.shape[1], -1)
            )

    def begin(self, mask: torch.Tensor) -> None:
        """Note that episodes begin in some environments, shape (n,), bool."""
        if self._solutions is not None:
            self._solutions.forget(mask)

    def __call__(
        self, q: torch.Tensor, targets: torch.Tensor, goals: ToolTargets, object_pose: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        """Return the channels by name, at joint positions (n, J) and block poses (n, 7)."""
        chain = self._tables.tool_chain
        state = _State(self._tree, chain, self._index, q, targets, goals, object_pose)
        channels = {
            "lag": self._lag,
            "joint": self._joint_state,
            "poses": self._poses,
            "jacobian": self._jacobian,
            "dls": self._dls,
            "ik": self._ik,
            "clearance": self._clearance,
            "contact": self._contact,
        }
        return {name: channels[name](state) for name in self._names}

    def _lag(self, state: _State) -> torch.Tensor:
        lag = (state.targets - state.q) * self._per_step
        return self._at_links(lag.clamp(-MAX_LAG, MAX_LAG)[..., None])

    def _joint_state(self, state: _State) -> torch.Tensor:
        q, turns = state.q, 1 - self._is_prismatic
        far = STEPS_TO_LIMIT
        columns = (
            q,
            torch.sin(q) * turns,
            torch.cos(q) * turns,
            self._lower,
            self._upper,
            STEP_SCALE * self._max_step,
            self._effort,
            self._is_prismatic,
            1 - ((self._upper - q) * self._per_step / far).clamp(0, 1),
            1 - ((q - self._lower) * self._per_step / far).clamp(0, 1),
        )
        return self._at_links(torch.stack(columns, dim=-1))

    def _poses(self, state: _State) -> torch.Tensor:
        R_root_joint = state.T_root_link[..., :3, :3] @ self._R_joint_canonical
        origins = state.T_root_link[..., :3, 3]
        to_tool = state.tool[0][:, None, :3, 3] - origins
        to_points = (state.goals.points[:, None] - origins[:, :, None]).flatten(2)
        vectors = POSITION_SCALE * torch.cat([origins, to_tool, to_points], dim=-1)
        poses = torch.cat([R_root_joint[..., 0], R_root_joint[..., 2], vectors], dim=-1)
        return poses * self._link_mask[..., None]

    def _jacobian(self, state: _State) -> torch.Tensor:
        T_root_tool, J_root_tool = state.tool
        linear, angular = J_root_tool[:, :3], J_root_tool[:, 3:]
        goals, step = state.goals, self._max_step[:, None]
        tool, later_tool = T_root_tool[:, :3, 3], state.T_root_target[:, :3, 3]
        displacement = COLUMN_SCALE * linear * step
        columns = [displacement, ROTATION_SCALE * angular * step]
        columns.append(torch.linalg.vector_norm(displacement, dim=1, keepdim=True))
        for point, exists in zip(goals.points.unbind(1), goals.exists.unbind(1), strict=True):
            error = (point - tool) * exists[:, None]
            later_error = (point - later_tool) * exists[:, None]
            columns.append(self._at_joints(POSITION_SCALE * error))
            columns += [self._products(linear, error), self._products(linear, later_error)]
        if goals.rotations is not None:
            assert goals.has_rotation is not None
            error = rotvec_from_matrix(goals.rotations @ T_root_tool[:, :3, :3].transpose(1, 2))
            error = error * goals.has_rotation[:, None]
            columns += [self._at_joints(error), self._products(angular, error)]
        if self._has_object is not None:
            point, J_root_point = self._nearest_point(state)
            error = (state.object_pose[:, :3] - point) * self._has_object[:, None]
            columns.append(self._at_joints(POSITION_SCALE * error))
            columns += [COLUMN_SCALE * J_root_point * step, self._products(J_root_point, error)]
        return self._at_links(torch.cat(columns, dim=1).transpose(1, 2))

    def _dls(self, state: _State) -> torch.Tensor:
        goals, (_, J) = state.goals, state.tool
        later_tool = state.T_root_target[:, :3, 3]
        errors = (goals.points - later_tool[:, None]) * goals.exists[..., None]
        columns = [self._dls_step(J[:, :3], error, state.targets) for error in errors.unbind(1)]
        if goals.rotations is not None:
            assert goals.has_rotation is not None
            points, rotations = goals.points[:, 0], goals.rotations
            J_task, error = pose_task(state.T_root_target, J, points, rotations, ROTATION_LENGTH)
            wanted = torch.stack([goals.exists[:, 0], goals.has_rotation], dim=1)
            error = error * wanted.repeat_interleave(3, dim=1)
            columns.append(self._dls_step(J_task, error, state.targets))
        columns.append(J[:, :0])  # a task without targets has no columns
        return self._at_links(torch.cat(columns, dim=1).transpose(1, 2))

    def _ik(self, state: _State) -> torch.Tensor:
        solutions = self._solutions
        assert solutions is not None
        if not state.goals.points.shape[1]:
            raise TaskError("observation channel ik: no task here has target points for the tool")
        solutions.update(state.targets, state.goals, state.object_pose)
        change = solutions.waypoint - state.targets
        steps = change * self._per_step
        # All joints arrive together, and none overshoots in the last step.
        share = steps / steps.abs().amax(dim=1, keepdim=True).clamp(min=1)
        log_error = ((solutions.error + NEAR).log() / 2)[:, None].expand_as(steps)
        columns = [torch.tanh(gain * steps) for gain in GAINS]
        return self._at_links(torch.stack([*columns, change, share, log_error], dim=2))

    def _dls_step(
        self, J: torch.Tensor, error: torch.Tensor, targets: torch.Tensor
    ) -> torch.Tensor:
        """Return damped least-squares steps at the gains, shape (n, 3, J), in largest steps."""
        limits = self._lower, self._upper
        step = dls_step_within(J, error, DAMPING, targets, limits) * self._per_step
        return torch.stack([torch.tanh(gain * step) for gain in GAINS], dim=1)

    def _products(self, J: torch.Tensor, error: torch.Tensor) -> torch.Tensor:
        """Return products of Jacobian columns (n, 3, J) and an error (n, 3), shape (n, 5, J).

        They are the steps that would reduce the error by each joint alone, at the gains; the cosine
        of the angle between column and error; and the logarithm of the error's length.
        """
        along = (J * error[..., None]).sum(dim=1)
        squares = J.square().sum(dim=1)
        step = along / (squares + SINGULAR) * self._per_step
        length = torch.linalg.vector_norm(error, dim=1)[:, None]
        cosine = along / (squares.sqrt() * length + SINGULAR)
        log_length = ((length + NEAR).log() / 2).expand_as(cosine)  # 1 mm is -3, 1 m is 0
        steps = [torch.tanh(gain * step) for gain in GAINS]
        return torch.stack([*steps, cosine, log_length], dim=1)

    def _nearest_point(self, state: _State) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the robot's points (n, 3) nearest to the block, and their Jacobians (n, 3, J).

        Links count as the boxes around their primitives, mimic joints not as parts of leaders.
        """
        T_root_link = state.T_root_link
        rows = torch.arange(len(state.q), device=state.q.device)
        R_root_shape = T_root_link[..., :3, :3] @ matrix_from_quaternion(self._shape_pose[..., 3:])
        centres = T_root_link[..., :3, 3] + (
            T_root_link[..., :3, :3] @ self._shape_pose[..., :3, None]
        ).squeeze(-1)
        to_block = (state.object_pose[:, None, :3] - centres)[..., None]
        local = (R_root_shape.transpose(-1, -2) @ to_block).squeeze(-1)
        inside = local.clamp(-self._half_extents, self._half_extents)
        points = centres + (R_root_shape @ inside[..., None]).squeeze(-1)
        distance = torch.linalg.vector_norm(points - state.object_pose[:, None, :3], dim=-1)
        has_shape = self._half_extents.amax(dim=-1) > 0
        link = torch.where(has_shape, distance, torch.inf).argmin(dim=1)
        point = points[rows, link]

        columns = self._point_columns(state, point[:, None])
        moves = torch.gather(self._ancestors[rows, link], 1, self._link_of_joint)
        return point, (columns * moves[..., None]).transpose(1, 2)

    def _point_columns(self, state: _State, points: torch.Tensor) -> torch.Tensor:
        """Return the velocities (n, J, 3) of points (n, J or 1, 3) by unit joint velocities."""
        origins, axes = state.joint_axes
        at_joint = torch.arange(len(points), device=points.device)[:, None], self._link_of_joint
        axis, lever = axes[at_joint], points - origins[at_joint]
        prismatic = self._is_prismatic[..., None] > 0
        return torch.where(prismatic, axis, torch.linalg.cross(axis, lever))

    def _clearance(self, state: _State) -> torch.Tensor:
        near, _, _ = self._nearness(state, self._obstacles, self._obstacle_halves)
        return self._at_links(near)

    def _contact(self, state: _State) -> torch.Tensor:
        pose, half = state.object_pose, self._object_halves
        R = matrix_from_quaternion(pose[:, 3:])
        centre = pose[:, :3] + (R @ self._object_centres[..., None]).squeeze(-1)
        box = torch.cat([centre, pose[:, 3:]], dim=1)[:, None]
        near, point, normal = self._nearness(state, box, half[:, None])
        # Row vectors: by the inverse rotation. At a face's middle one number is 1 or -1.
        place = (point - centre[:, None]) @ R / half[:, None].clamp(min=NEAR)
        fade = near[..., 1:2]
        columns = [near, normal * fade, place.clamp(-MAX_PLACE, MAX_PLACE) * fade]
        return self._at_links(torch.cat(columns, dim=-1))

    def _nearness(
        self, state: _State, boxes: torch.Tensor, halves: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return how near the links that joints move are to boxes, (n, J, 3); see ``clearance``.

        Boxes have poses (n, B, 7) and half edges (n, B, 3), zero for padding. Returns also the
        nearest points on the axes of capsules, and the directions from the boxes, (n, J, 3).
        """
        distance, point, normal = self._box_distances(state, boxes, halves)
        distance = torch.where(self._moves_capsule, distance[..., None], torch.inf)
        distance, nearest = distance.min(dim=1)
        nearest = nearest[..., None].expand(-1, -1, 3)
        point, normal = torch.gather(point, 1, nearest), torch.gather(normal, 1, nearest)
        rate = (self._point_columns(state, point) * normal).sum(dim=-1)
        closeness = [(1 - distance / limit).clamp(0, MAX_CLOSENESS) for limit in CLEARANCES]
        rate = COLUMN_SCALE * rate * self._max_step * closeness[-1]
        return torch.stack([*closeness, rate], dim=-1), point, normal

    def _box_distances(
        self, state: _State, boxes: torch.Tensor, halves: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the distances (n, S) [m] of capsules from the nearest box, inf without one.

        Returns also the nearest points on the capsules' axes and the directions from the box, in
        the root frame, both (n, S, 3).
        """
        rows = torch.arange(len(state.q), device=state.q.device)[:, None]
        T_root_link = state.T_root_link[rows, self._capsule_link][:, :, None]
        ends = (T_root_link[..., :3, :3] @ self._capsule_ends[..., None]).squeeze(-1)
        ends = ends + T_root_link[..., :3, 3]
        if not boxes.shape[1]:
            return torch.full_like(ends[..., 0, 0], torch.inf), ends[..., 0, :], ends[..., 0, :]
        R_root_box = matrix_from_quaternion(boxes[..., 3:])[:, None]
        centres = boxes[:, None, :, None, :3]
        local = (ends[:, :, None] - centres) @ R_root_box  # row vectors: by the inverse
        halves = halves[:, None]
        distance, point, normal = capsule_box_distance(
            local, self._capsule_radius[..., None], halves
        )
        distance, nearest = torch.where(halves[..., 0] > 0, distance, torch.inf).min(dim=2)
        nearest = nearest[..., None, None].expand(-1, -1, 1, 3)
        vectors = torch.stack([point, normal], dim=3) @ R_root_box.transpose(-1, -2)
        point, normal = (
            torch.gather(each, 2, nearest).squeeze(2)
            for each in (vectors[..., 0, :] + centres[..., 0, :], vectors[..., 1, :])
        )
        return distance, point, normal

    def _at_joints(self, vectors: torch.Tensor) -> torch.Tensor:
        """Repeat vectors (n, k) for every independent joint, shape (n, k, J)."""
        return vectors[..., None].expand(-1, -1, self._max_step.shape[1])

    def _at_links(self, values: torch.Tensor) -> torch.Tensor:
        """Return values of joints (n, J, k) at the links that they move, shape (n, L, k)."""
        index = self._joint.clamp(min=0)[..., None].expand(-1, -1, values.shape[-1])
        return torch.gather(values, 1, index) * (self._joint >= 0)[..., None]


def _pace(tables: RobotTables) -> torch.Tensor:
    """Return by how much faster robots would have ``REFERENCE_STEP``, shape (R,)."""
    step = tables.max_step
    turns = (tables.moves_tool & ~tables.is_prismatic & (step > 0)).float()
    mean = (step * turns).sum(dim=1) / turns.sum(dim=1).clamp(min=1)
    return torch.where(mean > 0, REFERENCE_STEP / mean.clamp(min=1e-6), 1.0)


def _half_extents(geometry: torch.Tensor) -> torch.Tensor:
    """Return half the edges (..., 3) of boxes around primitives, by tokens' ``GEOMETRY`` [m]."""
    sphere, cylinder, box, a, b, c = geometry.unbind(-1)
    half = torch.stack([a, b, c * sphere + c / 2 * (cylinder + box)], dim=-1)
    half[..., :2] *= (1 - box / 2)[..., None]
    return half * (sphere + cylinder + box)[..., None]
