"""Edit distance of kinematic trees: how much of one body must be changed to get another."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from morphgen.model.geometry import IDENTITY, Box, Capsule, Cylinder, Pose, Shape, Sphere
from morphgen.model.inertia import bounding_box
from morphgen.model.kinematics import forward_kinematics
from morphgen.model.robot import Joint, Robot
from morphgen.typing import Array

KIND, AXIS, LENGTH, SHAPE, SIZE = 1 / 2, 1 / 4, 1 / 8, 1 / 16, 1 / 16
"""What two matched joints and their links can differ in, and what each difference costs at most."""
MOVABLE, FIXED = 1.0, 1 / 4
"""Cost to insert or delete a link on a joint that moves, and on one that does not."""
SOFTENING = 0.05
"""Lengths are compared by their ratio, but below this share of reach by their difference."""

_GROUND, _FIXED, _PRISMATIC, _TURNING = range(4)
_WEIGHTS = (0.0, FIXED, MOVABLE, MOVABLE)
_DIGITS = 6
"""Children are ordered by numbers of so many decimals, so that rounding does not shuffle them."""


@dataclass(frozen=True, eq=False)
class LabelledTree:
    """A robot as an ordered tree of labelled nodes, in postorder; lengths over its reach.

    A node is a link with the joint that attaches it. The last node is the ground, which every tree
    has, and which costs nothing.
    """

    kinds: NDArray[np.int64]
    """Ground, fixed, prismatic or turning, shape (n,)."""
    axes: Array
    """Unit axis in the root frame at home, zeros where nothing moves, shape (n, 3)."""
    lengths: Array
    """Distance from the frame of the link before to the joint, shape (n,)."""
    shapes: NDArray[np.int64]
    """None, box, cylinder (a capsule, too) or sphere, shape (n,)."""
    extents: Array
    """Edges of the box around that primitive, ascending, shape (n, 3)."""
    leftmost: tuple[int, ...]
    """The first leaf below every node."""

    @cached_property
    def weights(self) -> Array:
        """Cost to insert or delete every node, shape (n,)."""
        return np.array(_WEIGHTS)[self.kinds]

    @cached_property
    def keyroots(self) -> tuple[int, ...]:
        """For every leaf the highest node of which it is the first leaf, ascending."""
        return tuple(sorted({leaf: node for node, leaf in enumerate(self.leftmost)}.values()))


def labelled_tree(robot: Robot, shapes: Mapping[str, Shape], reach: float) -> LabelledTree:
    """A robot as a tree for ``normalised_distance``.

    Links without a shape on fixed joints are frames, no bodies: what hangs on them hangs on the
    link before. The order of children does not depend on the file: heavier subtrees come first,
    those of the same weight by what their nodes are.

    Args:
        robot: The body.
        shapes: The primitive of every link that has geometry.
        reach: What lengths are divided by, metres.

    Raises:
        RobotError: If an axis is zero.
        ValueError: If a shape is a mesh.
    """
    nodes, above = [_Node(_GROUND)], [-1]
    T_root_link = forward_kinematics(robot, robot.home)
    place: list[tuple[int, Pose]] = []
    """Of every link its node, or that of the link before, and the link's frame in that one's."""
    for k, link in enumerate(robot.links):
        joint = robot.joints[k - 1] if k else None
        node, T_node_link = place[robot.parents[k]] if k else (0, IDENTITY)
        if joint is not None:
            T_node_link = T_node_link @ joint.T_parent_joint
        shape = shapes.get(link.name)
        moves = joint is not None and joint.is_movable
        if shape is None and not moves:
            place.append((node, T_node_link))
            continue
        place.append((len(nodes), IDENTITY))
        above.append(node)
        length = math.hypot(*T_node_link.position)
        nodes.append(_node(joint, T_root_link[k, :3, :3], length, shape, reach))
    return _in_postorder(nodes, above)


@dataclass(frozen=True, eq=False)
class _Node:
    """What is compared of a link and its joint."""

    kind: int
    axis: Array = field(default_factory=lambda: np.zeros(3))
    length: float = 0.0
    shape: int = 0
    extents: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def key(self) -> tuple[float, ...]:
        """What nodes are sorted by."""
        axis = self.axis.round(_DIGITS) + 0.0
        sign = np.sign(axis[axis.nonzero()][:1]).sum()
        numbers = np.array([*(sign * axis), self.length, *self.extents])
        return (self.kind, self.shape, *numbers.round(_DIGITS).tolist())


def _node(
    joint: Joint | None, R_root_link: Array, length: float, shape: Shape | None, reach: float
) -> _Node:
    kind, axis = _FIXED, np.zeros(3)
    if joint is not None and joint.is_movable:
        kind = _PRISMATIC if joint.kind == "prismatic" else _TURNING
        # A joint's motion leaves its own axis where it is.
        axis = R_root_link @ np.array(joint.unit_axis)
    form = _shape_kind(shape)
    extents = np.zeros(3) if shape is None else _extents(shape)
    return _Node(kind, axis, length / reach, form, extents / reach)


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
    raise ValueError("a mesh is no primitive; morphgen.fitting.token_shapes.token_shapes gives one")


def _in_postorder(nodes: list[_Node], above: list[int]) -> LabelledTree:
    """The tree of nodes, each of which comes after the one above it; the first is the ground."""
    children: list[list[int]] = [[] for _ in nodes]
    keys: list[tuple[object, ...]] = [()] * len(nodes)
    below: list[list[int]] = [[] for _ in nodes]
    """Nodes of every subtree, in postorder."""
    for node in reversed(range(len(nodes))):
        children[node].sort(key=lambda child: keys[child])
        below[node] = [each for child in children[node] for each in below[child]] + [node]
        weight = math.fsum(_WEIGHTS[nodes[each].kind] for each in below[node])
        keys[node] = (-weight, nodes[node].key, *(keys[child] for child in children[node]))
        if node:
            children[above[node]].append(node)
    order = below[0]
    ordered = [nodes[node] for node in order]
    return LabelledTree(
        np.array([node.kind for node in ordered]),
        np.array([node.axis for node in ordered]),
        np.array([node.length for node in ordered]),
        np.array([node.shape for node in ordered]),
        np.array([node.extents for node in ordered]),
        tuple(order.index(below[node][0]) for node in order),
    )


def normalised_distance(a: LabelledTree, b: LabelledTree) -> float:
    """How different two bodies are, in [0, 1].

    With the edit distance d and the costs |a| and |b| to insert all of a tree,
    2 d / (|a| + |b| + d): Li and Chenguang, A metric normalization of tree edit distance, 2011.
    0 for the same body, 1 where nothing of one can be kept for the other.

    It is a metric of trees. Li and Chenguang prove the triangle inequality where all insertions
    cost the same. Ours do not, but the formula is the Steinhaus transform of the metric d with
    respect to the empty tree, from which |a| and |b| are the distances, and that is a metric for
    every metric d (Deza and Deza, Encyclopedia of Distances, chapter 4). Two robots that differ in
    what is not compared, such as limits, have the same tree.
    """
    distance = edit_distance(a, b)
    total = math.fsum(a.weights) + math.fsum(b.weights) + distance
    return 2 * distance / total if total else 0.0


def edit_distance(a: LabelledTree, b: LabelledTree) -> float:
    """The least cost to insert, delete and change nodes until one tree is the other.

    Zhang and Shasha, Simple fast algorithms for the editing distance between trees and related
    problems, 1989: nodes keep their order, and who is below whom.
    """
    change = change_costs(a, b).tolist()
    delete, insert = a.weights.tolist(), b.weights.tolist()
    subtree = [[0.0] * len(insert) for _ in delete]
    for root_a in a.keyroots:
        for root_b in b.keyroots:
            first_a, first_b = a.leftmost[root_a], b.leftmost[root_b]
            # forest[x][y]: from the first x nodes below root_a to the first y below root_b
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
    """Cost to make every node of one tree any node of the other, in [0, 1], shape (n_a, n_b).

    A sum of metrics, so itself one: whether the kind of joint is another; the angle between the
    axes, whichever way they point, over a right angle (in full if only one has an axis); the
    relative difference of the lengths; whether the shape is another, and the mean relative
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
    """Difference over the sum, in [0, 1): the Canberra metric, shifted to be smooth at zero."""
    return np.asarray(np.abs(a - b) / (a + b + SOFTENING))


def _extents(shape: Shape) -> Array:
    """Edges of the box around a shape along its own axes, ascending, metres."""
    low, high = bounding_box([Shape(shape.geometry)])
    return np.asarray(np.sort(high - low))
