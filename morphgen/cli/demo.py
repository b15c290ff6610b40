"""``morphgen demo``: the first commands, which need none of the extras."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from morphgen.cli import check, robots
from morphgen.cli.command import Parser, add_commands, command, parse, path_option


@command(
    "demo",
    "compose a UR5 with a plate, check it and load it in every installed loader",
    path_option("--out", "DIR", "output folder", default=Path("robots")),
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
