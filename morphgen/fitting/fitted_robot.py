"""A robot with fitted primitives: the quality of the fit, and how well its self-collisions agree.

The reference of self-collisions is the meshes themselves, triangle against triangle. The convex
hulls of the meshes, which simulators use, are compared with the same reference.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import cast

import fcl
import numpy as np
import trimesh
from numpy.typing import NDArray

from morphgen.checks.rules import triangle_collider
from morphgen.checks.self_collision import SelfCollisionChecker, untested_pairs
from morphgen.errors import FitError
from morphgen.fitting.link_fit import FitOptions
from morphgen.fitting.replace_collision import with_fits, with_primitives
from morphgen.fitting.robot_fit import FitReport, fit_links, fits_of
from morphgen.formats.fits import read_stored_fits
from morphgen.model.geometry import Shape
from morphgen.model.inertia import link_frame_mesh
from morphgen.model.kinematics import forward_kinematics, random_configurations
from morphgen.model.robot import Pair, Robot, sorted_pair


@dataclass(frozen=True)
class Agreement:
    """Numbers of configurations in which meshes and a substitute (primitives, hulls) collide."""

    both: int  # both the meshes and the substitute collide
    neither: int  # neither the meshes nor the substitute collide
    only_meshes: int  # the meshes collide, the substitute does not
    only_other: int  # the substitute collides, the meshes do not

    @property
    def precision(self) -> float:
        """Share of the substitute's collisions that are collisions of the meshes."""
        return _share(self.both, self.only_other)

    @property
    def recall(self) -> float:
        """Share of the meshes' collisions that are collisions of the substitute."""
        return _share(self.both, self.only_meshes)

    @property
    def accuracy(self) -> float:
        """Share of configurations in which both collide or neither does."""
        return _share(self.both + self.neither, self.only_meshes + self.only_other)

    def as_dict(self) -> dict[str, float]:
        """Return plain data for JSON."""
        shares = ("precision", "recall", "accuracy")
        return {**asdict(self), **{name: round(getattr(self, name), 4) for name in shares}}


def agreement(
    meshes: Robot, primitives: Robot, n: int = 1000, seed: int = 0
) -> tuple[Agreement, Agreement]:
    """Return how primitives, and convex hulls, agree with meshes on random self-collisions."""
    ignored = {*untested_pairs(meshes), *primitives.ignore_pairs}
    q = random_configurations(meshes, n, np.random.default_rng(seed))
    mesh_collisions = list(_mesh_collisions(meshes, ignored, q))
    # In the order of the fields of Agreement: do the meshes collide, does the substitute?
    cases = ((True, True), (False, False), (True, False), (False, True))
    agreements = []
    for robot in (primitives, meshes):
        penetrations = SelfCollisionChecker(robot, ignored).penetrations(q)
        counts = Counter(zip(mesh_collisions, map(bool, penetrations), strict=True))
        agreements.append(Agreement(*(counts[case] for case in cases)))
    return agreements[0], agreements[1]


def _mesh_collisions(robot: Robot, ignored: set[Pair], q: NDArray[np.float64]) -> Iterator[bool]:
    """Yield for each configuration if triangles of two links intersect."""
    names = [link.name for link in robot.links if link.collisions]
    pairs = [pair for pair in combinations(names, 2) if sorted_pair(*pair) not in ignored]
    models = {link.name: _model(link.collisions) for link in robot.links if link.collisions}
    for T_root_link in forward_kinematics(robot, q):
        for name, collider in models.items():
            T = T_root_link[robot.link_index[name]]
            collider.setTransform(fcl.Transform(T[:3, :3], T[:3, 3]))
        yield any(
            fcl.collide(models[a], models[b], fcl.CollisionRequest(), fcl.CollisionResult())
            for a, b in pairs
        )


def _model(shapes: tuple[Shape, ...]) -> fcl.CollisionObject:
    """Return the triangles of a link's shapes as one collision object in the link frame."""
    whole = cast(trimesh.Trimesh, trimesh.util.concatenate([*map(link_frame_mesh, shapes)]))
    return triangle_collider(np.asarray(whole.vertices), np.asarray(whole.faces))


def _share(hits: int, misses: int) -> float:
    return hits / (hits + misses) if hits + misses else 1.0


@dataclass(frozen=True)
class FittedRobot:
    """A fit of primitives to a robot."""

    source: Robot
    """The robot whose shapes were fitted."""
    report: FitReport
    """The primitives of each link, and their measured quality."""
    folders: tuple[Path, ...] = ()
    """Folders of parts, for their stored fits."""
    visual: bool = False
    """Whether ``robot`` has the primitives as its visual shapes, too."""

    @cached_property
    def robot(self) -> Robot:
        """The same robot with the primitives as its collision shapes, made at the first access.

        Its provenance has the report without durations.

        Raises:
            MeshError: If a mesh cannot be read.
            RobotError: If a joint axis is zero.
        """
        primitives = {row.link: row.fit.primitives for row in self.report.links}
        fits = fits_of(self.source, self.report, read_stored_fits(self.folders))
        fitted = with_fits(with_primitives(self.source, primitives, visual=self.visual), fits)
        provenance = {**self.source.provenance, "primitives": self.report.without_times()}
        return replace(fitted, provenance=provenance)

    def agreement(self, configurations: int = 1000, seed: int = 0) -> tuple[Agreement, Agreement]:
        """Compare self-collisions with those of the meshes over random configurations.

        Args:
            configurations: Number of configurations within the joint limits.
            seed: Seed of the configurations.

        Returns:
            The agreement of the primitives, and that of the meshes' convex hulls, with the meshes.
        """
        return agreement(self.source, self.robot, configurations, seed)


def fit_robot(
    robot: Robot,
    options: FitOptions,
    folders: tuple[Path, ...] = (),
    *,
    visual: bool = False,
    jobs: int = 1,
) -> FittedRobot:
    """Fit primitives to a robot's links; ``visual``: they replace the visual shapes, too."""
    if not any(link.solid_shapes for link in robot.links):
        raise FitError(f"robot {robot.name!r}: no link has a shape")
    report = fit_links(robot, options, jobs=jobs)
    return FittedRobot(robot, report, folders, visual)
