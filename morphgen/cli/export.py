"""``morphgen export``: robots as files and folders of other tools, web pages and videos."""

from __future__ import annotations

import argparse
from pathlib import Path
from types import SimpleNamespace

from morphgen.api.export import write_export
from morphgen.cli import options as opt
from morphgen.formats.files import require_writable_folder
from morphgen.grammar.library import Library
from morphgen.grammar.robot_source import RobotReference, read_source


def export(args: argparse.Namespace) -> int:
    """Write a file or a folder for each robot."""
    if args.out is not None:
        require_writable_folder(args.out)
    given, paths = SimpleNamespace(**vars(args)), list[Path]()

    def write(source: RobotReference, library: Library) -> None:
        paths.append(write_export(source, read_source(source, library, args.root), given, paths))

    _, refused = opt.for_each_robot(args, "exporting", write)
    refusals = [{"robot": label, **error} for label, error in refused.items()]
    data = [*map(str, paths), *refusals]
    opt.print_result(args, data, lambda: "\n".join(map(str, paths)))
    return 2 if refused else 0
