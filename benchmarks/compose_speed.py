"""Time of composing a robot, compared with robosuite in the same run.

    python benchmarks/compose_speed.py [--repeats 200]

In memory: compose an arm with an end-effector and write URDF text, with the parts loaded before,
once with primitive shapes and once with meshes; robosuite's `add_gripper` and `get_xml`, with the
models loaded before. Whole process: a cold `morphgen compose`, which writes a bundle and a picture,
and `morphgen --help`. Prints medians. robosuite comes with `pip install morphgen[bench]`; without
it the script prints that its row is missing.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.util import find_spec

from tabulate import tabulate

from morphgen.formats.urdf.write import urdf_text
from morphgen.grammar.compose import compose, join
from morphgen.grammar.library import default_library
from morphgen.grammar.request import parse_request

PRIMITIVE = "arm=lwr ee=plane"
MESH = "arm=panda ee=panda_hand"


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=200)
    args = parser.parse_args()
    rows = [
        (f"compose {PRIMITIVE}", _ours(PRIMITIVE, args.repeats, collide=False)),
        (f"compose {PRIMITIVE}, with ignore pairs", _ours(PRIMITIVE, args.repeats, collide=True)),
        (f"compose {MESH}", _ours(MESH, args.repeats, collide=False)),
        (f"compose {MESH}, with ignore pairs", _ours(MESH, 10, collide=True)),
    ]
    if find_spec("robosuite") is not None:
        rows.append(("robosuite Panda + PandaGripper", _robosuite(args.repeats)))
    with tempfile.TemporaryDirectory() as scratch:
        rows += [
            ("cold: morphgen --help", _process(["--help"])),
            ("cold: morphgen compose arm=ur5 ee=plane", _cold("arm=ur5 ee=plane", scratch)),
            (f"cold: morphgen compose {PRIMITIVE}", _cold(PRIMITIVE, scratch)),
            (f"cold: morphgen compose {MESH}", _cold(MESH, scratch)),
        ]
    print(tabulate([(name, f"{ms:.3g}") for name, ms in rows], ["what", "median ms"]))
    times = dict(rows)
    if "robosuite Panda + PandaGripper" in times:
        ratio = times[f"compose {PRIMITIVE}"] / times["robosuite Panda + PandaGripper"]
        print(f"composing primitive parts takes {ratio:.2f} of robosuite's time")
    else:
        print("robosuite is not installed: no peer in this run (pip install 'morphgen[bench]')")
    return 0


def _ours(text: str, repeats: int, *, collide: bool) -> float:
    """Return the time of composing a robot and making its URDF [ms].

    Args:
        text: Words of the robot.
        repeats: Number of measurements; the median is returned.
        collide: Also find the pairs of links whose collisions are to be ignored.
    """
    library = default_library()
    build = compose if collide else join

    def once() -> None:
        robot = build(parse_request(text.split(), library), library, "robot")
        urdf_text(robot, lambda mesh: mesh.path.name)

    return _median(once, repeats)


def _robosuite(repeats: int) -> float:
    from robosuite.models.grippers import gripper_factory
    from robosuite.models.robots import Panda

    times = []
    for _ in range(repeats):
        robot, gripper = Panda(), gripper_factory("PandaGripper")
        start = time.perf_counter()
        robot.add_gripper(gripper)
        robot.get_xml()
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


def _cold(text: str, scratch: str) -> float:
    return _process(["compose", *text.split(), "--out", scratch])


def _process(arguments: list[str]) -> float:
    command = [sys.executable, "-m", "morphgen", *arguments]
    return _median(lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL), 5)


def _median(once: Callable[[], object], repeats: int) -> float:
    """Return the median time of a call [ms], after one call that is not counted."""
    once()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        once()
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


if __name__ == "__main__":
    sys.exit(main())
