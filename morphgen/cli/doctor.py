"""``morphgen demo`` and ``doctor``: the first commands, and a diagnosis of the installation."""

from __future__ import annotations

import argparse
import json
import shlex
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli import check, robots
from morphgen.cli import options as opt
from morphgen.cli.command import Parser, add_commands, command, option, parse

if TYPE_CHECKING:
    from morphgen.doctor import Entry


@command(
    "demo",
    "compose a UR5 with a plate, check it and load it in every installed loader",
    option("--out DIR", "output folder", Path, default=Path("robots")),
    details="Each command is printed before it runs. The extra conform installs all loaders.",
    examples=("demo",),
)
def demo(args: argparse.Namespace) -> int:
    """Run the commands until one fails; return its exit code."""
    from morphgen.formats.bundle import PICTURE

    bundle = args.out / "ur5-plane"
    parser = Parser(prog="morphgen")
    add_commands(parser, (robots.compose, check.check, check.conform))
    for words in (
        ["compose", "arm=ur5", "ee=plane", "--out", str(args.out)],
        ["check", str(bundle), "--strict"],
        ["conform", str(bundle)],
    ):
        print(f"$ morphgen {shlex.join(words)}", flush=True)
        parsed = parse(parser, words)
        if code := int(parsed.run(parsed) or 0):
            return code
    print(f"The robot is in {bundle}; its picture is {bundle / PICTURE}")
    return 0


STATUS_WIDTH = 8
"""Width of the first column [characters]."""


@command(
    "doctor",
    "print versions, simulators, GPU and caches, and test the installation",
    opt.JSON,
    details="A line per result: ok, absent (an optional package), warning, or error. The self-test "
    "composes, checks, loads, steps and draws a robot. The exit code is 1 if there is an error.",
    examples=("doctor", "doctor --json"),
)
def doctor(args: argparse.Namespace) -> int:
    """Print the results as they become known; return 1 if there is an error."""
    from morphgen.doctor import diagnose

    start, last = time.monotonic(), ""
    results: list[tuple[str, Entry]] = []
    for section, entry in diagnose():
        results.append((section, entry))
        if not args.json:
            if section != last:
                print(section)
            print(f"  {entry.status:<{STATUS_WIDTH}}{entry.name}: {entry.text}", flush=True)
        last = section
    counts = Counter(entry.status for _, entry in results)
    passed = not counts["error"]
    seconds = time.monotonic() - start
    if args.json:
        data = [{"section": section, **entry.as_dict()} for section, entry in results]
        print(json.dumps({"passed": passed, "seconds": round(seconds, 1), "results": data}))
    else:
        listed = ", ".join(f"{n} {status}" for status, n in counts.items())
        print(f"{'sound' if passed else 'NOT SOUND'}: {listed}, in {seconds:.1f} s")
    return int(not passed)
