"""How long it takes to sample and certify the goal sets of splits, robot by robot.

    python benchmarks/goal_sets.py [SPLIT ...] [--obstacles]

CPU time of this process in seconds; packaged and cached sets are not used.
"""

import argparse
import time

from tabulate import tabulate

from morphgen.grammar.library import default_library
from morphgen.splits.split import read_split
from morphgen.tasks.scenes.env_specs import env_spec, member_with_primitives
from morphgen.tasks.split_goals import certify_goal_set

SPLITS = ("interpolation/panda/push", "extrapolation/arms/push", "interpolation/panda/reach")


def main() -> None:
    """Print a row for each robot and the sum of each split."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("splits", nargs="*", metavar="SPLIT", default=SPLITS)
    parser.add_argument(
        "--obstacles", action="store_true", help="place every robot among obstacles"
    )
    args = parser.parse_args()
    library = default_library(())
    for name in args.splits:
        split, rows = read_split(name), []
        for member in (*split.train, *split.test):
            start = time.process_time()
            robot = member_with_primitives(member, library)
            composed = time.process_time()
            obstacles = args.obstacles or member.obstacles
            spec = env_spec(robot, member.task, obstacles=obstacles, anew=True)
            sampled = time.process_time()
            faults = certify_goal_set(spec.goals, spec)
            certified = time.process_time()
            if faults:
                raise SystemExit(f"{member.name}: {faults[0]}")
            rows.append((member.name, composed - start, sampled - composed, certified - sampled))
        total = ("all", *(sum(column) for column in list(zip(*rows, strict=True))[1:]))
        headers = (name, "compose [s]", "sample [s]", "certify [s]")
        print(tabulate([*rows, total], headers, floatfmt=".2f"), end="\n\n")


if __name__ == "__main__":
    main()
