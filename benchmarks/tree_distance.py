"""Time of the tree edit distance between two robots, compared with zss on the same trees.

    python benchmarks/tree_distance.py [--grammar arm5] [--n 12]

Computes the distance of every pair of sampled robots. zss is the common Python implementation of
the same algorithm (Zhang and Shasha, 1989) and uses unit costs here; ours also compares axes,
lengths and shapes. Prints medians in milliseconds and their ratio. zss comes with
`pip install morphgen[bench]`; without it its row is missing.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Any

from tabulate import tabulate

import morphgen
from morphgen.encoding.similarity import LabelledTree, edit_distance, labelled_tree
from morphgen.fitting.token_shapes import token_shapes


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--grammar", default="arm5")
    parser.add_argument("--n", type=int, default=12, help="number of robots")
    args = parser.parse_args()
    robots = morphgen.sample(args.grammar, args.n)
    trees = [labelled_tree(robot, token_shapes(robot), 1.0) for robot in robots]
    rows = [("morphgen", _median_ms(edit_distance, trees))]
    if find_spec("zss") is not None:
        import zss

        rows.append(("zss, unit costs", _median_ms(zss.simple_distance, map(_zss_tree, trees))))
        print(f"morphgen takes {rows[0][1] / rows[1][1]:.2f} of zss's time")
    nodes = sorted({len(tree.kinds) for tree in trees})
    print(f"{args.n} robots of {args.grammar}, nodes: {', '.join(map(str, nodes))}")
    print(tabulate(rows, ["implementation", "median ms per pair"], floatfmt=".2f"))
    return 0


def _median_ms(distance: Callable[[Any, Any], float], trees: Sequence[Any] | map[Any]) -> float:
    """Return the median time of all pairs of trees [ms]."""
    times = []
    for first, second in itertools.combinations(list(trees), 2):
        start = time.perf_counter()
        distance(first, second)
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times)


def _zss_tree(tree: LabelledTree) -> Any:  # noqa: ANN401  (zss has no types)
    """Return the tree as zss's nodes, labelled with the kind of joint."""
    import zss

    # In postorder, the subtree of node i is the run of nodes from its leftmost leaf to i.
    nodes = [zss.Node(str(kind)) for kind in tree.kinds]
    for i, node in enumerate(nodes):
        child = i - 1
        children = []
        while child >= tree.leftmost[i]:
            children.append(nodes[child])
            child = tree.leftmost[child] - 1
        for each in reversed(children):
            node.addkid(each)
    return nodes[-1]


if __name__ == "__main__":
    sys.exit(main())
