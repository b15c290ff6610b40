"""The front door: parses arguments and calls one function a command; nobody imports it."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence

from morphgen.cli import (
    check,
    compose,
    conform,
    derive,
    describe,
    evaluate,
    finetune,
    fit,
    goals,
    grammar,
    import_robot,
    list_parts,
    play,
    sample,
    similarity,
    speed,
    split,
    study,
    tokens,
    train,
    view,
)
from morphgen.errors import MorphgenError, one_line

COMMANDS = (
    compose,
    sample,
    list_parts,
    describe,
    check,
    conform,
    import_robot,
    fit,
    tokens,
    grammar,
    derive,
    similarity,
    split,
    goals,
    train,
    evaluate,
    finetune,
    study,
    play,
    speed,
    view,
)


def build_parser() -> argparse.ArgumentParser:
    """The parser of every command; each sets ``run``, which returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="morphgen", description="Author robot morphologies and put them to work."
    )
    parser.add_argument("--version", action="store_true", help="print the version and stop")
    commands = parser.add_subparsers(metavar="COMMAND", dest="command")
    for module in COMMANDS:
        module.add_parser(commands)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Returns:
        0 for success, 1 for findings or failed checks, 2 for bad input, 130 when interrupted.
    """
    try:
        try:
            return _run(argv)
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        print(f"morphgen: cannot print: {error.strerror}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 2


def _run(argv: Sequence[str] | None) -> int:
    parser = build_parser()
    args, words = parser.parse_known_args(argv)
    if any(word.startswith("-") for word in words) or not (words == [] or hasattr(args, "words")):
        parser.error(f"unrecognized arguments: {' '.join(words)}")
    if words:
        args.words += words
    if args.version:
        from importlib.metadata import version

        print(f"morphgen {version('morphgen')}")
        return 0
    if args.command is None:
        parser.print_help()
        return 2
    try:
        return int(args.run(args))
    except MorphgenError as error:
        return _refused(error, str(error), args)
    except KeyboardInterrupt:
        print("morphgen: interrupted; nothing half-written is left", file=sys.stderr)
        return 130
    except BrokenPipeError:
        raise
    except OSError as error:
        return _refused(error, f"{error.filename or 'output'}: {error.strerror}", args)


def _refused(error: Exception, text: str, args: argparse.Namespace) -> int:
    """Say in one line why the input was refused; return the exit code."""
    message = one_line(text)
    if getattr(args, "json", False):
        print(json.dumps({"error": type(error).__name__, "message": message}))
    print(f"morphgen: {message}", file=sys.stderr)
    return 2
