"""Three measures of the similarity of two robots, and maps of robots from their distances."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from morphgen.benchmark.tokens import MAX_LINKS, POSITION, tokens
from morphgen.benchmark.workspace import Workspace, density_overlap, workspace
from morphgen.errors import BenchmarkError, nearest
from morphgen.model.geometry import IDENTITY, Box, Capsule, Cylinder, Pose, Shape, Sphere
from morphgen.model.inertia import bounding_box
from morphgen.model.kinematics import forward_kinematics
from morphgen.model.robot import Joint, Robot
from morphgen.progress import report
from morphgen.typing import Array

KIND, AXIS, LENGTH, SHAPE, SIZE = 1 / 2, 1 / 4, 1 / 8, 1 / 16, 1 / 16
"""Largest cost of each difference between two matched joints and their links; they sum to 1."""
MOVABLE, FIXED = 1.0, 1 / 4
"""Cost to insert or delete a link on a movable joint, and on a fixed one."""
SOFTENING = 0.05
"""Length, relative to the reach, below which lengths differ by their difference instead of their
ratio."""

_GROUND, _FIXED, _PRISMATIC, _ROTATIONAL = range(4)
_WEIGHTS = (0.0, FIXED, MOVABLE, MOVABLE)
_DIGITS = 6
"""Decimals of the numbers that order children, so that rounding does not change their order."""


@dataclass(frozen=True, eq=False)
class LabelledTree:
    """A robot as an ordered tree of n labelled nodes in postorder; lengths are over its reach.

    A node is a link with the joint that attaches it. The last node is the ground, which every tree
    has and which costs nothing.
    """

    kinds: NDArray[np.int64]
    """Kind of joint: ground, fixed, prismatic or rotational, shape (n,)."""
    axes: Array
    """Unit axis in the root frame at home, zeros for fixed joints, shape (n, 3)."""
    lengths: Array
    """Distance between the parent link's frame and the joint, shape (n,)."""
    shapes: NDArray[np.int64]
    """Kind of primitive: none, box, cylinder or capsule, or sphere, shape (n,)."""
    extents: Array
    """Edge lengths of the primitive's bounding box, ascending, shape (n, 3)."""
    leftmost: tuple[int, ...]
    """Leftmost leaf below each node, as an index, shape (n,)."""

    @cached_property
    def weights(self) -> Array:
        """Cost to insert or delete each node, shape (n,)."""
        return np.array(_WEIGHTS)[self.kinds]

    @cached_property
    def keyroots(self) -> tuple[int, ...]:
        """For each leaf, the highest node of which it is the leftmost leaf, ascending."""
        return tuple(sorted({leaf: node for node, leaf in enumerate(self.leftmost)}.values()))


def labelled_tree(robot: Robot, shapes: Mapping[str, Shape], reach: float) -> LabelledTree:
    """Convert a robot to a tree for ``normalised_distance``.

    Links without a shape on fixed joints count as frames: their children are attached to their
    parent. The order of children does not depend on the file: subtrees are sorted by their cost,
    descending, and then by the labels of their nodes.

    shapes: One primitive per link with geometry, by link name.
    reach: Length by which all lengths are divided [m].
    """
    nodes, parents = [_Node(_GROUND)], [-1]
    T_root_link = forward_kinematics(robot, robot.home)
    # For each link, its node or that of the nearest ancestor with one, and its pose in that node.
    node_of: list[tuple[int, Pose]] = []
    for k, link in enumerate(robot.links):
        joint = robot.joints[k - 1] if k else None
        node, T_node_link = node_of[robot.parents[k]] if k else (0, IDENTITY)
        if joint is not None:
            T_node_link = T_node_link @ joint.T_parent_joint
        shape = shapes.get(link.name)
        moves = joint is not None and joint.is_movable
        if shape is None and not moves:
            node_of.append((node, T_node_link))
            continue
        node_of.append((len(nodes), IDENTITY))
        parents.append(node)
        length = math.hypot(*T_node_link.position)
        nodes.append(_node(joint, T_root_link[k, :3, :3], length, shape, reach))
    return _in_postorder(nodes, parents)


@dataclass(frozen=True, eq=False)
class _Node:
    """Label of a link and its joint."""

    kind: int
    axis: Array = field(default_factory=lambda: np.zeros(3))
    length: float = 0.0
    shape: int = 0
    extents: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def key(self) -> tuple[float, ...]:
        """Sort key, rounded and independent of the sign of the axis."""
        axis = self.axis.round(_DIGITS) + 0.0
        sign = np.sign(axis[axis.nonzero()][:1]).sum()
        numbers = np.array([*(sign * axis), self.length, *self.extents])
        return (self.kind, self.shape, *numbers.round(_DIGITS).tolist())


def _node(
    joint: Joint | None, R_root_link: Array, length: float, shape: Shape | None, reach: float
) -> _Node:
    kind, axis = _FIXED, np.zeros(3)
    if joint is not None and joint.is_movable:
        kind = _PRISMATIC if joint.kind == "prismatic" else _ROTATIONAL
        # A joint's motion does not change its own axis, so the child link's rotation serves.
        axis = R_root_link @ np.array(joint.unit_axis)
    shape_kind = _shape_kind(shape)  # before the extents, because it rejects meshes
    extents = np.zeros(3)
    if shape is not None:  # edge lengths of the bounding box along the shape's own axes
        low, high = bounding_box([Shape(shape.geometry)])
        extents = np.sort(high - low)
    return _Node(kind, axis, length / reach, shape_kind, extents / reach)


def _shape_kind(shape: Shape | None) -> int:
    match shape.geometry if shape else None:
        case Box():
            return 1
        case Cylinder() | Capsule():
            return 2
        case Sphere():
            return 3
        case None:
            return 0
    raise ValueError("a mesh has no label; morphgen.fitting.token_shapes.token_shapes gives one")


def _in_postorder(nodes: list[_Node], parents: list[int]) -> LabelledTree:
    """Sort nodes, the ground first and parents before children, into a tree in postorder."""
    children: list[list[int]] = [[] for _ in nodes]
    keys: list[tuple[object, ...]] = [()] * len(nodes)
    subtrees: list[list[int]] = [[] for _ in nodes]  # in postorder
    for node in reversed(range(len(nodes))):
        children[node].sort(key=lambda child: keys[child])
        subtrees[node] = [n for child in children[node] for n in subtrees[child]] + [node]
        weight = math.fsum(_WEIGHTS[nodes[n].kind] for n in subtrees[node])
        keys[node] = (-weight, nodes[node].key, *(keys[child] for child in children[node]))
        if node:
            children[parents[node]].append(node)
    order = subtrees[0]
    ordered = [nodes[node] for node in order]
    return LabelledTree(
        np.array([node.kind for node in ordered]),
        np.array([node.axis for node in ordered]),
        np.array([node.length for node in ordered]),
        np.array([node.shape for node in ordered]),
        np.array([node.extents for node in ordered]),
        tuple(order.index(subtrees[node][0]) for node in order),
    )


def normalised_distance(a: LabelledTree, b: LabelledTree) -> float:
    """Return the normalised edit distance of two trees, in [0, 1]; 0 for equal trees.

    With the edit distance d and the costs |a| and |b| to insert a whole tree, it is
    2 d / (|a| + |b| + d): Li and Chenguang, A metric normalization of tree edit distance, 2011.
    1 means that no part of one tree can be kept for the other.

    It is a metric of trees. Li and Chenguang prove the triangle inequality for equal costs of all
    insertions, which differ here. But the formula is the Steinhaus transform of the metric d with
    respect to the empty tree, at the distances |a| and |b|, which is a metric for every metric d
    (Deza and Deza, Encyclopedia of Distances, chapter 4). Properties that are not compared, such as
    joint limits, do not change the tree.
    """
    distance = edit_distance(a, b)
    total = math.fsum(a.weights) + math.fsum(b.weights) + distance
    return 2 * distance / total if total else 0.0


def edit_distance(a: LabelledTree, b: LabelledTree) -> float:
    """Return the minimum cost to turn one tree into another by inserting, deleting, changing nodes.

    Zhang and Shasha, Simple fast algorithms for the editing distance between trees and related
    problems, 1989. Matched nodes keep their order and ancestry.
    """
    change = change_costs(a, b).tolist()
    delete, insert = a.weights.tolist(), b.weights.tolist()
    subtree = [[0.0] * len(insert) for _ in delete]
    for root_a in a.keyroots:
        for root_b in b.keyroots:
            first_a, first_b = a.leftmost[root_a], b.leftmost[root_b]
            # forest[x][y]: distance of the first x nodes below root_a to the first y below root_b
            row = [0.0]
            for j in range(first_b, root_b + 1):
                row.append(row[-1] + insert[j])
            forest = [row]
            for i in range(first_a, root_a + 1):
                above, row = row, [row[0] + delete[i]]
                whole_a = a.leftmost[i] == first_a
                before = forest[a.leftmost[i] - first_a]
                for y, j in enumerate(range(first_b, root_b + 1)):
                    best = min(above[y + 1] + delete[i], row[y] + insert[j])
                    if whole_a and b.leftmost[j] == first_b:
                        best = subtree[i][j] = min(best, above[y] + change[i][j])
                    else:
                        best = min(best, before[b.leftmost[j] - first_b] + subtree[i][j])
                    row.append(best)
                forest.append(row)
    return float(subtree[-1][-1])


def change_costs(a: LabelledTree, b: LabelledTree) -> Array:
    """Return the cost to change each node of one tree to each of the other, (n_a, n_b), in [0, 1].

    It is a sum of metrics, and therefore a metric, of these differences: the kind of joint; the
    angle between the axes regardless of their sign, relative to a right angle (1 if only one joint
    is fixed); the relative difference of the lengths; the kind of primitive; and the mean relative
    difference of its extents.
    """
    kind = a.kinds[:, None] != b.kinds
    one_fixed = (a.kinds == _FIXED)[:, None] != (b.kinds == _FIXED)
    sine = np.linalg.norm(np.cross(a.axes[:, None], b.axes), axis=-1)
    cosine = np.abs((a.axes[:, None] * b.axes).sum(axis=-1))
    angle = np.arctan2(sine, cosine) / (np.pi / 2)
    costs = (
        KIND * kind
        + AXIS * np.where(one_fixed, 1.0, angle)
        + LENGTH * _relative(a.lengths[:, None], b.lengths)
        + SHAPE * (a.shapes[:, None] != b.shapes)
        + SIZE * _relative(a.extents[:, None], b.extents).mean(axis=-1)
    )
    ground = (a.kinds == _GROUND)[:, None] | (b.kinds == _GROUND)
    return np.where(ground, np.abs(a.weights[:, None] - b.weights), costs)


def _relative(a: Array, b: Array) -> Array:
    """Return |a - b| / (a + b + s), in [0, 1): the Canberra metric, with s to be smooth at zero."""
    return np.asarray(np.abs(a - b) / (a + b + SOFTENING))


@dataclass(frozen=True, eq=False)
class Features:
    """The properties of a robot that the measures compare."""

    name: str
    """Name of the robot."""
    tokens: Array
    """Tokens without the joint positions, shape (n_links, 32)."""
    tree: LabelledTree
    workspace: Workspace


@dataclass(frozen=True)
class Measure:
    """A measure of the similarity of two robots."""

    name: str
    """Name in ``MEASURES``."""
    function: Callable[[Features, Features], float]
    """Symmetric function of two robots."""
    larger_is_more_alike: bool
    """True for a similarity, False for a distance."""
    meaning: str
    """Description for users."""


def features(robot: Robot, shapes: Mapping[str, Shape], *, max_links: int = MAX_LINKS) -> Features:
    """Compute the properties of a robot that the measures compare.

    shapes: One primitive per link with geometry, by link name, as from ``token_shapes``.
    """
    table = compared_tokens(robot, shapes, max_links=max_links)
    space = workspace(robot)
    return Features(robot.name, table, labelled_tree(robot, shapes, space.reach), space)


def compared_tokens(
    robot: Robot, shapes: Mapping[str, Shape], *, max_links: int = MAX_LINKS
) -> Array:
    """Return the tokens that ``cosine`` compares, without joint positions, shape (n_links, 32).

    Arguments and errors are those of ``features``.
    """
    return tokens(robot, shapes, max_links=max_links)[:, : POSITION.start]


def cosine(a: Features, b: Features) -> float:
    """Return the cosine similarity of the concatenated tokens, in [-1, 1]; 1 for equal robots.

    As in AnyBody (arXiv 2505.14986, section 4), joint positions are left out and the smaller robot
    is padded with zeros.
    """
    n = min(len(a.tokens), len(b.tokens))
    product = float((a.tokens[:n] * b.tokens[:n]).sum())
    norms = np.linalg.norm(a.tokens) * np.linalg.norm(b.tokens)
    return float(np.clip(product / norms, -1.0, 1.0))


def tree_distance(a: Features, b: Features) -> float:
    """Return the normalised edit distance of the kinematic trees, in [0, 1]; 0 for equal robots."""
    return normalised_distance(a.tree, b.tree)


def workspace_overlap(a: Features, b: Features) -> float:
    """Return the overlap of the tool position densities, in [0, 1]; 1 for equal robots.

    Tool positions are relative to the shoulder and in units of reach.
    """
    return density_overlap(a.workspace, b.workspace)


MEASURES: Mapping[str, Measure] = MappingProxyType(
    {
        measure.name: measure
        for measure in (
            Measure("cosine", cosine, True, "cosine of the concatenated tokens"),
            Measure("tree", tree_distance, False, "edit distance of the kinematic trees"),
            Measure("workspace", workspace_overlap, True, "overlap of the tool positions"),
        )
    }
)
"""The measures by name."""


def similarity_matrix(
    robots: Sequence[Features],
    measure: str,
) -> Array:
    """Compare all pairs of robots.

    Returns:
        Symmetric matrix, shape (n, n).
    """
    function = get_measure(measure).function
    values = np.empty((len(robots), len(robots)))
    num_pairs = len(robots) * (len(robots) + 1) // 2
    for i, robot in enumerate(robots):
        for j in range(i + 1):
            values[i, j] = values[j, i] = function(robot, robots[j])
        report((i + 1) * (i + 2) // 2, num_pairs)
    return values


def to_distances(values: Array, measure: str) -> Array:
    """Convert a matrix of a measure to distances, shape (n, n): 1 - x for similarities."""
    distances = 1 - values if get_measure(measure).larger_is_more_alike else values.copy()
    np.fill_diagonal(distances, 0.0)
    return np.asarray(np.maximum(distances, 0.0))


def most_alike(values: Array, measure: str) -> int | None:
    """Return the index of the most similar robot, the first of several equal ones.

    values: A measure of the similarity to n robots, NaN where it is not known, shape (n,).

    Returns:
        The index; None if no value is known.
    """
    best = np.nanargmax if get_measure(measure).larger_is_more_alike else np.nanargmin
    return None if np.isnan(values).all() else int(best(values))


def get_measure(name: str) -> Measure:
    """Return a measure by name."""
    if name not in MEASURES:
        raise BenchmarkError(f"no measure {name!r}{nearest(name, MEASURES)}")
    return MEASURES[name]


_ZERO_EIGENVALUE = 1e-12
"""Sum of eigenvalues, relative to the largest squared distance, that counts as zero."""
_TIE_TOLERANCE = 1e-9
"""Relative difference within which two points count as equally far from the centre."""


@dataclass(frozen=True, eq=False)
class MdsMap:
    """A map of robots in the plane whose distances approximate given ones."""

    points: Array
    """Centred points in units of the distances, shape (n, 2); the first axis varies most."""
    kept: float
    """Share of the total variation that the two dimensions show, in [0, 1]."""


def classical_mds(distances: ArrayLike) -> MdsMap:
    """Embed distances in the plane by classical multidimensional scaling (Torgerson, 1952).

    The axes are the two largest eigenvectors of the doubly centred squared distances. ``kept`` is
    their share of the sum of all eigenvalues' magnitudes (Mardia, Kent and Bibby, Multivariate
    analysis, 1979, section 14.4), because non-Euclidean distances give negative eigenvalues. The
    sign of each axis is chosen so that the farthest point, or the first of several, is positive.

    distances: Symmetric distances with a zero diagonal, shape (n, n).
    """
    d = np.asarray(distances, dtype=np.float64)
    if d.ndim != 2 or d.shape[0] != d.shape[1] or not len(d):
        raise ValueError(f"distances have shape {d.shape}; expected (n, n)")
    if not np.isfinite(d).all() or (d < 0).any() or d.diagonal().any() or (d != d.T).any():
        raise ValueError("distances must be finite, symmetric, not negative, and 0 to oneself")
    squared = d * d
    rows = squared.mean(axis=0)
    values, vectors = np.linalg.eigh(-(squared - rows - rows[:, None] + rows.mean()) / 2)
    total = np.abs(values).sum()
    largest = np.maximum(values[::-1][:2], 0.0)
    points = np.zeros((len(d), 2))
    points[:, : len(largest)] = vectors[:, ::-1][:, :2] * np.sqrt(largest)
    if total <= _ZERO_EIGENVALUE * len(d) * squared.max(initial=0.0):
        return MdsMap(np.zeros_like(points), 1.0)
    size = np.abs(points)
    farthest = (size >= size.max(axis=0) * (1 - _TIE_TOLERANCE)).argmax(axis=0)
    sign = np.where(points[farthest, [0, 1]] < 0, -1.0, 1.0)
    # Adding 0.0 turns -0.0 into 0.0.
    return MdsMap(points * sign + 0.0, float(largest.sum() / total))
