"""``morphgen demo`` and ``doctor``: the first commands, and a diagnosis of the installation."""

from __future__ import annotations

import argparse
import json
import shlex
import time
from collections import Counter
from dataclasses import asdict

from morphgen.cli import build_parser
from morphgen.cli.command import parse
from morphgen.doctor import Entry, diagnose


def demo(args: argparse.Namespace) -> int:
    """Run the commands until one fails; return its exit code."""
    from morphgen.formats.bundle import PICTURE  # which a broken installation may lack

    bundle, parser = args.out / "ur5-plane", build_parser()
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


STATUS_WIDTH = 8  # width of the first column [characters]


def doctor(args: argparse.Namespace) -> int:
    """Print the results as they become known; return 1 if there is an error."""
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
        data = [{"section": section, **asdict(entry)} for section, entry in results]
        print(json.dumps({"passed": passed, "seconds": round(seconds, 1), "results": data}))
    else:
        listed = ", ".join(f"{n} {status}" for status, n in counts.items())
        print(f"{'sound' if passed else 'NOT SOUND'}: {listed}, in {seconds:.1f} s")
    return int(not passed)
