"""Draw the similarity of all robots of the paper's scenarios: docs/images/splits/map.png.

    python docs/split_pictures.py [--measure tree]

A robot that several scenarios share is drawn once.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tqdm import tqdm

from morphgen.benchmark.figures import map_png
from morphgen.encoding.similarity import MEASURES, features, similarity_matrix
from morphgen.fitting.token_shapes import token_shapes
from morphgen.grammar.library import default_library
from morphgen.splits.split import Member, compose_member, read_split, split_names


def main() -> int:
    """Compute the similarities and draw them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--measure", default="tree", choices=sorted(MEASURES))
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "images" / "splits", help="folder"
    )
    args = parser.parse_args()
    library = default_library()
    members: dict[str, Member] = {}
    for name in split_names():
        split = read_split(name)
        for member in (*split.train, *split.test):
            members.setdefault(member.robot_hash, member)
    robots_features = []
    for member in tqdm(members.values(), unit="robot", file=sys.stderr):
        robot = compose_member(member, library)
        robots_features.append(features(robot, token_shapes(robot, library.folders)))
    names = [robot.name for robot in robots_features]
    categories = [member.category for member in members.values()]
    values = similarity_matrix(robots_features, args.measure)
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "map.png").write_bytes(map_png(names, {args.measure: values}, categories))
    print(f"{len(names)} robots: {args.out}/map.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
