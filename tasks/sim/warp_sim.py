"""MuJoCo Warp as a simulator: all environments of one structure step in the same kernels."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mujoco
import numpy as np
import torch

from morphgen.errors import MissingDependencyError, SimulationError

try:
    import mujoco_warp
    import warp as wp
    from mujoco_warp import Data, OverflowType
except ModuleNotFoundError as error:
    raise MissingDependencyError(
        f"simulator 'warp' needs MuJoCo Warp: {error}; install it with: pip install 'morphgen[gpu]'"
    ) from error
from morphgen.tasks.sim import warp_kernels as kernels
from morphgen.tasks.sim.base import SUBSTEPS, Contacts, Scene, Simulator
from morphgen.tasks.sim.motor_law import LAG, speed_limit
from morphgen.tasks.sim.mujoco_model import World, worlds
from morphgen.tasks.sim.warp_model import Structure, dof_leaders, put_model, structures

CONTACTS_PER_WORLD, FEWEST_CONTACTS = 24, 1024
"""Number of contacts that the memory of a group holds: for each world on average, and at least."""
CONTACT_ROWS = 3 * 48
"""Rows of the constraints' Jacobian for the contacts of one world, three for each."""
IGNORED_OVERFLOW = int(OverflowType.EPA_HORIZON | OverflowType.CONTACT_MATCH)
"""Overflows that lose no contact."""
DIVERGED = "diverged: a target or the state is not finite, or a velocity is too large"


class Group:
    """Environments of one structure: a model, the data of its worlds, and a graph of a step."""

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
        self._buffers, self._number, self._device = buffers, number, device
        self.worlds, self.envs = structure.worlds, structure.envs
        first = structure.worlds[0]
        model = first.model
        count = len(structure.envs)
        rows = int(model.neq + np.count_nonzero(model.jnt_limited) + CONTACT_ROWS)
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
        model, data = self.model, self.data
        mujoco_warp.step1(model, data)
        self._launch_control()
        mujoco_warp.step2(model, data)
        for _ in range(SUBSTEPS - 1):
            mujoco_warp.step(model, data)
        self.read()
        self._find_diverged()

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


class WarpSimulation:
    """Environments in MuJoCo Warp, on a GPU or slowly on the CPU; a ``Simulation``.

    Environments whose models have one structure share a model with numbers for every robot, and
    step in the same kernels. On a GPU each structure has a stream and a captured CUDA graph of the
    whole control step, so that structures run side by side and nothing waits for the host.

    The model of a scene, the control law and the physics step are those of ``MujocoSimulation``,
    in single precision. The law uses the inertia of the current state, which on the CPU is that of
    one physics step before. Contacts are found by other algorithms, and a world holds at most
    ``CONTACT_ROWS`` / 3 of them.

    Attributes:
        scenes: Scene of each environment.
        device: Device of all tensors.
        q: Positions of the independent joints, shape (n, J) [rad or m].
        qd: Velocities of the independent joints, shape (n, J) [rad/s or m/s].
        block_pose: Poses of the blocks, shape (n, 7).
        block_velocity: Velocities of the blocks in the world, shape (n, 6).
        counts: Numbers of control steps in which a world of each group diverged, and in which its
            contacts did not fit into the memory, shape (groups, 2), int32.
    """

    def __init__(
        self,
        scenes: Sequence[Scene],
        contacts: Contacts | None = None,
        *,
        device: torch.device | str = "cuda",
    ) -> None:
        """Compile; every robot is at home, every block and obstacle at its pose in the scene.

        Args:
            scenes: Scene of each environment; a robot that several share is compiled once.
            contacts: Pairs of things that collide; by default everything.
            device: Device of all tensors.

        Raises:
            SimulationError: If MuJoCo or MuJoCo Warp refuses a scene.
            FormatError: If MJCF cannot express a robot.
            MeshError: If a mesh cannot be read.
            ValueError: If there are no scenes.
        """
        if not scenes:
            raise ValueError("there are no scenes; expected one or more")
        wp.config.log_level = wp.LOG_WARNING
        self.scenes = tuple(scenes)
        self.device = torch.device(device)
        compiled = worlds(self.scenes, contacts or Contacts())
        found = structures(self.scenes, compiled)
        n, joints = len(scenes), max(world.robot.dof for world in compiled)
        most = max(len(scene.obstacles) for scene in scenes)
        self.q, self.qd, self._targets, self._reset_q = (
            torch.zeros(n, joints, device=self.device) for _ in range(4)
        )
        self.block_pose, self._reset_pose = torch.zeros(2, n, 7, device=self.device)
        self.block_velocity = torch.zeros(n, 6, device=self.device)
        self.counts = torch.zeros(len(found), 2, dtype=torch.int32, device=self.device)
        self._overflow = torch.zeros(n, dtype=torch.int32, device=self.device)
        self._diverged, self._mask = torch.zeros(2, n, dtype=torch.uint8, device=self.device)
        self._obstacle_poses = torch.zeros(n, most, 7, device=self.device)
        tensors = {
            "q": self.q,
            "qd": self.qd,
            "targets": self._targets,
            "reset_q": self._reset_q,
            "block_pose": self.block_pose,
            "reset_pose": self._reset_pose,
            "block_velocity": self.block_velocity,
            "counts": self.counts,
            "overflow": self._overflow,
            "diverged": self._diverged,
            "mask": self._mask,
        }
        buffers = {name: wp.from_torch(tensor) for name, tensor in tensors.items()}
        name = str(buffers["q"].device)
        self._groups = [Group(each, i, name, buffers) for i, each in enumerate(found)]
        with wp.ScopedDevice(name):
            self._no_poses = wp.zeros((n, 0, 7), dtype=float)
            self._poses = wp.from_torch(self._obstacle_poses) if most else self._no_poses
        self._go_home(compiled)
        self._streams = _Streams(name, self._groups) if self.device.type == "cuda" else None
        if self._streams is not None:  # capturing ran steps
            self._go_home(compiled)
        self.counts.zero_()

    def reset(
        self,
        mask: torch.Tensor,
        q: torch.Tensor,
        block_pose: torch.Tensor,
        obstacle_poses: torch.Tensor | None = None,
    ) -> None:
        """Put some environments at rest; see ``Simulation.reset``.

        Raises:
            ValueError: If a shape is wrong.
            SimulationError: If the simulation is closed.
        """
        self._require_open()
        assert mask.shape == self._mask.shape
        self._mask.copy_(mask)
        self._reset_q.copy_(q)
        self._reset_pose.copy_(block_pose)
        if obstacle_poses is not None:
            self._obstacle_poses.copy_(obstacle_poses)
        poses = self._no_poses if obstacle_poses is None else self._poses
        with self._on_torch_stream():
            for group in self._groups:
                group.reset(poses)
                group.read()

    def step(self, targets: torch.Tensor) -> torch.Tensor:
        """Advance all environments by one control step; see ``Simulation.step``.

        Raises:
            ValueError: If the shape is wrong.
            SimulationError: If the simulation is closed.
        """
        self._require_open()
        if targets.shape != self._targets.shape:
            raise ValueError(
                f"targets have shape {tuple(targets.shape)}, not {tuple(self._targets.shape)}"
            )
        self._targets.copy_(targets)
        if self._streams is not None:
            self._streams.launch()
        else:
            with wp.ScopedDevice("cpu"):
                for group in self._groups:
                    group.step()
        diverged: torch.Tensor = self._diverged.bool()
        return diverged

    def faults(self) -> dict[int, str]:
        """Return the environments that diverged in the last step, each with the reason."""
        overflow = self._overflow.tolist()
        return {env: _fault(overflow[env]) for env in torch.nonzero(self._diverged)[:, 0].tolist()}

    def close(self) -> None:
        """Free everything; a second call does nothing."""
        self._groups, self._streams = [], None

    def _go_home(self, compiled: Sequence[World]) -> None:
        """Reset all environments to the home positions and to the poses of their scenes."""
        everything = torch.ones_like(self._mask, dtype=torch.bool)
        q, block = torch.zeros_like(self.q), torch.zeros_like(self.block_pose)
        poses = torch.zeros_like(self._obstacle_poses)
        rows = [torch.zeros(tensor.shape) for tensor in (q, block, poses)]
        for env, (scene, world) in enumerate(zip(self.scenes, compiled, strict=True)):
            rows[0][env, : world.robot.dof] = torch.tensor(world.robot.home)
            if scene.block is not None:
                pose = scene.block.pose
                rows[1][env] = torch.tensor((*pose.position, *pose.quaternion))
            for k, obstacle in enumerate(scene.obstacles):
                pose = obstacle.pose
                rows[2][env, k] = torch.tensor((*pose.position, *pose.quaternion))
        q, block, poses = (row.to(self.device) for row in rows)
        self.reset(everything, q, block, poses if poses.shape[1] else None)

    def _on_torch_stream(self) -> wp.ScopedStream | wp.ScopedDevice:
        """Return a context in which Warp launches its kernels after those of torch."""
        if self.device.type == "cpu":
            return wp.ScopedDevice("cpu")
        return wp.ScopedStream(wp.stream_from_torch(self.device))

    def _require_open(self) -> None:
        if not self._groups:
            raise SimulationError("the simulation is closed")


class _Streams:
    """A stream and a captured graph for each group, so that groups run side by side."""

    def __init__(self, device: str, groups: Sequence[Group]) -> None:
        """Capture the control step of each group, after one step that loads the kernels."""
        self._device = device
        self._streams = [wp.Stream(device) for _ in groups]
        self._graphs: list[wp.Graph] = []
        for stream, group in zip(self._streams, groups, strict=True):
            with wp.ScopedDevice(device), wp.ScopedStream(stream):
                group.step()
                with wp.ScopedCapture(stream=stream) as capture:
                    group.step()
                self._graphs.append(capture.graph)
        wp.synchronize_device(device)

    def launch(self) -> None:
        """Step all groups after the work of torch's current stream, which then waits for them."""
        main = wp.stream_from_torch(torch.device(self._device))
        begun = main.record_event()
        for stream, graph in zip(self._streams, self._graphs, strict=True):
            stream.wait_event(begun)
            wp.capture_launch(graph, stream=stream)
            main.wait_event(stream.record_event())


def _fault(overflow: int) -> str:
    """Return why a world diverged."""
    if overflow:
        bits = OverflowType(overflow & int(OverflowType.ALL))
        return f"diverged: its contacts do not fit into MuJoCo Warp's memory ({bits.name})"
    return DIVERGED


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
        [[LAG * speed_limit(w.robot.joints[k]) for k in w.robot.independent_joints] for w in rows],
        float,
    )
    return joints


def _things(world: World) -> kernels.Things:
    """Return the block and the obstacles of a structure."""
    model, things = world.model, kernels.Things()
    things.block_q_at, things.block_qd_at, things.block_mocap = -1, 0, -1
    if world.block is not None and world.block_moves:
        things.block_q_at = int(model.jnt_qposadr[model.body_jntadr[world.block]])
        things.block_qd_at = world.block_qd_at
    elif world.block is not None:
        things.block_mocap = int(model.body_mocapid[world.block])
    things.obstacles = _array(world.obstacles, int)
    return things


def _array(values: object, dtype: Callable[..., object]) -> wp.array:
    """Return an array in memory of Warp's current device."""
    return wp.array(np.asarray(values), dtype=dtype)


def _load(
    scenes: Sequence[Scene], contacts: Contacts | None, workers: int, device: torch.device
) -> WarpSimulation:
    """Load scenes; see ``Simulator.load``.

    Raises:
        SimulationError: If there are several workers.
    """
    if workers != 1:
        raise SimulationError(
            f"simulator 'warp' steps all environments at once: {workers} workers; expected 1"
        )
    return WarpSimulation(scenes, contacts, device=device)


SIMULATOR = Simulator(
    "warp",
    _load,
    native_step=None,
    max_envs=65_536,
    devices=("cuda",),  # tests use the CPU, where MuJoCo is far faster
)
