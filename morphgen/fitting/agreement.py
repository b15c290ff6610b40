"""Do a robot's meshes and the primitives in their place collide in the same configurations?

The truth is the meshes themselves, triangle against triangle. Beside the primitives stands what a
simulator makes of the meshes: it takes each for its convex hull.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import cast

import fcl
import numpy as np
import trimesh
from numpy.typing import NDArray

from morphgen.checks.self_collision import SelfCollisionChecker, untested_pairs
from morphgen.model.geometry import Mesh, Shape
from morphgen.model.inertia import solid_mesh
from morphgen.model.kinematics import forward_kinematics, random_configurations
from morphgen.model.mesh import load_mesh
from morphgen.model.robot import Pair, Robot, sorted_pair


@dataclass(frozen=True)
class Agreement:
    """Counts of configurations; what is compared against the meshes themselves."""

    both: int
    """Both collide."""
    neither: int
    only_meshes: int
    only_other: int

    @property
    def precision(self) -> float:
        """Share of the configurations where the other collides in which meshes do, too."""
        return _share(self.both, self.only_other)

    @property
    def recall(self) -> float:
        """Share of the configurations where meshes collide in which the other does, too."""
        return _share(self.both, self.only_meshes)

    @property
    def accuracy(self) -> float:
        """Share of configurations on which the two agree."""
        return _share(self.both + self.neither, self.only_meshes + self.only_other)

    def as_dict(self) -> dict[str, float]:
        """Plain data for JSON."""
        shares = {name: round(getattr(self, name), 4) for name in ("precision", "recall")}
        return {**asdict(self), **shares, "accuracy": round(self.accuracy, 4)}


def agreement(
    meshes: Robot, primitives: Robot, n: int = 1000, seed: int = 0
) -> tuple[Agreement, Agreement]:
    """Compare collisions over random configurations.

    Pairs of links that either robot ignores are tested on neither.

    Args:
        meshes: The robot that is right.
        primitives: The same robot with other collision shapes.
        n: Random configurations, within the limits.
        seed: Their seed.

    Returns:
        How the primitives agree with the meshes, and how the meshes' convex hulls do.
    """
    ignored = {*untested_pairs(meshes), *primitives.ignore_pairs}
    q = random_configurations(meshes, n, np.random.default_rng(seed))
    truth = np.array(list(_mesh_collisions(meshes, ignored, q)))
    first, second = (
        _counts(
            truth,
            np.array(
                [bool(pairs) for pairs in SelfCollisionChecker(robot, ignored).penetrations(q)]
            ),
        )
        for robot in (primitives, meshes)
    )
    return first, second


def _mesh_collisions(robot: Robot, ignored: set[Pair], q: NDArray[np.float64]) -> Iterator[bool]:
    """Whether any two links' triangles meet, by configuration."""
    names = [link.name for link in robot.links if link.collisions]
    pairs = [pair for pair in combinations(names, 2) if sorted_pair(*pair) not in ignored]
    models = {link.name: _model(link.collisions) for link in robot.links if link.collisions}
    for T_root_link in forward_kinematics(robot, q):
        for name, collider in models.items():
            T = T_root_link[robot.link_index[name]]
            collider.setTransform(fcl.Transform(T[:3, :3], T[:3, 3]))
        yield any(_meet(models[a], models[b]) for a, b in pairs)


def _meet(a: fcl.CollisionObject, b: fcl.CollisionObject) -> bool:
    return bool(fcl.collide(a, b, fcl.CollisionRequest(), fcl.CollisionResult()))


def _model(shapes: tuple[Shape, ...]) -> fcl.CollisionObject:
    meshes = []
    for shape in shapes:
        geometry = shape.geometry
        mesh = load_mesh(geometry) if isinstance(geometry, Mesh) else solid_mesh(geometry)
        meshes.append(mesh.copy().apply_transform(shape.T_link_shape.matrix))
    whole = cast(trimesh.Trimesh, trimesh.util.concatenate(meshes))
    model = fcl.BVHModel()
    model.beginModel(len(whole.vertices), len(whole.faces))
    model.addSubModel(np.asarray(whole.vertices), np.asarray(whole.faces))
    model.endModel()
    return fcl.CollisionObject(model)


def _counts(truth: NDArray[np.bool_], other: NDArray[np.bool_]) -> Agreement:
    return Agreement(
        int((truth & other).sum()),
        int((~truth & ~other).sum()),
        int((truth & ~other).sum()),
        int((~truth & other).sum()),
    )


def _share(hits: int, misses: int) -> float:
    """1 where there is nothing to hit or miss."""
    return hits / (hits + misses) if hits + misses else 1.0
