"""The command line: ``main`` parses arguments and runs one command. No other package imports it."""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # imported when a command runs, so that Ctrl-C meanwhile is caught by main
    from argparse import Namespace

    from morphgen.cli.command import Parser


def build_parser() -> Parser:
    """Return the parser of every command; each sets ``run``, which may return an exit code."""
    from morphgen.cli.command import Parser, add_commands
    from morphgen.cli.commands import COMMANDS

    parser = Parser(
        prog="morphgen", description="Create robot morphologies, train policies on them, view them."
    )
    parser.add_argument("--version", action="store_true", help="print the version and exit")
    add_commands(parser, COMMANDS)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Returns:
        0 for success, 1 for findings or failed checks, 2 for invalid input, 130 when interrupted.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):  # names may have letters that a terminal lacks
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        try:
            return _run(argv)
        except KeyboardInterrupt as interrupt:
            text = str(interrupt) or "nothing half-written is left"
            print(f"morphgen: interrupted; {text}", file=sys.stderr)
            return 130
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
    from morphgen.cli.command import UsageError, parse
    from morphgen.errors import MorphgenError, one_line
    from morphgen.extras import missing_extra

    parser = build_parser()
    try:
        args = parse(parser, argv)
    except UsageError as error:
        print(f"morphgen: {one_line(str(error))}", file=sys.stderr)
        return 2
    if args.version:
        from importlib.metadata import version

        print(f"morphgen {version('morphgen')}")
        return 0
    if args.command is None:
        parser.print_help()
        return 2
    with _record_ctrl_c() as interrupts:
        try:
            return int(args.run(args) or 0)
        except Exception as error:
            if interrupts:  # a package that was being imported turned Ctrl-C into another error
                raise KeyboardInterrupt from error
            if isinstance(error, MorphgenError):
                return _refuse(error, str(error), args)
            if (text := missing_extra(error, args.extra)) is not None:
                return _refuse(error, text, args)
            if isinstance(error, BrokenPipeError) or not isinstance(error, OSError):
                raise
            return _refuse(error, f"{error.filename or 'output'}: {error.strerror}", args)


@contextmanager
def _record_ctrl_c() -> Iterator[list[int]]:
    """Raise ``KeyboardInterrupt`` on Ctrl-C as always, and append to the yielded list."""
    from morphgen.cli.progress import interrupts

    interrupts.clear()

    def record(number: int, frame: FrameType | None) -> None:
        interrupts.append(number)
        signal.default_int_handler(number, frame)

    before = signal.getsignal(signal.SIGINT)
    is_main = threading.current_thread() is threading.main_thread()
    if before is not signal.default_int_handler or not is_main:  # another handler, or ignored
        yield interrupts
        return
    signal.signal(signal.SIGINT, record)
    try:
        yield interrupts
    finally:
        signal.signal(signal.SIGINT, before)


def _refuse(error: Exception, text: str, args: Namespace) -> int:
    """Print in one line why the input is invalid; return the exit code."""
    from morphgen.errors import one_line

    message = one_line(text)
    if getattr(args, "json", False):
        import json

        print(json.dumps({"error": type(error).__name__, "message": message}))
    print(f"morphgen: {message}", file=sys.stderr)
    return 2
