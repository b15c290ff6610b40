"""Environments of one structure in MuJoCo Warp: a model, the data of its worlds, their kernels."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mujoco
import mujoco_warp
import numpy as np
import warp as wp
from mujoco_warp import Data, OverflowType

from morphgen.tasks.sim import warp_kernels as kernels
from morphgen.tasks.sim.base import SUBSTEPS
from morphgen.tasks.sim.motor_law import farthest_targets
from morphgen.tasks.sim.mujoco_model import World
from morphgen.tasks.sim.warp_model import Structure, dof_leaders, put_model

CONTACTS_PER_WORLD, FEWEST_CONTACTS = 24, 1024
"""Number of contacts that the memory of a group holds: for each world on average, and at least."""
IGNORED_OVERFLOW = int(
    OverflowType.EPA_HORIZON
    | OverflowType.CONTACT_MATCH
    | OverflowType.ITERATIONS
    | OverflowType.LS_ITERATIONS
)
"""Overflows that lose no contact.

Two are not about memory: the solver, or its line search, stopped at its number of iterations. It
then goes on with the last forces, as MuJoCo does; in single precision many worlds that press links
together never reach the tolerance.
"""


class Group:
    """Environments of one structure: a model, and the data of its worlds."""

    def __init__(
        self, structure: Structure, number: int, device: str, buffers: dict[str, wp.array]
    ) -> None:
        """Put the structure's worlds on the device; ``WarpSimulation`` resets them.

        Args:
            structure: The environments and their models.
            number: Number of the group.
            device: Name of the device of Warp.
            buffers: Arrays of all environments, see ``WarpSimulation``.
        """
        self._buffers, self._number = buffers, number
        first = structure.worlds[0]
        model = first.model
        count = len(structure.envs)
        contact_rows = 3 * max_contacts(model.ngeom)  # a normal and two tangents
        rows = int(model.neq + np.count_nonzero(model.jnt_limited) + contact_rows)
        with wp.ScopedDevice(device):
            self.model = put_model(structure, device)
            self.data = mujoco_warp.make_data(
                model,
                nworld=count,
                naconmax=max(count * CONTACTS_PER_WORLD, FEWEST_CONTACTS),
                njmax=rows,
            )
            _put_static_geoms(self.data, structure.worlds, count)
            self._joints, self._things = _joints(structure), _things(first)
            self._acceleration = wp.zeros((count, model.nv), dtype=float)
            self._force = wp.zeros((count, model.nv), dtype=float)

    def step(self) -> None:
        """Launch the kernels of a control step.

        The control law sees the joint-space inertia and the Coriolis forces of the state that it
        acts on: MuJoCo computes them in the first half of a physics step.
        """
        mujoco_warp.step1(self.model, self.data)
        self._launch_control()
        mujoco_warp.step2(self.model, self.data)
        for _ in range(SUBSTEPS - 1):
            mujoco_warp.step(self.model, self.data)
        self.read()
        self._find_diverged()

    def step_library(self) -> None:
        """Launch the library's kernels of a control step alone, for ``benchmarks/gpu_speed.py``.

        Targets are the controls of the actuators, without the forces of inverse dynamics.
        """
        wp.launch(
            kernels.targets_as_controls,
            self.data.ctrl.shape,
            [self._joints, self._buffers["targets"]],
            [self.data.ctrl],
        )
        for _ in range(SUBSTEPS):
            mujoco_warp.step(self.model, self.data)

    def _launch_control(self) -> None:
        """Compute the controls of the actuators from the targets."""
        data, targets = self.data, self._buffers["targets"]
        dofs = self._acceleration.shape
        wp.launch(
            kernels.accelerations,
            dofs,
            [self._joints, targets, data.qpos, data.qvel, self.model.dof_damping],
            [self._acceleration, data.qfrc_applied],
        )
        mujoco_warp.mul_m(self.model, data, self._force, self._acceleration)
        wp.launch(
            kernels.controls,
            data.ctrl.shape,
            [
                self._joints,
                targets,
                data.qpos,
                data.qvel,
                self._force,
                data.qfrc_bias,
                data.qfrc_gravcomp,
            ],
            [data.ctrl],
        )

    def read(self) -> None:
        """Write the state into the buffers."""
        data, out = self.data, self._buffers
        wp.launch(
            kernels.read_state,
            data.nworld,
            [
                self._joints,
                self._things,
                data.qpos,
                data.qvel,
                data.mocap_pos,
                data.mocap_quat,
            ],
            [out["q"], out["qd"], out["block_pose"], out["block_velocity"]],
        )

    def _find_diverged(self) -> None:
        """Mark the environments that diverged in the step, and count them."""
        data, out = self.data, self._buffers
        wp.launch(
            kernels.find_diverged,
            data.nworld,
            [
                self._joints,
                IGNORED_OVERFLOW,
                self._number,
                out["targets"],
                data.qpos,
                data.qvel,
                data.overflow,
            ],
            [out["overflow"], out["diverged"], out["counts"]],
        )

    def reset(self, obstacle_poses: wp.array) -> None:
        """Reset the worlds that the buffers mark, to the state in the buffers."""
        data, state = self.data, self._buffers
        wp.launch(
            kernels.reset_worlds,
            data.nworld,
            [
                self._joints,
                self._things,
                state["mask"],
                state["reset_q"],
                state["reset_pose"],
                obstacle_poses,
            ],
            [
                data.qpos,
                data.qvel,
                data.qacc_warmstart,
                data.mocap_pos,
                data.mocap_quat,
                data.overflow,
            ],
        )


def max_contacts(num_shapes: int) -> int:
    """Return how many contacts a world may have; with more it diverges.

    Trained arms that push had up to 1.3 contacts for each shape in MuJoCo.

    Args:
        num_shapes: Number of shapes of the robot, its block, obstacles and ground together.
    """
    return max(48, 2 * num_shapes)


def _put_static_geoms(data: Data, rows: Sequence[World], count: int) -> None:
    """Write the poses of static geoms: MuJoCo Warp computes them once, from the first model."""
    poses = []
    for world in rows:
        rest = mujoco.MjData(world.model)
        mujoco.mj_kinematics(world.model, rest)
        poses.append((rest.geom_xpos.copy(), rest.geom_xmat.reshape(-1, 3, 3).copy()))
    row = np.arange(count) % len(rows)
    data.geom_xpos.assign(np.stack([pose[0] for pose in poses])[row])
    data.geom_xmat.assign(np.stack([pose[1] for pose in poses])[row])


def _joints(structure: Structure) -> kernels.Joints:
    """Return the joints of a structure, in memory of Warp's current device."""
    rows = structure.worlds
    first = rows[0]
    leaders = [dof_leaders(world) for world in rows]
    dof_q_at = np.zeros(first.model.nv, dtype=np.int32)
    dof_q_at[first.movable_qd_at] = first.movable_q_at
    joints = kernels.Joints()
    joints.env = _array(structure.envs, int)
    joints.q_at, joints.qd_at = _array(first.q_at, int), _array(first.qd_at, int)
    joints.dof_leader = _array(leaders[0][0], int)
    joints.dof_q_at = _array(dof_q_at, int)
    joints.dof_gain = _array([gain for _, gain, _ in leaders], float)
    joints.dof_offset = _array([offset for _, _, offset in leaders], float)
    joints.compliance = _array([1 / world.model.actuator_gainprm[:, 0] for world in rows], float)
    joints.farthest = _array(
        [farthest_targets(world.robot, world.robot.independent_joints) for world in rows], float
    )
    return joints


def _things(world: World) -> kernels.Things:
    """Return the block and the obstacles of a structure."""
    things = kernels.Things()
    things.block_q_at, things.block_qd_at, things.block_mocap = -1, 0, -1
    if world.block is not None and world.block_moves:
        things.block_q_at, things.block_qd_at = world.block_q_at, world.block_qd_at
    elif world.block is not None:
        things.block_mocap = int(world.model.body_mocapid[world.block])
    things.obstacles = _array(world.obstacles, int)
    return things


def _array(values: object, dtype: Callable[..., object]) -> wp.array:
    """Return an array in memory of Warp's current device."""
    return wp.array(np.asarray(values), dtype=dtype)
