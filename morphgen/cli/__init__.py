"""The front door: parses arguments and calls one function a command; nobody imports it."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

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

EXTRAS = {
    "embreex": "fit",
    "fast_simplification": "fit",
    "gymnasium": "tasks",
    "imageio": "tasks",
    "tensorboard": "rl",
    "torch": "rl",
    "viser": "viewer",
    "websockets": "viewer",
}
"""Optional packages by import name, and the extra of morphgen that brings each."""
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


class UsageError(MorphgenError):
    """The words of the command line are not what the command takes."""


class OneLineParser(argparse.ArgumentParser):
    """A parser whose errors are one line, as all of morphgen's are."""

    def error(self, message: str) -> NoReturn:
        """Raise a ``UsageError`` with what is wrong and where the usage is."""
        raise UsageError(f"morphgen: {message}; see {self.prog} --help")


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of every command; each sets ``run``, which returns the exit code."""
    parser = OneLineParser(
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
    try:
        args = _parsed(parser, argv)
    except UsageError as error:
        print(one_line(str(error)), file=sys.stderr)
        return 2
    if args.version:
        from importlib.metadata import version

        print(f"morphgen {version('morphgen')}")
        return 0
    if args.command is None:
        parser.print_help()
        return 2
    with _ctrl_c_noted() as noted:
        try:
            return int(args.run(args))
        except KeyboardInterrupt as interrupt:
            return _interrupted(interrupt)
        except Exception as error:
            if noted:  # a package that was being imported made something else of Ctrl-C
                return _interrupted(KeyboardInterrupt())
            if isinstance(error, MorphgenError):
                return _refused(error, str(error), args)
            if isinstance(error, ModuleNotFoundError) and error.name in EXTRAS:
                return _refused(error, _how_to_install(error.name), args)
            if isinstance(error, BrokenPipeError) or not isinstance(error, OSError):
                raise
            return _refused(error, f"{error.filename or 'output'}: {error.strerror}", args)


def _parsed(parser: argparse.ArgumentParser, argv: Sequence[str] | None) -> argparse.Namespace:
    """The arguments; words of a request may stand before and after options."""
    args, words = parser.parse_known_args(argv)
    is_option = any(word.startswith("-") for word in words)
    if is_option or not (words == [] or hasattr(args, "words")):
        parser.error(f"unknown arguments: {' '.join(words)}")
    if words:
        args.words += words
    return args


@contextmanager
def _ctrl_c_noted() -> Iterator[list[int]]:
    """Raise ``KeyboardInterrupt`` on Ctrl-C as always, and note it in the list that is given."""
    noted: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        noted.append(number)
        signal.default_int_handler(number, frame)

    before = signal.getsignal(signal.SIGINT)
    is_main = threading.current_thread() is threading.main_thread()
    if before is not signal.default_int_handler or not is_main:  # somebody else's, or ignored
        yield noted
        return
    signal.signal(signal.SIGINT, note)
    try:
        yield noted
    finally:
        signal.signal(signal.SIGINT, before)


def _how_to_install(package: str) -> str:
    extra = f"pip install 'morphgen[{EXTRAS[package]}]'"
    build = "; a small build without CUDA: https://pytorch.org/get-started/locally"
    return f"the package {package} is not installed: {extra}{build if package == 'torch' else ''}"


def _interrupted(interrupt: KeyboardInterrupt) -> int:
    """Say in one line that the command was interrupted; return the exit code."""
    text = str(interrupt) or "nothing half-written is left"
    print(f"morphgen: interrupted; {text}", file=sys.stderr)
    return 130


def _refused(error: Exception, text: str, args: argparse.Namespace) -> int:
    """Say in one line why the input was refused; return the exit code."""
    message = one_line(text)
    if getattr(args, "json", False):
        print(json.dumps({"error": type(error).__name__, "message": message}))
    print(f"morphgen: {message}", file=sys.stderr)
    return 2
