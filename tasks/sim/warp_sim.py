"""MuJoCo Warp as a simulator: all environments of one structure step in the same kernels."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import torch

from morphgen.errors import MissingDependencyError, SimulationError

try:
    import warp as wp
    from mujoco_warp import OverflowType
except ModuleNotFoundError as error:
    raise MissingDependencyError(
        f"simulator 'warp' needs MuJoCo Warp: {error}; install it with: pip install 'morphgen[gpu]'"
    ) from error
from morphgen.tasks.sim.base import (
    Contacts,
    Scene,
    Simulator,
    require_reset_shapes,
)
from morphgen.tasks.sim.mujoco_model import World, worlds
from morphgen.tasks.sim.warp_group import Group
from morphgen.tasks.sim.warp_model import structures

_log = logging.getLogger(__name__)
DIVERGED = "diverged: a target or the state is not finite, or a velocity is too large"


class WarpSimulation:
    """Environments in MuJoCo Warp, on a GPU or slowly on the CPU; a ``Simulation``.

    Environments whose models have one structure share a model with numbers for every robot, and
    step in the same kernels. On a GPU each structure has a stream and a captured CUDA graph of the
    whole control step, so that structures run side by side and nothing waits for the host.

    The model of a scene, the control law and the physics step are those of ``MujocoSimulation``,
    in single precision. The law uses the inertia of the current state, which on the CPU is that of
    one physics step before. Contacts are found by other algorithms, and a world holds a limited
    number of them (``max_contacts``).

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

    group_type = Group

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
        self._groups = [self.group_type(each, i, name, buffers) for i, each in enumerate(found)]
        with wp.ScopedDevice(name):
            self._no_poses = wp.zeros((n, 0, 7), dtype=float)
            self._poses = wp.from_torch(self._obstacle_poses) if most else self._no_poses
        self._streams = _Streams(name, self._groups) if self.device.type == "cuda" else None
        self._go_home(compiled)
        self.counts.zero_()  # capturing ran steps

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
        require_reset_shapes(self.scenes, self.q.shape[1], mask, q, block_pose, obstacle_poses)
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
        buffers = (self.q, self.block_pose, self._obstacle_poses)
        q, block, poses = (torch.zeros(buffer.shape) for buffer in buffers)
        for env, (scene, world) in enumerate(zip(self.scenes, compiled, strict=True)):
            q[env, : world.robot.dof] = torch.tensor(world.robot.home)
            boxes = [] if scene.block is None else [(block[env], scene.block)]
            for row, box in (*boxes, *zip(poses[env], scene.obstacles, strict=False)):
                row[:] = torch.tensor((*box.pose.position, *box.pose.quaternion))
        q, block, poses = (rows.to(self.device) for rows in (q, block, poses))
        everything = torch.ones_like(self._mask, dtype=torch.bool)
        self.reset(everything, q, block, poses if poses.shape[1] else None)

    def _on_torch_stream(self) -> wp.ScopedStream | wp.ScopedDevice:
        """Return a context in which Warp launches its kernels after those of torch."""
        if self.device.type == "cpu":
            return wp.ScopedDevice("cpu")
        return wp.ScopedStream(wp.stream_from_torch(self.device), sync_enter=False)

    def _require_open(self) -> None:
        if not self._groups:
            raise SimulationError("the simulation is closed")


class _Streams:
    """A stream and a captured graph for each group, so that groups run side by side."""

    def __init__(self, device: str, groups: Sequence[Group]) -> None:
        """Capture the control step of each group, after one step that loads the kernels."""
        if not kernels_stored(wp.get_device(device).arch):
            _log.warning("compiling MuJoCo Warp for this GPU: about three minutes, once")
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


def kernels_stored(arch: int) -> bool:
    """Return whether an earlier start compiled kernels for GPUs of an architecture.

    Args:
        arch: Compute capability, such as 90 for 9.0.
    """
    return any(Path(wp.config.kernel_cache_dir).rglob(f"*.sm{arch}.cubin"))


def _fault(overflow: int) -> str:
    """Return why a world diverged."""
    if overflow:
        bits = OverflowType(overflow & int(OverflowType.ALL))
        return f"diverged: its contacts do not fit into MuJoCo Warp's memory ({bits.name})"
    return DIVERGED


def _load(
    scenes: Sequence[Scene], contacts: Contacts | None, workers: int, device: torch.device
) -> WarpSimulation:
    """Load scenes; see ``Simulator.load``."""
    return WarpSimulation(scenes, contacts, device=device)


SIMULATOR = Simulator(
    "warp",
    _load,
    native_step=None,
    max_envs=65_536,
    devices=("cuda",),  # tests use the CPU, where MuJoCo is far faster
    takes_workers=False,
)
