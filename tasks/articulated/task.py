"""The tasks drawer, door and dial: one class, three objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from morphgen.errors import MorphgenError, TaskError
from morphgen.grammar.catalogue import source_digest
from morphgen.model.inertia import bounding_box, box_corners
from morphgen.model.robot import Robot
from morphgen.tasks.articulated.starts import (
    POINTS,
    ArticulatedStartSet,
    object_manifest,
    sample_starts,
    start_faults,
)
from morphgen.tasks.configs import (
    ArticulatedConfig,
    DialConfig,
    DoorConfig,
    DrawerConfig,
)
from morphgen.tasks.free_space import FreeSpace, outside_limits
from morphgen.tasks.sim.base import Scene
from morphgen.tasks.task import OBJECT, EnvSpec, Marker, ObjectTask, ObservationField

if TYPE_CHECKING:
    import torch

    from morphgen.tasks.articulated.envs import ArticulatedEnvs

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
