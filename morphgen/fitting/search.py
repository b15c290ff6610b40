"""Search for the primitives of largest intersection over union (IoU) with a solid.

Initial guesses are improved by gradient ascent on a soft IoU; counted sample points decide.

The membership of a point in a primitive is ``sigmoid(-distance / tau)``, so that the ratio of
volumes has a gradient; ``tau`` decreases during the ascent. The membership in a union is
``1 - prod(1 - membership)``, so overlaps count once. Many candidates, of one or several primitives
each, are optimised at once.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from morphgen.errors import FitError
from morphgen.fitting.canonical import KINDS, canonical
from morphgen.fitting.solid import Solid
from morphgen.model.geometry import Box, Cylinder, Pose, Shape, Sphere
from morphgen.model.rotation import IDENTITY, normalize
from morphgen.processes import one_torch_thread
from morphgen.typing import Array

TRIM = 0.03  # share of a cloud's points outside of a guess at either end of an axis
MIN_POINTS = 8  # smallest number of points of a cluster
_NUM_CLUSTERS = (1, 2, 3)
"""Numbers of clusters of the uncovered points, each of which may get a further primitive."""
_MIN_HALF_EXTENT = 1e-3  # smallest half extent of a guess, relative to the solid's size
_BOX, _CYLINDER, _SPHERE = map(KINDS.index, ("box", "cylinder", "sphere"))
_AXES_TO_Z = (
    np.eye(3),
    np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
)
"""Rotations whose z axis is the z, x and y axis."""
COARSE_POINTS = 2**11  # number of sample points of the first ascent
NEAR_POINTS, FAR_POINTS = 2**14, 2**12
"""Numbers of sample points close to the solid and further away."""
NEAR, FAR = 0.02, 0.35
"""Margins of their boxes around the bounding box, relative to the solid's size."""
NUM_CLUSTERINGS = 4  # number of clusterings from which the search for several primitives starts
NUM_REFINED = 2  # number of candidates that are refined on all sample points
DIGITS = 6  # decimals of dimensions and positions in metres; quaternions have three more
NUM_SPHERE_CLUSTERINGS = 2
"""Number of clusterings from which the search starts; more bring next to nothing."""
EMPHASES = (6.0, 20.0, 100.0)
"""Weights of points inside, relative to points outside, of fits that must cover the solid; tuned on
the Panda and the UR5. The best one is larger the thinner the solid and the fewer the spheres."""
RESERVE = 0.2
"""Share of the volume that may stay uncovered by which a fit covers more than it must, because the
cover is counted on sample points."""
_TAU = (0.02, 0.006)
"""Softness of the membership in the first ascent of several [sizes of the solid]."""
_MIN_RADIUS = 1e-3
"""Smallest radius of a guess and after a change of all radii [sizes of the solid]."""
_MAX_DISTANCES = 96_000  # number of distances that are evaluated together; bounds memory


@dataclass(frozen=True)
class Cloud:
    """Sample points over a solid and its surroundings."""

    points: Array  # points, shape (n, 3)
    inside: NDArray[np.bool_]  # which points are inside the solid, shape (n,)
    weights: Array
    """Volume that each point represents, shape (n,); for an ascent also one per candidate."""

    def take(self, chosen: slice | NDArray[np.bool_]) -> Cloud:
        """Return some of the points."""
        return Cloud(self.points[chosen], self.inside[chosen], self.weights[..., chosen])


@dataclass(frozen=True)
class Candidates:
    """``n`` candidates of ``k`` primitives each."""

    kinds: NDArray[np.int64]  # indices into `KINDS`, shape (n, k)
    centres: Array  # centres, shape (n, k, 3)
    quaternions: Array  # rotations (w, x, y, z) of any norm, shape (n, k, 4)
    halves: Array
    """Half extents, shape (n, k, 3). A cylinder has its radius first and half its length third; a
    sphere's radius is the first."""

    def take(self, rows: NDArray[np.intp]) -> Candidates:
        """Return the candidates of some rows."""
        return Candidates(*(array[rows] for array in vars(self).values()))

    @staticmethod
    def stack(blocks: list[Candidates], axis: int = 0) -> Candidates:
        """Concatenate candidates, or with ``axis=1`` the primitives of every candidate i."""
        arrays = zip(*(vars(candidates).values() for candidates in blocks), strict=True)
        return Candidates(*(np.concatenate(array, axis=axis) for array in arrays))


def ascend(
    candidates: Candidates,
    cloud: Cloud,
    *,
    num_steps: int,
    tau: tuple[float, float],
    rate: tuple[float, float],
) -> Candidates:
    """Return the candidates after gradient ascent (Adam) on the soft IoU.

    tau: Softness of the membership in the first and last step.
    rate: Learning rate in the first and last step.
    """
    kinds = torch.from_numpy(candidates.kinds)
    x, target, weight = (
        torch.from_numpy(array.astype(np.float32))
        for array in (cloud.points, cloud.inside, cloud.weights)
    )
    parameters = [
        torch.from_numpy(start.astype(np.float32)).requires_grad_()
        for start in (candidates.centres, candidates.quaternions, np.log(candidates.halves))
    ]
    centres, quaternions, logs = parameters
    # One step of a rotation or of a logarithm moves the surface about as far as one of a centre.
    size = float(np.exp(np.log(candidates.halves).mean()))
    groups = [
        {"params": [centres], "unit": 1.0},
        {"params": [quaternions], "unit": 0.5 / size},
        {"params": [logs], "unit": 1.0 / size},
    ]
    optimizer = torch.optim.Adam(groups, lr=rate[0], betas=(0.8, 0.98))  # short memory: 100 steps
    for step in range(num_steps):
        progress = step / max(num_steps - 1, 1)
        softness = tau[0] * (tau[1] / tau[0]) ** progress
        for group in optimizer.param_groups:
            group["lr"] = group["unit"] * rate[0] * (rate[1] / rate[0]) ** progress
        optimizer.zero_grad(set_to_none=True)
        distance = _distance(x, kinds, centres, quaternions, logs.exp())
        member = 1 - torch.exp(-torch.nn.functional.softplus(-distance / softness).sum(dim=1))
        member, weighted_target = member * weight, (target * weight).expand_as(member)
        intersection = (member * target).sum(dim=1)
        union = member.sum(dim=1) + weighted_target.sum(dim=1) - intersection
        loss = -(intersection / (union + 1e-9)).sum()  # a candidate may be far from all points
        torch.autograd.backward(loss)
        optimizer.step()
    with torch.no_grad():
        centres, quaternions, logs = (tensor.double() for tensor in parameters)
        unit = quaternions / quaternions.norm(dim=-1, keepdim=True)
    return Candidates(candidates.kinds, centres.numpy(), unit.numpy(), logs.exp().numpy())


def overlaps(candidates: Candidates, cloud: Cloud) -> Array:
    """Return the IoU of each candidate by counting points, shape (n,)."""
    target, weight = torch.from_numpy(cloud.inside), torch.from_numpy(cloud.weights)
    n, k = candidates.kinds.shape
    rows = max(_MAX_DISTANCES // (k * len(cloud.points)), 1)
    ious = []
    for start in range(0, n, rows):
        batch = candidates.take(np.arange(start, min(start + rows, n)))
        member = (_distances(batch, cloud.points) <= 0).any(dim=1)
        both, either = (count.double() @ weight for count in (member & target, member | target))
        ious.append(both / either.clamp(min=1e-12))
    return np.asarray(torch.cat(ious).numpy())


def covered(candidates: Candidates, points: Array) -> NDArray[np.bool_]:
    """Return which points (m, 3) are inside any primitive of each candidate, shape (n, m)."""
    return np.asarray((_distances(candidates, points) <= 0).any(dim=1).numpy())


@torch.no_grad()
def _distances(candidates: Candidates, points: Array) -> torch.Tensor:
    """Return signed distances, shape (n, k, m), without gradients."""
    arrays = (candidates.centres, candidates.quaternions, candidates.halves)
    return _distance(
        torch.from_numpy(points.astype(np.float32)),
        torch.from_numpy(candidates.kinds),
        *(torch.from_numpy(array.astype(np.float32)) for array in arrays),
    )


def _distance(
    x: torch.Tensor,
    kinds: torch.Tensor,
    centres: torch.Tensor,
    quaternions: torch.Tensor,
    halves: torch.Tensor,
) -> torch.Tensor:
    """Return signed distances (n, k, m) of points (m, 3) to primitives (n, k)."""
    n, k = kinds.shape
    if bool((kinds == _SPHERE).all()):
        # Spheres need no rotation of the points, which is most of the work.
        from_centres = torch.cdist(centres.reshape(1, n * k, 3), x[None])
        return from_centres.reshape(n, k, -1) - halves[:, :, :1]
    # Primitives are sorted by kind, so that each kind is one block of tensor operations.
    flat = kinds.reshape(-1)
    order = torch.argsort(flat, stable=True)
    local = _local(x, centres.reshape(-1, 3)[order], quaternions.reshape(-1, 4)[order])
    size = halves.reshape(-1, 3)[order][:, :, None]
    boxes, cylinders = (int((flat == KINDS.index(kind)).sum()) for kind in ("box", "cylinder"))
    end = boxes + cylinders
    distances = []
    if boxes:
        distances.append(_rounded(local[:boxes].abs() - size[:boxes]))
    if cylinders:
        points, half = local[boxes:end], size[boxes:end]
        # The square root has no finite gradient at zero, on the axis.
        radial = (points[:, :2].square().sum(dim=1) + 1e-12).sqrt() - half[:, 0]
        axial = points[:, 2].abs() - half[:, 2]
        distances.append(_rounded(torch.stack([radial, axial], dim=1)))
    if end < len(flat):
        distances.append((local[end:].square().sum(dim=1) + 1e-12).sqrt() - size[end:, 0])
    return torch.cat(distances)[torch.argsort(order)].reshape(n, k, -1)


def _rounded(beyond: torch.Tensor) -> torch.Tensor:
    """Return signed distances from the distances beyond each pair of faces, (p, faces, m)."""
    outside = (beyond.clamp(min=0).square().sum(dim=1) + 1e-16).sqrt()
    return outside + beyond.amax(dim=1).clamp(max=0)


def _local(x: torch.Tensor, centres: torch.Tensor, quaternions: torch.Tensor) -> torch.Tensor:
    """Return points (m, 3) in the frames of primitives, shape (p, 3, m)."""
    w, a, b, c = (quaternions / quaternions.norm(dim=-1, keepdim=True)).unbind(dim=-1)
    inverse = torch.stack(
        [
            torch.stack([1 - 2 * (b * b + c * c), 2 * (a * b + w * c), 2 * (a * c - w * b)], -1),
            torch.stack([2 * (a * b - w * c), 1 - 2 * (a * a + c * c), 2 * (b * c + w * a)], -1),
            torch.stack([2 * (a * c + w * b), 2 * (b * c - w * a), 1 - 2 * (a * a + b * b)], -1),
        ],
        dim=1,
    )
    return inverse @ x.T - (inverse @ centres[:, :, None])


def around(points: Array, axes: list[Array], *, sphere: bool = False) -> Candidates:
    """Return guesses of one primitive each around points, shape (n, 3).

    axes: Rotations, shape (3, 3) each, whose axes boxes and cylinders follow, besides the
        principal axes of the points.
    """
    _, principal_axes = np.linalg.eigh(np.cov(points.T))
    principal_axes *= (1.0, 1.0, np.linalg.det(principal_axes))  # right-handed
    guesses = [guess for R in (*axes, principal_axes) for guess in _along(points, R)]
    if sphere:
        centre = points.mean(axis=0)
        # The mean squared distance from the centre of a ball is 3/5 of its squared radius.
        radius = np.sqrt(5 / 3 * np.square(points - centre).sum(axis=1).mean())
        guesses.append((_SPHERE, centre, np.eye(3), np.full(3, radius)))
    kinds, centres, rotations, halves = (np.array(part) for part in zip(*guesses, strict=True))
    quaternions = Rotation.from_matrix(rotations).as_quat(scalar_first=True)
    return Candidates(kinds[:, None], centres[:, None], quaternions[:, None], halves[:, None])


def by_pieces(cloud: Cloud, k: int, seeds: list[int]) -> Candidates | None:
    """Return guesses of ``k`` primitives: the best guess around each of ``k`` clusters.

    None if a cluster has too few points in every clustering.
    """
    inside, outside = cloud.take(cloud.inside), cloud.take(~cloud.inside)
    rows: list[Candidates] = []
    for seed in seeds:
        _, label = kmeans2(inside.points, k, minit="++", seed=seed, iter=10)
        if np.bincount(label, minlength=k).min() >= MIN_POINTS:
            pieces = (inside.take(label == j) for j in range(k))
            rows.append(Candidates.stack([_best_of_each_kind(p, outside) for p in pieces], axis=1))
    return Candidates.stack(rows) if rows else None


def by_growth(fewer: Candidates, cloud: Cloud, seed: int) -> Candidates | None:
    """Return guesses with one more primitive, around a part of the solid that is not covered.

    None if too few points are uncovered.
    """
    outside = cloud.take(~cloud.inside)
    missed = cloud.take(cloud.inside & ~covered(fewer, cloud.points)[0])
    rows: list[Candidates] = []
    for n in _NUM_CLUSTERS:
        if len(missed.points) < n * MIN_POINTS:
            break
        _, label = kmeans2(missed.points, n, minit="++", seed=seed, iter=10)
        for j in range(n):
            if np.count_nonzero(label == j) >= MIN_POINTS:
                more = _best_of_each_kind(missed.take(label == j), outside)
                repeated = fewer.take(np.zeros(len(more.kinds), int))
                rows.append(Candidates.stack([repeated, more], axis=1))
    return Candidates.stack(rows) if rows else None


def _best_of_each_kind(piece: Cloud, outside: Cloud) -> Candidates:
    """Return guesses around a cluster inside the solid: the best, the best box, the best cylinder.

    outside: The points outside the solid.
    """
    guesses = around(piece.points, [np.eye(3)])
    pairs = zip(vars(piece).values(), vars(outside).values(), strict=True)
    ious = overlaps(guesses, Cloud(*(np.concatenate(pair) for pair in pairs)))
    kinds = guesses.kinds[:, 0]
    allowed = (kinds >= 0, kinds == _BOX, kinds == _CYLINDER)
    best = [int(np.argmax(np.where(rows, ious, -1.0))) for rows in allowed]
    return guesses.take(np.array(best))


def _along(points: Array, R: Array) -> list[tuple[int, Array, Array, Array]]:
    """Return a box along the axes of ``R`` and a cylinder along each of them.

    Each guess is a kind, a centre, a rotation and half extents.
    """
    low, high = np.quantile(points @ R, (TRIM, 1 - TRIM), axis=0)
    centre, halves = R @ (low + high) / 2, np.maximum((high - low) / 2, _MIN_HALF_EXTENT)
    guesses = [(_BOX, centre, R, halves)]
    for to_z in _AXES_TO_Z:
        x, y, z = np.abs(to_z.T @ halves)
        radius = np.sqrt(x * y)
        guesses.append((_CYLINDER, centre, R @ to_z, np.array([radius, radius, z])))
    return guesses


@dataclass(frozen=True)
class SampledSolid(Cloud):
    """A solid as sample points in the frame and units of its smallest bounding box.

    In that frame a thin oblique solid is hit by as many points as one along the link's axes. The
    points are shuffled, and the mean of their weights is 1; sparse points weigh more.
    """

    solid: Solid
    R_link_box: Array  # axes of the smallest bounding box in the link frame, shape (3, 3)
    centre: Array  # centre of the smallest bounding box in the link frame [m], shape (3,)

    @cached_property
    def link_points(self) -> Array:
        """The points in the link frame [m]."""
        return np.asarray(self.points * self.solid.size @ self.R_link_box.T + self.centre)

    def shapes(self, candidates: Candidates, row: int) -> tuple[Shape, ...]:
        """Return one candidate as rounded shapes in the link frame."""
        size = self.solid.size
        R_box_primitive = Rotation.from_quat(candidates.quaternions[row], scalar_first=True)
        R_link_primitive = Rotation.from_matrix(self.R_link_box) * R_box_primitive
        shapes = []
        for kind, centre, quaternion, halves in zip(
            candidates.kinds[row],
            candidates.centres[row] * size @ self.R_link_box.T + self.centre,
            R_link_primitive.as_quat(scalar_first=True),
            np.round(candidates.halves[row] * size, DIGITS),
            strict=True,
        ):
            x, y, z = np.maximum(halves, 10.0**-DIGITS).tolist()
            geometries = (Box((2 * x, 2 * y, 2 * z)), Cylinder(x, 2 * z), Sphere(x))
            a, b, c = np.round(centre, DIGITS).tolist()
            w, i, j, k = np.round(quaternion, DIGITS + 3).tolist()
            pose = Pose((a, b, c), normalize((w, i, j, k)))
            shapes.append(canonical(Shape(geometries[kind], pose)))  # in the order of KINDS
        return tuple(shapes)


@dataclass(frozen=True)
class SearchResult:
    """The best primitives of a search."""

    shapes: tuple[Shape, ...]  # primitives in the link frame
    iou: float  # intersection over union on the sample points of the search
    candidate: Candidates  # the same primitives in the frame of the search, one row


def sample_solid(solid: Solid, seed: int) -> SampledSolid:
    """Draw the sample points of a search."""
    T_box_link, extents = trimesh.bounds.oriented_bounds(solid.hull)
    T_link_box = np.linalg.inv(T_box_link)
    R_link_box, centre, extents = T_link_box[:3, :3], T_link_box[:3, 3], extents / solid.size
    near, far = extents / 2 + NEAR, extents / 2 + FAR
    rng = np.random.default_rng(seed)
    near_points = near * (2 * qmc.Sobol(3, rng=rng).random(NEAR_POINTS) - 1)
    far_points = far * (2 * qmc.Sobol(3, rng=rng).random(FAR_POINTS) - 1)
    far_points = far_points[np.any(np.abs(far_points) > near, axis=1)]
    points = np.concatenate([near_points, far_points])
    volumes = np.repeat(
        [np.prod(near) / NEAR_POINTS, np.prod(far) / FAR_POINTS],
        [len(near_points), len(far_points)],
    )
    order = rng.permutation(len(points))  # so that the first n are a sample of all
    points, volumes = points[order], volumes[order]
    inside = solid.contains(points * solid.size @ R_link_box.T + centre)
    if inside[:COARSE_POINTS].sum() < 2 * MIN_POINTS:
        raise FitError(f"the solid is too thin: it fills {inside.mean():.2%} of its bounding box")
    return SampledSolid(points, inside, volumes / volumes.mean(), solid, R_link_box, centre)


def best_single(target: SampledSolid) -> SearchResult:
    """Return the single primitive of largest IoU."""
    with one_torch_thread():
        cloud = target.points[target.inside]
        start = around(cloud, [np.eye(3), target.R_link_box.T], sphere=True)
        return _refine(target, _ascend_coarsely(target, start, (0.03, 0.008)))


def best_several(target: SampledSolid, fewer: SearchResult, seed: int) -> SearchResult | None:
    """Return the primitives of largest IoU, one more than in an earlier result.

    None if the solid has too few sample points for them.
    """
    seeds = [int(child) for child in np.random.SeedSequence(seed).generate_state(NUM_CLUSTERINGS)]
    cloud = target.take(slice(4 * COARSE_POINTS))
    with one_torch_thread():
        starts = (
            by_pieces(cloud, len(fewer.shapes) + 1, seeds),
            by_growth(fewer.candidate, cloud, seeds[0]),
        )
        guesses = [start for start in starts if start is not None]
        if not guesses:
            return None
        return _refine(target, _ascend_coarsely(target, Candidates.stack(guesses), _TAU))


def _refine(target: SampledSolid, coarse: Candidates) -> SearchResult:
    """Improve the best candidates on all points, and return the best one."""
    order = np.argsort(-overlaps(coarse, target), kind="stable")
    fine = _ascend_finely(target, coarse.take(order[:NUM_REFINED]))
    ious = overlaps(fine, target)
    row = int(np.argmax(ious))
    return SearchResult(target.shapes(fine, row), float(ious[row]), fine.take(np.array([row])))


def _ascend_coarsely(cloud: Cloud, start: Candidates, tau: tuple[float, float]) -> Candidates:
    """Improve candidates on few sample points."""
    few = cloud.take(slice(COARSE_POINTS))
    return ascend(start, few, num_steps=100, tau=tau, rate=(0.01, 0.003))


def _ascend_finely(cloud: Cloud, coarse: Candidates) -> Candidates:
    """Improve candidates on all sample points."""
    return ascend(coarse, cloud, num_steps=60, tau=(0.006, 0.0015), rate=(0.004, 0.0004))


def best_spheres(target: SampledSolid, n: int, cover: float | None, seed: int) -> SearchResult:
    """Return the spheres of largest IoU, of those that cover a share of the solid if given."""
    seeds = np.random.SeedSequence(seed).generate_state(NUM_SPHERE_CLUSTERINGS + 1).tolist()
    emphases = (1.0,) if cover is None else EMPHASES
    # Spheres are chosen for points that did not shape them, or they would cover less of others.
    judge = target if cover is None else sample_solid(target.solid, seeds[-1])
    with one_torch_thread():
        start, weights = _starts(target, n, seeds[:NUM_SPHERE_CLUSTERINGS], emphases)
        coarse = _ascend_coarsely(replace(target, weights=weights), start, _TAU)
        best = np.array([np.argmax(overlaps(_covering(target, coarse, cover), target))])
        fine = _ascend_finely(replace(target, weights=weights[best]), coarse.take(best))
        final = _covering(judge, fine, cover)
        (iou,) = overlaps(final, judge)
    return SearchResult(target.shapes(final, 0), float(iou), final)


def _starts(
    target: SampledSolid, n: int, seeds: list[int], emphases: tuple[float, ...]
) -> tuple[Candidates, Array]:
    """Return guesses from every clustering for every emphasis, and their weights of the points."""
    cloud = target.points[target.inside][: 2 * COARSE_POINTS]
    shape = (len(seeds), n)
    centres, radii = np.zeros((*shape, 3)), np.zeros(shape)
    for row, seed in enumerate(seeds):
        with warnings.catch_warnings():
            # A cluster without points is a guess as good as any.
            warnings.filterwarnings("ignore", "One of the clusters is empty")
            centres[row], label = kmeans2(cloud, n, minit="++", seed=seed, iter=10)
        squares = np.square(cloud - centres[row][label]).sum(axis=1)
        counts = np.maximum(np.bincount(label, minlength=n), 1)
        # The mean squared distance from the centre of a ball is 3/5 of its squared radius.
        radii[row] = np.sqrt(5 / 3 * np.bincount(label, squares, minlength=n) / counts)
    candidates = Candidates(
        np.full(shape, _SPHERE),
        centres,
        np.broadcast_to(IDENTITY, (*shape, 4)).copy(),
        np.repeat(np.maximum(radii, _MIN_RADIUS)[..., None], 3, axis=2),
    )
    emphasis = np.repeat(emphases, len(seeds))[:, None]
    weights = np.where(target.inside, emphasis, 1.0) * target.weights
    return Candidates.stack([candidates] * len(emphases)), weights


def _covering(cloud: Cloud, candidates: Candidates, cover: float | None) -> Candidates:
    """Return candidates that cover a share of the solid: the radii change by one length each."""
    if cover is None:
        return candidates
    share = 1 - (1 - cover) * (1 - RESERVE)
    away = _distances(candidates, cloud.points[cloud.inside]).amin(dim=1).double().numpy()
    order = np.argsort(away, axis=1)
    weights = cloud.weights[cloud.inside]
    last = np.argmax(np.cumsum(weights[order], axis=1) / weights.sum() >= share, axis=1)
    change = np.take_along_axis(away, order, axis=1)[np.arange(len(away)), last]
    halves = np.maximum(candidates.halves + change[:, None, None], _MIN_RADIUS)
    return replace(candidates, halves=halves)
