"""Scenes as models of MuJoCo Warp: scenes of one structure share a model with rows of numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import mujoco
import mujoco_warp
import numpy as np
import warp as wp
from mujoco_warp import Model
from numpy.typing import NDArray

from morphgen.errors import SimulationError
from morphgen.tasks.sim.base import Scene
from morphgen.tasks.sim.mujoco_model import World

UNUSED = frozenset({"dof_length", "key_time", "key_qpos", "key_qvel", "key_act", "key_ctrl"})
"""Fields of a model that no step reads: sleeping is off, and keyframes are not used."""


@dataclass(frozen=True, eq=False)
class Structure:
    """Environments whose models differ only in numbers that MuJoCo Warp has for every world."""

    worlds: tuple[World, ...]
    """Compiled scenes, R of them: the one of world w is ``worlds[w % R]``."""
    envs: NDArray[np.int64]
    """Environment of each world, shape (w,)."""
    batched: dict[str, NDArray[Any]]
    """Rows of the fields of the model that differ, R rows each."""


@dataclass
class _Group:
    """A structure while its environments are collected."""

    first: World
    """Compiled scene with which the others are compared."""
    size: int = 0
    """Number of different compiled scenes."""
    batched: dict[str, None] = field(default_factory=dict)
    """Names of the fields in which they differ."""
    envs: list[int] = field(default_factory=list)
    """Environments."""


def structures(scenes: Sequence[Scene], compiled: Sequence[World]) -> list[Structure]:
    """Group environments by the structure of their models.

    Two models have one structure if all fields that MuJoCo Warp holds once for all worlds are
    equal: the tree, the types of joints, geoms and actuators, the pairs of geoms that are tested,
    and meshes. Masses, poses, sizes, limits and gains may differ.

    Args:
        scenes: Scene of each environment.
        compiled: Compiled scene of each environment; those that share one are the same object.

    Raises:
        SimulationError: If MuJoCo Warp does not support a model.
    """
    models: dict[int, Model] = {}
    groups: list[_Group] = []
    group_of_world: dict[int, _Group] = {}
    for env, world in enumerate(compiled):
        if id(world) not in group_of_world:
            models[id(world)] = model = _warp_model(world, scenes[env])
            for group in groups:
                names = _differences(models[id(group.first)], model)
                if all(map(_is_batched, names)) and _same_indices(group.first, world):
                    group.batched.update(dict.fromkeys(names))
                    break
            else:
                group = _Group(world)
                groups.append(group)
            group.size += 1
            group_of_world[id(world)] = group
        group_of_world[id(world)].envs.append(env)
    found = []
    for group in groups:
        rows = _cyclic_rows([compiled[env] for env in group.envs], group.size)
        batched = {
            name: np.concatenate([getattr(models[id(world)], name).numpy() for world in rows])
            for name in group.batched
        }
        found.append(Structure(rows, np.array(group.envs, dtype=np.int64), batched))
    return found


def put_model(structure: Structure, device: str) -> Model:
    """Return the model of a structure on a device, with a row of numbers for each of its worlds.

    Args:
        structure: The structure.
        device: Name of the device of Warp.
    """
    rows = len(structure.worlds)
    with wp.ScopedDevice(device):
        model = mujoco_warp.put_model(
            _prepared(structure.worlds[0].model), dict.fromkeys(structure.batched, rows)
        )
        for name, values in structure.batched.items():
            getattr(model, name).assign(values)
    model.opt.warn_overflow = 0  # it prints; ``WarpSimulation`` counts
    return model


def _prepared(model: mujoco.MjModel) -> mujoco.MjModel:
    """Clear the flag that MuJoCo Warp refuses: it never resets on its own."""
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    return model


def _warp_model(world: World, scene: Scene) -> Model:
    """Return a scene's model on the CPU.

    Raises:
        SimulationError: If MuJoCo Warp does not support it.
    """
    try:
        with wp.ScopedDevice("cpu"):
            return mujoco_warp.put_model(_prepared(world.model))
    except (NotImplementedError, ValueError) as error:
        raise SimulationError(
            f"robot {scene.robot.name!r}: MuJoCo Warp refuses the scene: {error}"
        ) from error


def _is_batched(name: str) -> bool:
    """Return whether a field of the model has numbers for every world."""
    spec = _FIELDS[name]
    return getattr(spec, "shape", ("",))[:1] == ("*",)


_FIELDS: dict[str, Any] = {f.name: f.type for f in fields(Model)}


def _differences(first: Model, other: Model) -> list[str]:
    """Return the names of the fields in which two models differ."""
    return [
        name
        for name in _FIELDS
        if name not in UNUSED and not _equal(getattr(first, name), getattr(other, name))
    ]


def _equal(a: Any, b: Any) -> bool:  # noqa: ANN401  # fields of any type
    """Return whether two values of a model's field are equal."""
    if isinstance(a, wp.array):
        first, other = a.numpy(), b.numpy()
        return bool(first.shape == other.shape and first.tobytes() == other.tobytes())
    if isinstance(a, np.ndarray):
        return bool(a.shape == b.shape and a.tobytes() == b.tobytes())
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(_equal(x, y) for x, y in zip(a, b, strict=True))
    if is_dataclass(a):
        return all(_equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    return bool(a == b)


def _same_indices(first: World, other: World) -> bool:
    """Return whether two worlds have joints, block and obstacles at the same indices."""
    return (
        np.array_equal(first.q_at, other.q_at)
        and np.array_equal(first.qd_at, other.qd_at)
        and np.array_equal(first.movable_q_at, other.movable_q_at)
        and np.array_equal(first.movable_qd_at, other.movable_qd_at)
        and first.block == other.block
        and np.array_equal(first.obstacles, other.obstacles)
        and np.array_equal(dof_leaders(first)[0], dof_leaders(other)[0])
    )


def dof_leaders(world: World) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.float64]]:
    """Return what each degree of freedom of a model follows.

    Returns:
        Independent joint that it follows, -1 for a block's; its gain; and its offset [rad or m],
        shape (nv,) each.
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
