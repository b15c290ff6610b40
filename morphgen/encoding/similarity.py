"""Three measures of the similarity of two robots, near duplicates, and maps of robots."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from morphgen.encoding.tokens import MAX_LINKS, POSITION, tokens
from morphgen.errors import BenchmarkError, nearest
from morphgen.model.geometry import IDENTITY, Box, Capsule, Cylinder, Pose, Shape, Sphere
from morphgen.model.inertia import bounding_box
from morphgen.model.kinematics import (
    driving_joints,
    forward_kinematics,
    frame_positions,
    joint_axes,
    joint_limits,
    reach_from_root,
    with_root_at,
)
from morphgen.model.robot import TOOL, Joint, Robot
from morphgen.model.rotation import Vec3
from morphgen.progress import report
from morphgen.typing import Array

SAMPLES = 65_536  # number of random configurations
CELLS = 10  # number of grid cells between the shoulder and the farthest tool position

_PARALLEL = 0.5  # sine of the angle below which two axes count as parallel
_IMMOBILE = 1e-9  # distance from the shoulder below which a tool counts as immobile [m]
_SEED = 0  # the same for all robots: equal robots have equal workspaces


@dataclass(frozen=True, eq=False)
class Workspace:
    """Density of a robot's tool positions over uniformly distributed joint positions."""

    density: Array
    """Share of configurations at each node of a grid on [-1, 1]^3, shape (21, 21, 21)."""
    shoulder: Vec3  # centre of the grid in the root frame [m]
    reach: float  # largest distance of the tool from the shoulder, the unit of the grid [m]


def workspace(robot: Robot) -> Workspace:
    """Sample the tool positions of a robot, uniformly within the limits of the joints that move it.

    The seed is fixed and joints are drawn from the base on, so that one arm with different grippers
    gets the same configurations. Each sample is distributed over the eight nodes around it.
    """
    points, centre, farthest = _tool_points(robot)
    return Workspace(_density(points / farthest), centre, farthest)


def tool_reach(robot: Robot) -> tuple[Vec3, float]:
    """Return the ``shoulder`` and the ``reach`` of a robot's ``workspace``."""
    _, centre, farthest = _tool_points(robot)
    return centre, farthest


def _tool_points(robot: Robot) -> tuple[Array, Vec3, float]:
    """Return tool positions from the shoulder, (3, n), the shoulder and the largest distance."""
    chain = _tool_chain(robot)
    centre = shoulder(robot)
    centred = with_root_at(robot, centre)
    points = frame_positions(centred, _configurations(centred, chain))
    farthest = max(
        reach_from_root(centred, TOOL), float(np.sqrt((points * points).sum(axis=0).max()))
    )
    if farthest < _IMMOBILE:
        raise BenchmarkError(
            f"robot {robot.name!r}: its tool only turns about its own origin, so it has no "
            "workspace; place the frame 'tool' at the working point"
        )
    return points, centre, farthest


def density_overlap(a: Workspace, b: Workspace) -> float:
    """Return the overlap of two densities, in [0, 1]; 1 for equal robots.

    The sum of the smaller density over all nodes (histogram intersection: Swain and Ballard, Color
    indexing, 1991), which is 1 minus half the L1 distance.
    """
    return float(min(np.minimum(a.density, b.density).sum(), 1.0))  # the sums are rounded


def shoulder(robot: Robot) -> Vec3:
    """Return the point of a robot around which its tool moves, in the root frame [m].

    It is the point on the first rotational axis between root and tool that is nearest to the next
    axis not parallel to it (Denavit-Hartenberg). If all are parallel, it is the point nearest to
    the tool; without any, the tool. Joints are in the middle of their range.
    """
    chain = _tool_chain(robot)
    T_root_link = forward_kinematics(robot, joint_limits(robot).mean(axis=1))
    tool = robot.frame(TOOL)
    T_root_tool = T_root_link[robot.link_index[tool.link]] @ tool.T_link_frame.matrix
    anchors, directions = joint_axes(robot, T_root_link)
    axes = [
        (anchors[k + 1], directions[k + 1])
        for k in chain
        if robot.joints[k].kind in ("revolute", "continuous")
    ]
    if not axes:
        return _vec3(T_root_tool[:3, 3])
    origin, direction = axes[0]
    target, normal = T_root_tool[:3, 3], direction
    for point, axis in axes[1:]:
        if np.linalg.norm(np.cross(direction, axis)) > _PARALLEL:
            # The normal is perpendicular to the other axis, in the plane of both directions.
            target, normal = point, direction - (direction @ axis) * axis
            break
    along = (target - origin) @ normal / (direction @ normal)
    return _vec3(origin + along * direction)


def _tool_chain(robot: Robot) -> tuple[int, ...]:
    """Return the indices of the joints between root and tool, after checking tool and limits."""
    names = [frame.name for frame in robot.frames]
    if TOOL not in names:
        raise BenchmarkError(
            f"robot {robot.name!r} has no frame {TOOL!r}{nearest(TOOL, names)}; name the link at "
            "its working point: morphgen import FILE --tool LINK"
        )
    chain = robot.joint_chain(robot.frame(TOOL).link)
    if not driving_joints(robot, chain):
        raise BenchmarkError(
            f"robot {robot.name!r}: no joint moves its tool, which is on link "
            f"{robot.frame(TOOL).link!r}; place the frame on a link that moves"
        )
    for k in robot.independent_joints:
        low, high = robot.joints[k].effective_limits
        if not 0 <= high - low < np.inf:
            raise BenchmarkError(
                f"robot {robot.name!r}: joint {robot.joints[k].name!r}: limits ({low:g}, {high:g}) "
                "are no range to draw from; morphgen check says how to mend them"
            )
    return chain


def _configurations(robot: Robot, chain: tuple[int, ...]) -> Array:
    """Draw uniform positions of the joints that move the tool, (dof, n); zeros for others."""
    moving = [*driving_joints(robot, chain)]
    low, high = joint_limits(robot)[moving].T[..., None]
    q = np.zeros((robot.dof, SAMPLES))
    q[moving] = low + (high - low) * np.random.default_rng(_SEED).random((len(moving), SAMPLES))
    return q


def _density(points: Array) -> Array:
    """Return the density of points (3, n) in [-1, 1]^3 on the grid, with trilinear weights."""
    side = 2 * CELLS + 1
    scaled = (points + 1) * CELLS
    low = np.minimum(scaled.astype(np.int64), side - 2)  # a point at +1 is in the last cell
    weights = np.stack([1 - (scaled - low), scaled - low])
    total = np.zeros(side**3)
    for corner in np.ndindex(2, 2, 2):
        x, y, z = low + np.array(corner)[:, None]
        weight = weights[corner[0], 0] * weights[corner[1], 1] * weights[corner[2], 2]
        total += np.bincount((x * side + y) * side + z, weight, side**3)
    return np.asarray(total.reshape(side, side, side) / points.shape[1])


def _vec3(values: Array) -> Vec3:
    x, y, z = values.tolist()
    return (x, y, z)


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

    kinds: NDArray[np.int64]  # kind of joint: ground, fixed, prismatic or rotational, shape (n,)
    axes: Array  # unit axis in the root frame at home, zeros for fixed joints, shape (n, 3)
    lengths: Array  # distance between the parent link's frame and the joint, shape (n,)
    shapes: NDArray[np.int64]
    """Kind of primitive: none, box, cylinder or capsule, or sphere, shape (n,)."""
    extents: Array  # edge lengths of the primitive's bounding box, ascending, shape (n, 3)
    leftmost: tuple[int, ...]  # leftmost leaf below each node, as an index, shape (n,)

    @cached_property
    def weights(self) -> Array:
        """Cost to insert or delete each node, shape (n,)."""
        return np.array(_WEIGHTS)[self.kinds]

    @cached_property
    def keyroots(self) -> tuple[int, ...]:
        """For each leaf, the highest node of which it is the leftmost leaf, ascending."""
        return tuple(sorted({leaf: node for node, leaf in enumerate(self.leftmost)}.values()))


def labelled_tree(robot: Robot, shapes: Mapping[str, Shape], reach: float) -> LabelledTree:
    """Convert a robot with its token shapes to a tree; lengths are divided by its reach [m].

    Links without a shape on fixed joints count as frames: their children are attached to their
    parent. Subtrees are sorted by cost, descending, then by labels, whatever their order in the
    file.
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
        children[node].sort(key=lambda child: keys[child])  # the file's order must not matter
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

    With the edit distance d and the costs |a| and |b| to insert a tree, it is 2 d / (|a| + |b| +
    d): Li and Chenguang, A metric normalization of tree edit distance, 2011. It is the Steinhaus
    transform of d with respect to the empty tree, and so a metric (Deza and Deza, Encyclopedia of
    Distances, chapter 4) also where the costs of insertions differ.
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

    It is a sum of metrics: see docs/similarity.md. Signs of axes do not count.
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
    tokens: Array  # tokens without the joint positions, shape (n_links, 32)
    tree: LabelledTree
    workspace: Workspace


@dataclass(frozen=True)
class Measure:
    """A measure of the similarity of two robots."""

    name: str
    function: Callable[[Features, Features], float]  # symmetric function of two robots
    larger_is_more_alike: bool  # True for a similarity, False for a distance
    meaning: str  # description for users

    @property
    def title(self) -> str:
        """Name and meaning."""
        return f"{self.name}: {self.meaning}"


def features(robot: Robot, shapes: Mapping[str, Shape], *, max_links: int = MAX_LINKS) -> Features:
    """Compute the properties of a robot, with its token shapes, that the measures compare."""
    table = tokens(robot, shapes, max_links=max_links)[:, : POSITION.start]
    space = workspace(robot)
    return Features(robot.name, table, labelled_tree(robot, shapes, space.reach), space)


def cosine(a: Features, b: Features) -> float:
    """Return the cosine similarity of the tokens, the smaller padded with zeros, in [-1, 1].

    As in AnyBody (arXiv 2505.14986, section 4), joint positions are left out.
    """
    n = min(len(a.tokens), len(b.tokens))
    product = float((a.tokens[:n] * b.tokens[:n]).sum())
    norms = np.linalg.norm(a.tokens) * np.linalg.norm(b.tokens)
    return float(np.clip(product / norms, -1.0, 1.0))  # rounding may exceed 1 by a last bit


def tree_distance(a: Features, b: Features) -> float:
    """Return the normalised edit distance of the kinematic trees, in [0, 1]; 0 for equal robots."""
    return normalised_distance(a.tree, b.tree)


def workspace_overlap(a: Features, b: Features) -> float:
    """Return the overlap of the tool position densities about the shoulders, in [0, 1]."""
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


def similarity_matrix(robots: Sequence[Features], measure: str) -> Array:
    """Compare all pairs of robots by a measure; return a symmetric matrix, shape (n, n)."""
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
    """Return the index of the first most similar robot of values (n,); None if all are NaN."""
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
    shares: tuple[float, float]  # shares of the total variation that the axes show, in [0, 1]

    @property
    def kept(self) -> float:
        """Share of the total variation that the map shows, in [0, 1]."""
        return sum(self.shares)


def classical_mds(distances: ArrayLike) -> MdsMap:
    """Embed distances (n, n) in the plane by classical multidimensional scaling (Torgerson, 1952).

    ``shares`` are parts of the sum of all eigenvalues' magnitudes (Mardia, Kent and Bibby,
    Multivariate analysis, 1979, section 14.4), because non-Euclidean distances give negative ones.
    The sign of each axis is such that the farthest point is positive.
    """
    d = np.asarray(distances, dtype=np.float64)
    squared = d * d
    rows = squared.mean(axis=0)
    values, vectors = np.linalg.eigh(-(squared - rows - rows[:, None] + rows.mean()) / 2)
    total = np.abs(values).sum()
    # eigh sorts ascending; rounding may make the second eigenvalue of points on a line negative.
    largest = np.maximum(values[::-1][:2], 0.0)
    points = np.zeros((len(d), 2))
    points[:, : len(largest)] = vectors[:, ::-1][:, :2] * np.sqrt(largest)
    if total <= _ZERO_EIGENVALUE * len(d) * squared.max(initial=0.0):
        return MdsMap(np.zeros_like(points), (1.0, 0.0))
    size = np.abs(points)
    farthest = (size >= size.max(axis=0) * (1 - _TIE_TOLERANCE)).argmax(axis=0)
    sign = np.where(points[farthest, [0, 1]] < 0, -1.0, 1.0)
    # Adding 0.0 turns -0.0 into 0.0.
    shares = [float(value / total) for value in largest] + [0.0]  # of one robot there is one
    return MdsMap(points * sign + 0.0, (shares[0], shares[1]))


@dataclass(frozen=True)
class NearThresholds:
    """Robots are near by tree distance and either cosine or workspace at the same reach."""

    tree: float  # tree distance below which two robots are near
    cosine: float  # cosine of the tokens above which two robots are near
    workspace: float = 0.999  # overlap of the tool positions above which workspaces are one
    reach: float = 0.01  # relative difference of the reach below which workspaces are one


NEAR_THRESHOLDS = NearThresholds(0.001, 0.99999)
"""Thresholds for sizes that differ by about one per cent, which is a manufacturing tolerance.

Changing the sizes of robots of the shipped grammars by 1 % gives tree distances of 0.0002 to 0.0011
and cosines above 0.999997; by 3 %, distances of 0.0007 to 0.0033 and cosines down to 0.99997. One
measure is not enough: the tree distance ignores where along a link the next one is attached. The
cosine depends little on sizes, because most token entries are flags and unit quaternions, but on
how links are listed: an empty link more, such as a flange, shifts all that follow. The workspace
depends on neither, but its unit is the reach, so the reach is compared beside it.
"""


def is_near(a: Features, b: Features) -> bool:
    """Return whether two robots are near duplicates."""
    near = NEAR_THRESHOLDS
    is_alike = cosine(a, b) > near.cosine or bool(
        is_same_reach(a.workspace.reach, b.workspace.reach)
        and workspace_overlap(a, b) > near.workspace
    )
    return is_alike and tree_distance(a, b) < near.tree  # the slowest measure comes last


def is_same_reach(a: ArrayLike, b: ArrayLike) -> NDArray[np.bool_]:
    """Return whether distances of the tool from the shoulder are nearly equal, elementwise."""
    return np.abs(np.subtract(a, b)) < NEAR_THRESHOLDS.reach * np.maximum(a, b)
