"""Draw how alike all robots of the paper's scenarios are: docs/images/splits/{heatmap,map}.png.

    python docs/split_pictures.py [--measure tree]

Every body once, whichever scenarios share it.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tqdm import tqdm

from morphgen.benchmark.figures import MapPanel, Panel, heatmap_png, map_png
from morphgen.benchmark.similarity import (
    MEASURES,
    classical_mds,
    features,
    similarity_matrix,
    to_distances,
)
from morphgen.benchmark.split import Member, compose_member
from morphgen.benchmark.split_file import read_split, split_names
from morphgen.fitting.token_shapes import token_shapes
from morphgen.grammar.library import default_library


def main() -> int:
    """Compare and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--measure", default="tree", choices=sorted(MEASURES))
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "images" / "splits", help="folder"
    )
    args = parser.parse_args()
    library = default_library()
    bodies: dict[str, Member] = {}
    for name in split_names():
        split = read_split(name)
        for member in (*split.train, *split.test):
            bodies.setdefault(member.robot_hash, member)
    found = []
    for member in tqdm(bodies.values(), unit="robot", file=sys.stderr):
        robot = compose_member(member, library)
        found.append(features(robot, token_shapes(robot, library.folders)))
    names = [each.name for each in found]
    measure = MEASURES[args.measure]
    values = similarity_matrix(found, args.measure)
    title = f"{args.measure}: {measure.meaning}"
    args.out.mkdir(parents=True, exist_ok=True)
    heat = heatmap_png(names, [Panel(title, values, measure.larger_is_more_alike)])
    (args.out / "heatmap.png").write_bytes(heat)
    placed = classical_mds(to_distances(values, args.measure))
    (args.out / "map.png").write_bytes(map_png(names, [MapPanel(title, placed)]))
    print(f"{len(names)} bodies: {args.out}/heatmap.png, {args.out}/map.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
