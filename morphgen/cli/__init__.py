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


def build_parser(words: Sequence[str] = ()) -> Parser:
    """Return the parser of every command, or of the one that the words have."""
    from morphgen.cli.command import Parser, add_commands, read_commands

    parser = Parser(
        prog="morphgen", description="Create robot morphologies, train policies on them, view them."
    )
    parser.add_argument("--version", action="store_true", help="print the version and exit")
    add_commands(parser, read_commands(words))
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code: 0 for success, 1 for findings, 2 for invalid input.

    It is 130 when interrupted, 143 when terminated, 129 when the terminal was closed.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):  # names may have letters that a terminal lacks
        sys.stdout.reconfigure(errors="backslashreplace")
    received: list[int] = []
    try:
        try:
            return _run(argv, received)
        except KeyboardInterrupt as interrupt:
            text = str(interrupt) or "nothing half-written is left"
            print(f"morphgen: interrupted; {text}", file=sys.stderr)
            # Else python -m ends by the signal if it interrupted an exec, as that of a dataclass.
            exec("")
            return 128 + (received or [signal.SIGINT])[0]  # as a shell reports a signal
        finally:
            if sys.stdout is not None:  # it is None without a console, as under pythonw
                sys.stdout.flush()
    except BrokenPipeError:  # the reader, such as head, has all it wanted
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        print(f"morphgen: cannot print: {error.strerror}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 2


def _run(argv: Sequence[str] | None, received: list[int]) -> int:
    """Run a command; the signals that stop it are appended to ``received``."""
    from morphgen.cli.command import UsageError, parse
    from morphgen.errors import MorphgenError, missing_extra, one_line

    parser = build_parser(sys.argv[1:] if argv is None else argv)
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
    with _stopping_cleanly(received):
        try:
            return int(args.run(args) or 0)
        except Exception as error:
            if received:  # a package that was being imported turned Ctrl-C into another error
                raise KeyboardInterrupt from error
            if isinstance(error, MorphgenError):
                return _refuse(error, str(error), args)
            if (text := missing_extra(error, args.extra)) is not None:
                return _refuse(error, text, args)
            if isinstance(error, BrokenPipeError) or not isinstance(error, OSError):
                raise
            return _refuse(error, f"{error.filename or 'output'}: {error.strerror or error}", args)


@contextmanager
def _stopping_cleanly(received: list[int]) -> Iterator[None]:
    """Raise ``KeyboardInterrupt`` on every signal that stops a command, so that it cleans up.

    The signals are appended to the list. Those that have another handler, or are ignored as by
    ``nohup``, stay as they are.
    """
    from morphgen.progress import STOP_SIGNALS, interrupts

    interrupts.clear()
    defaults = (signal.default_int_handler, signal.SIG_DFL)
    before = {each: signal.getsignal(each) for each in (signal.SIGINT, *STOP_SIGNALS)}
    before = {each: handler for each, handler in before.items() if handler in defaults}

    def stop(number: int, frame: FrameType | None) -> None:
        received.append(number)
        interrupts.append(number)
        for each in STOP_SIGNALS:  # often sent twice: the second would stop the cleaning up
            if each in before and number in STOP_SIGNALS:
                signal.signal(each, signal.SIG_IGN)
        signal.default_int_handler(number, frame)

    if threading.current_thread() is not threading.main_thread():
        before = {}
    for each in before:
        signal.signal(each, stop)
    try:
        yield
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)


def _refuse(error: Exception, text: str, args: Namespace) -> int:
    """Print in one line why the input is invalid; return the exit code."""
    from morphgen.errors import one_line

    message = one_line(text)
    if getattr(args, "json", False):
        import json

        print(json.dumps({"error": type(error).__name__, "message": message}))
    print(f"morphgen: {message}", file=sys.stderr)
    return 2
