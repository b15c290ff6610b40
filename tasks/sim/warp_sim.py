"""MuJoCo Warp as a simulator: all environments of one structure step in the same kernels."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any
from unittest import mock

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.errors import MissingDependencyError, SimulationError
from morphgen.processes import usable_cores

try:
    import mujoco_warp
    import warp as wp
    from mujoco_warp import Data, Model, OverflowType
except ModuleNotFoundError as error:
    raise MissingDependencyError(
        f"simulator 'warp' needs MuJoCo Warp: {error}; install it with: pip install 'morphgen[gpu]'"
    ) from error

from morphgen.tasks.sim import warp_kernels as kernels
from morphgen.tasks.sim.articulated import ObjectJoints
from morphgen.tasks.sim.base import (
    SUBSTEPS,
    Contacts,
    Scene,
    Simulation,
    Simulator,
    farthest_targets,
)
from morphgen.tasks.sim.mujoco_model import World, worlds

ITERATIONS = 12
"""Number of iterations of the solver in a physics step; converged worlds skip the rest.

At push on UR5, Panda and Jaco with a stick, MuJoCo takes 11 at most, and more than 8 in 0.5% of the
steps with constraints.
"""
UNUSED = frozenset({"dof_length", "key_time", "key_qpos", "key_qvel", "key_act", "key_ctrl"})
"""Fields of a model that no step reads: sleeping is off, and keyframes are not used."""


PAIRS = frozenset(
    {
        *("body_conaffinity", "geom_conaffinity", "geom_pair_type_count"),
        *("nxn_geom_pair_filtered", "nxn_pairid", "nxn_pairid_filtered"),
        *("nexclude", "exclude_signature"),
    }
)
"""Fields of a model that say which pairs of geoms are tested; ``_put_pairs`` sets them."""
MATERIAL = tuple(
    f"geom_{name}" for name in ("condim", "solmix", "solref", "solimp", "friction", "margin", "gap")
)
"""Fields of geoms that their contacts depend on, besides their priority."""
NEVER = -1e3
"""Margin of a pair that a world does not test [m]: the broad phase takes it to be far apart."""


@dataclass(frozen=True, eq=False)
class Structure:
    """Environments whose models differ only in numbers that MuJoCo Warp has for every world."""

    worlds: tuple[World, ...]  # compiled scenes, R of them: the one of world w is `worlds[w % R]`
    envs: NDArray[np.int64]  # environment of each world, shape (w,)
    batched: dict[str, NDArray[Any]]  # rows of the fields of the model that differ, R rows each
    pairs: NDArray[np.int64]  # pairs of geoms that any world tests, shape (P, 2)
    tested: NDArray[np.bool_]  # which of them the world of a row tests, shape (R, P)


# MuJoCo Warp asks for the version of mujoco three times for each model, which reads a file: half of
# the time.
@mock.patch.object(metadata, "version", cache(metadata.version))
def structures(scenes: Sequence[Scene], compiled: Sequence[World]) -> list[Structure]:
    """Group environments by the structure of their models.

    Two models have one structure if all fields that MuJoCo Warp holds once for all worlds are
    equal: the tree, the types of joints, geoms and actuators, and meshes. Masses, poses, sizes,
    limits, gains and the pairs of geoms that are tested may differ.
    """
    models: dict[int, Model] = {}
    values: dict[int, dict[str, object]] = {}  # of the fields of each model
    envs_of: dict[int, list[int]] = {}  # environments of each compiled scene
    groups: list[tuple[list[World], dict[str, None]]] = []
    for env, world in enumerate(compiled):
        if id(world) not in models:
            models[id(world)] = model = _warp_model(world, scenes[env])
            values[id(world)] = own = {name: _comparable(getattr(model, name)) for name in _FIELDS}
            for members, batched in groups:
                first = values[id(members[0])]
                names = {name for name, value in own.items() if value != first[name]}
                if not PAIRS.isdisjoint(names) and not _have_one_material(members[0], world):
                    continue
                names -= PAIRS
                if names <= _BATCHED and _same_indices(members[0], world):
                    members.append(world)
                    batched.update(dict.fromkeys(sorted(names)))
                    break
            else:
                groups.append(([world], {}))
        envs_of.setdefault(id(world), []).append(env)
    found = []
    for members, batched in groups:
        envs = sorted(env for world in members for env in envs_of[id(world)])
        rows = _cyclic_rows([compiled[env] for env in envs], len(members))
        numbers = {
            name: np.concatenate([getattr(models[id(world)], name).numpy() for world in rows])
            for name in batched
        }
        tested = [_tested_pairs(models[id(world)], rows[0].model.ngeom) for world in rows]
        pairs = np.argwhere(np.any(tested, axis=0))
        of_rows = np.array([matrix[*pairs.T] for matrix in tested])
        found.append(Structure(rows, np.array(envs, dtype=np.int64), numbers, pairs, of_rows))
    return found


def _tested_pairs(model: Model, ngeom: int) -> NDArray[np.bool_]:
    """Return which pairs of geoms a model tests, shape (ngeom, ngeom), upper triangle."""
    tested = np.zeros((ngeom, ngeom), dtype=bool)
    tested[*model.nxn_geom_pair_filtered.numpy().T] = True
    return tested


def _have_one_material(*members: World) -> bool:
    """Return whether all contacts between geoms without priority are alike: of links and ground."""
    models = [world.model for world in members]
    columns = [np.concatenate([getattr(model, name) for model in models]) for name in MATERIAL]
    is_plain = np.concatenate([model.geom_priority for model in models]) == 0
    rows = np.column_stack(columns)[is_plain]
    return bool((rows == rows[:1]).all())


def put_model(structure: Structure, device: str) -> Model:
    """Return the model of a structure on a device, with a row of numbers for each of its worlds."""
    rows = len(structure.worlds)
    with wp.ScopedDevice(device):
        model = mujoco_warp.put_model(
            _prepared(structure.worlds[0].model), dict.fromkeys(structure.batched, rows)
        )
        for name, values in structure.batched.items():
            getattr(model, name).assign(values)
        if not structure.tested.all():
            _put_pairs(model, structure)
    model.opt.warn_overflow = 0  # it prints; ``WarpSimulation`` counts
    # A loop that the GPU ends by itself can be no branch of a graph, so ``_StepGraph`` unrolls it.
    model.opt.graph_conditional, model.opt.iterations = False, ITERATIONS
    return model


def _put_pairs(model: Model, structure: Structure) -> None:
    """Have every world test its own pairs.

    Those that only some test become contact pairs of MuJoCo, which have a margin for each world and
    the material that all of them have; see ``_have_one_material``.
    """
    pairs, some = structure.pairs, ~structure.tested.all(axis=0)
    count, first = int(some.sum()), structure.worlds[0].model
    numbers = np.full_like(pairs, -1)
    numbers[some, 0] = np.arange(count)
    model.nxn_geom_pair_filtered = _array(pairs, model.nxn_geom_pair_filtered.dtype)
    model.nxn_pairid_filtered = _array(numbers, model.nxn_pairid_filtered.dtype)
    low, high = np.sort(first.geom_type[pairs], axis=1).T
    kinds = len(mujoco_warp.GeomType)
    kind = low * (2 * kinds - low - 1) // 2 + high
    size = len(model.geom_pair_type_count)
    model.geom_pair_type_count = tuple(np.bincount(kind, minlength=size).tolist())
    geom = int(np.flatnonzero(first.geom_priority == 0)[0])
    slide, spin, roll = first.geom_friction[geom]
    margins = np.where(structure.tested[:, some], first.geom_margin[geom], NEVER)
    values = {
        "margin": margins,
        "gap": [[first.geom_gap[geom]] * count],
        "adhesion": [[0.0] * count],
        "friction": [[(slide, slide, spin, roll, roll)] * count],
        "solref": [[first.geom_solref[geom]] * count],
        "solreffriction": [[(0.0, 0.0)] * count],  # that of the normal
        "solimp": [[first.geom_solimp[geom]] * count],
        "dim": [first.geom_condim[geom]] * count,
    }
    model.npair = count
    for name, rows in values.items():
        field = f"pair_{name}"
        setattr(model, field, _array(rows, getattr(model, field).dtype))


def _prepared(model: mujoco.MjModel) -> mujoco.MjModel:
    """Clear the flag that MuJoCo Warp refuses: it never resets on its own."""
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    return model


def _warp_model(world: World, scene: Scene) -> Model:
    """Return a scene's model on the CPU."""
    try:
        with wp.ScopedDevice("cpu"):
            return mujoco_warp.put_model(_prepared(world.model))
    except (NotImplementedError, ValueError) as error:
        raise SimulationError(
            f"robot {scene.robot.name!r}: MuJoCo Warp refuses the scene: {error}"
        ) from error


_FIELDS: dict[str, Any] = {f.name: f.type for f in fields(Model) if f.name not in UNUSED}
_BATCHED = {name for name, kind in _FIELDS.items() if getattr(kind, "shape", ())[:1] == ("*",)}
"""Fields that have numbers for every world."""


def _comparable(value: Any) -> object:  # noqa: ANN401  # fields of any type
    """Return a value of a model's field such that equal fields are equal, bit by bit."""
    if isinstance(value, wp.array):
        value = value.numpy()
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes()
    if isinstance(value, tuple | list):
        return [_comparable(each) for each in value]
    if is_dataclass(value):
        return [_comparable(getattr(value, field.name)) for field in fields(value)]
    return value


def _same_indices(first: World, other: World) -> bool:
    """Return whether two worlds have joints, block and obstacles at the same indices."""
    joints = ("q_at", "qd_at", "movable_q_at", "movable_qd_at")
    is_same = all(
        np.array_equal(getattr(first, name), getattr(other, name))
        for name in (*joints, "obstacles", "block_q_at", "object_q_at")
    )
    return is_same and np.array_equal(dof_leaders(first)[0], dof_leaders(other)[0])


def dof_leaders(world: World) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.float64]]:
    """Return the independent joint that each degree of freedom of a model follows, (nv,) each.

    It is -1 for a block's; then come the gain and the offset [rad or m].
    """
    matrix, offset = world.robot.mimic_map
    leader = np.full(world.model.nv, -1, dtype=np.int32)
    gain, shift = np.zeros((2, world.model.nv))
    # A joint that mimics one that cannot move has no leader: it stays, with a gain of zero.
    leader[world.movable_qd_at] = np.abs(matrix).argmax(axis=1)
    gain[world.movable_qd_at] = matrix[np.arange(len(matrix)), leader[world.movable_qd_at]]
    shift[world.movable_qd_at] = offset
    return leader, gain, shift


def _cyclic_rows(worlds: Sequence[World], distinct: int) -> tuple[World, ...]:
    """Return rows such that world w has row w % R: few if the worlds repeat, else one each."""
    rows = tuple(worlds[:distinct])
    if all(world is rows[i % len(rows)] for i, world in enumerate(worlds)):
        return rows
    return tuple(worlds)


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
        """Put the structure's worlds on the device; ``WarpSimulation`` resets them."""
        self._buffers, self._number = buffers, number
        first = structure.worlds[0]
        model = first.model
        count = len(structure.envs)
        contact_rows = 3 * max_contacts(model.ngeom)  # a normal and two tangents
        limited = np.count_nonzero(model.jnt_limited) + np.count_nonzero(model.dof_frictionloss)
        rows = int(model.neq + limited + contact_rows)
        with wp.ScopedDevice(device):
            self.model = put_model(structure, device)
            self.data = mujoco_warp.make_data(
                model,
                nworld=count,
                naconmax=max(count * CONTACTS_PER_WORLD, FEWEST_CONTACTS),
                njmax=rows,
            )
            _put_static_geoms(self.data, structure.worlds, count)
            self._joints = _joints(structure)
            self._acceleration = wp.zeros((count, model.nv), dtype=float)
            self._force = wp.zeros((count, model.nv), dtype=float)

    def step(self) -> None:
        """Launch the kernels of a control step.

        The control law sees the joint-space inertia and the Coriolis forces of the state that it
        acts on: MuJoCo computes them in the first half of a physics step.
        """
        data = self.data
        mujoco_warp.step1(self.model, data)
        state = [self._joints, self._buffers["targets"], data.qpos, data.qvel]
        wp.launch(
            kernels.accelerations,
            self._acceleration.shape,
            [*state, self.model.dof_damping],
            [self._acceleration, data.qfrc_applied],
        )
        mujoco_warp.mul_m(self.model, data, self._force, self._acceleration)
        forces = [self._force, data.qfrc_bias, data.qfrc_gravcomp]
        wp.launch(kernels.controls, data.ctrl.shape, [*state, *forces], [data.ctrl])
        mujoco_warp.step2(self.model, data)
        for _ in range(SUBSTEPS - 1):
            mujoco_warp.step(self.model, data)
        self.read()
        self._find_diverged()

    def read(self) -> None:
        """Write the state into the buffers."""
        data, out = self.data, self._buffers
        outputs = [out[name] for name in ("q", "qd", "object_pose", "object_velocity")]
        inputs = [self._joints, data.qpos, data.qvel]
        wp.launch(kernels.read_state, data.nworld, inputs, outputs)

    def _find_diverged(self) -> None:
        """Mark the environments that diverged in the step, and count them."""
        data, out = self.data, self._buffers
        state = [out["targets"], data.qpos, data.qvel, data.overflow]
        wp.launch(
            kernels.find_diverged,
            data.nworld,
            [self._joints, IGNORED_OVERFLOW, self._number, *state],
            [out["diverged"], out["counts"]],
        )

    def reset(self, obstacle_poses: wp.array) -> None:
        """Reset the worlds that the buffers mark, to the state in the buffers."""
        data, state = self.data, self._buffers
        wanted = [state["mask"], state["reset_q"], state["reset_pose"], obstacle_poses]
        dynamic = [data.qpos, data.qvel, data.qacc_warmstart]
        wp.launch(
            kernels.reset_worlds,
            data.nworld,
            [self._joints, *wanted],
            [*dynamic, data.mocap_pos, data.mocap_quat, data.overflow],
        )


def max_contacts(num_shapes: int) -> int:
    """Return how many contacts a world of so many shapes may have; with more it diverges.

    Trained arms that push had up to 1.3 contacts for each shape in MuJoCo.
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
    has_block = len(first.block_q_at) > 0
    joints.block_q_at = int(first.block_q_at[0]) if has_block else -1
    joints.block_qd_at = int(first.block_qd_at[0]) if has_block else 0
    objects = [world.object for world in rows if world.object is not None]
    joints.object_q_at = int(first.object_q_at[0]) if objects else -1
    if objects:
        moved = ObjectJoints(objects)
        joints.object_is_slide = int(moved.is_slide[0])
        joints.object_frame = _array(moved.frame, float)
        joints.object_axis = _array(np.hstack([moved.direction, moved.axis, moved.offset]), float)
    joints.obstacles = _array(first.obstacles, int)
    return joints


def _array(values: object, dtype: Callable[..., object]) -> wp.array:
    """Return an array in memory of Warp's current device."""
    return wp.array(np.asarray(values), dtype=dtype)


_log = logging.getLogger(__name__)
REPORT_AFTER = 10.0  # time after which loading reports its progress again [s]


class WarpSimulation(Simulation):
    """Environments in MuJoCo Warp, on a GPU or slowly on the CPU; a ``Simulation``.

    Environments whose models have one structure share a model with numbers for every robot, and
    step in the same kernels. On a GPU the whole control step is a captured CUDA graph, in which
    structures run side by side, and nothing waits for the host.

    The model of a scene, the control law and the physics step are those of ``MujocoSimulation``,
    in single precision. The law uses the inertia of the current state, which on the CPU is that of
    one physics step before. Contacts are found by other algorithms, and a world holds a limited
    number of them (``max_contacts``).

    ``counts`` has the numbers of control steps in which a world of each group diverged, and in
    which its contacts did not fit into the memory, shape (groups, 2), int32.
    """

    group_type = Group

    def __init__(
        self,
        scenes: Sequence[Scene],
        contacts: Contacts | None = None,
        *,
        device: torch.device | str = "cuda",
    ) -> None:
        super().__init__(scenes, torch.device(device))
        wp.config.log_level = wp.LOG_WARNING
        compiled = worlds(self.scenes, contacts or Contacts())
        found = structures(self.scenes, compiled)
        n, joints = len(scenes), max(world.robot.dof for world in compiled)
        shapes = dict.fromkeys(("q", "qd", "targets", "reset_q"), (n, joints))
        shapes |= {"object_pose": (n, 7), "reset_pose": (n, 7), "object_velocity": (n, 3)}
        tensors = {name: torch.zeros(shape, device=self.device) for name, shape in shapes.items()}
        for name, shape, dtype in (
            ("counts", (len(found), 2), torch.int32),
            ("diverged", (n,), torch.uint8),
            ("mask", (n,), torch.uint8),
        ):
            tensors[name] = torch.zeros(shape, dtype=dtype, device=self.device)
        self.q, self.qd, self.object_pose, self.object_velocity = (
            tensors[name] for name in ("q", "qd", "object_pose", "object_velocity")
        )
        self.counts, self._tensors = tensors["counts"], tensors
        self._obstacle_poses = torch.zeros(n, self._num_obstacles, 7, device=self.device)
        buffers = {name: wp.from_torch(tensor) for name, tensor in tensors.items()}
        name = str(buffers["q"].device)
        self._groups = [self.group_type(each, i, name, buffers) for i, each in enumerate(found)]
        with wp.ScopedDevice(name):
            self._no_poses = wp.zeros((n, 0, 7), dtype=float)
            has_obstacles = self._num_obstacles > 0
            self._poses = wp.from_torch(self._obstacle_poses) if has_obstacles else self._no_poses
        self._graph = _StepGraph(name, self._groups) if self.device.type == "cuda" else None
        self._go_home()
        self.counts.zero_()  # capturing ran steps

    def _reset(
        self,
        mask: torch.Tensor,
        q: torch.Tensor,
        object_pose: torch.Tensor,
        obstacle_poses: torch.Tensor | None,
    ) -> None:
        self._tensors["mask"].copy_(mask)
        self._tensors["reset_q"].copy_(q)
        self._tensors["reset_pose"].copy_(object_pose)
        if obstacle_poses is not None:
            self._obstacle_poses.copy_(obstacle_poses)
        poses = self._no_poses if obstacle_poses is None else self._poses
        with self._on_torch_stream():
            for group in self._groups:
                group.reset(poses)
                group.read()

    def _step(self, targets: torch.Tensor) -> torch.Tensor:
        self._tensors["targets"].copy_(targets)
        if self._graph is not None:
            self._graph.launch()
        else:
            with wp.ScopedDevice("cpu"):
                for group in self._groups:
                    group.step()
        return self._tensors["diverged"].bool()

    def close(self) -> None:
        """Free everything; a second call does nothing."""
        super().close()
        self._groups, self._graph = [], None

    def _on_torch_stream(self) -> wp.ScopedStream | wp.ScopedDevice:
        """Return a context in which Warp launches its kernels after those of torch."""
        if self.device.type == "cpu":
            return wp.ScopedDevice("cpu")
        return wp.ScopedStream(wp.stream_from_torch(self.device), sync_enter=False)


class _StepGraph:
    """The control step of all groups as a captured CUDA graph, with a branch for each group.

    The branches run side by side. Graphs of groups that streams of their own launch do not.
    """

    def __init__(self, device: str, groups: Sequence[Group]) -> None:
        load_kernels(groups, device)
        self._device = device
        with wp.ScopedDevice(device):
            for group in groups:
                group.step()  # loads what ``kernels_of`` missed: a capture cannot
            self._streams = [wp.Stream(device) for _ in (None, *groups)]
            main, *branches = self._streams
            wp.synchronize_device(device)
            with wp.ScopedStream(main), wp.ScopedCapture(stream=main) as capture:
                begun = main.record_event()
                for stream, group in zip(branches, groups, strict=True):
                    stream.wait_event(begun)
                    with wp.ScopedStream(stream, sync_enter=False):
                        group.step()
                    main.wait_event(stream.record_event())
            self._graph: wp.Graph = capture.graph
            wp.synchronize_device(device)

    def launch(self) -> None:
        """Step all groups in torch's current stream."""
        stream = wp.stream_from_torch(torch.device(self._device))
        wp.capture_launch(self._graph, stream=stream)


def load_kernels(groups: Sequence[Group], device: str) -> None:
    """Compile and load the kernels of a step of the groups, as many at once as there are cores.

    Warp alone loads a module when a kernel of it is launched first, one after the other: on an
    H100 with 16 cores the first start took 183 s so, and takes 27 s.
    """
    modules = kernels_of(groups, device)
    suffix = f".sm{wp.get_device(device).arch}.cubin"
    if not any(Path(wp.config.kernel_cache_dir).rglob(f"*{suffix}")):
        _log.warning("compiling %s parts of MuJoCo Warp for this GPU, once", len(modules))
    last = time.monotonic()
    with ThreadPoolExecutor(usable_cores()) as pool:
        loads = [pool.submit(module.load, wp.get_device(device), size) for module, size in modules]
        for done, load in enumerate(as_completed(loads), 1):
            load.result()
            if time.monotonic() > last + REPORT_AFTER:
                last = time.monotonic()
                _log.warning("compiled %s of %s parts of MuJoCo Warp", done, len(modules))


def kernels_of(groups: Sequence[Group], device: str) -> list[tuple[wp.Module, int | None]]:
    """Return the modules whose kernels a step of the groups launches, each with a block size.

    The step is run with kernels that load nothing, which Warp does not launch.
    """
    found: dict[tuple[wp.Module, int | None], None] = {}

    def note(module: wp.Module, _device: object, block_dim: int | None = None) -> None:
        found[module, block_dim] = None

    def block_size(kernel: wp.Kernel, _device: object) -> tuple[int, int]:
        found[kernel.module, None] = None
        return 256, 1  # Warp's default

    with (
        mock.patch.object(wp.Module, "load", note),
        mock.patch.object(wp, "get_suggested_block_size", block_size),
        wp.ScopedDevice(device),
    ):
        for group in groups:
            group.step()
    return list(found)


SIMULATOR = Simulator(
    "warp",
    lambda scenes, contacts, _, device: WarpSimulation(scenes, contacts, device=device),
    max_envs=65_536,
    devices=("cuda",),  # tests use the CPU, where MuJoCo is far faster
    takes_workers=False,
)
