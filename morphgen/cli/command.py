"""Commands and their options as data, and the parser that is made of them."""

from __future__ import annotations

import argparse
import math
import shutil
import textwrap
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, NoReturn, TypeAlias

from morphgen.errors import MorphgenError, nearest

_MIN_HELP_WIDTH = 11
"""Least width of a line of a help, however narrow the terminal is; that of argparse."""
Run: TypeAlias = Callable[[argparse.Namespace], "int | None"]


class UsageError(MorphgenError):
    """The arguments of the command line are invalid."""


@dataclass(frozen=True)
class Option:
    """An option or a positional argument; several commands may share one."""

    names: tuple[str, ...]
    """Flags such as ``--seed``, or the name of a positional argument."""
    settings: Mapping[str, Any]
    """Keyword arguments of ``ArgumentParser.add_argument``."""
    needs: str = ""
    """Flag without which the option has no effect, and is refused."""
    excludes: tuple[str, ...] = ()
    """Flags with which the option has no effect, and is refused."""

    def needing(self, flag: str) -> Option:
        """Return the option for a command where it has an effect with another one only."""
        return replace(self, needs=flag)

    def without(self, *flags: str) -> Option:
        """Return the option for a command where it has no effect with others."""
        return replace(self, excludes=flags)

    def fault(self, given: Collection[str]) -> str:
        """Return why the option has no effect beside the flags that are given, if so."""
        idle = next((flag for flag in self.excludes if flag in given), "")
        if idle:
            return f"only without {idle}"
        return f"only with {self.needs}" if self.needs and self.needs not in given else ""


def option(
    name: str, help: str = "", type: Callable[[str], object] | None = None, **settings: object
) -> Option:
    """Return an option, or an argument by position.

    name: Name, and the word for its value in the help, such as ``--out DIR``.
    help: Its text; it ends with the default, if there is one to show.
    """
    name, _, metavar = name.partition(" ")
    # An empty list or text is no default that a reader could type.
    default = settings.get("default")
    if default not in (None, [], "") and "default" not in help:
        shown = f"{default:,}" if isinstance(default, int) else f"{default}"
        help += f" (default: {shown})" if help else f"default: {shown}"
    return Option((name,), {**settings, "help": help, "type": type, "metavar": metavar or None})


def flag(name: str, help: str) -> Option:
    """Return an option that is on if it is given."""
    return Option((name,), {"action": "store_true", "help": help})


def number(
    name: str, help: str, *, default: int | None = None, least: int = 1, most: int | None = None
) -> Option:
    """Return an option whose value is a whole number."""
    return option(f"{name} N", help, whole_number(least, most), default=default)


def repeated(
    name: str, help: str, type: Callable[[str], object] | None = None, **settings: object
) -> Option:
    """Return an option that may be given several times; its value is a list."""
    settings = {"action": "append", "default": [], **settings}
    return option(name, f"{help}; may be repeated", type, **settings)


def whole_number(least: int, largest: int | None = None) -> Callable[[str], int]:
    """Return a type for argparse: a whole number, also as ``2e6``."""
    valid = f"{least} or more" if largest is None else f"{least} to {largest}"

    def parse(text: str) -> int:
        number = _number(text)
        # Nan and inf fail the first condition: their remainder is nan.
        if not (number % 1 == 0 and least <= number <= (math.inf if largest is None else largest)):
            raise argparse.ArgumentTypeError(f"{text}: expected a whole number, {valid}")
        return int(number)

    return parse


def positive(text: str) -> float:
    """Read a number above 0; a type for argparse."""
    number = _number(text)
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"{text}: expected a number above 0")
    return number


def _number(text: str) -> float:
    """Read a number, exactly if it is whole; nan if the text is something else."""
    for convert in (int, float):  # a float would round whole numbers above 2^53
        with suppress(ValueError):
            return convert(text)
    return math.nan


Options: TypeAlias = "Sequence[Option | tuple[Option, ...]]"
"""Options of a command; those of a nested tuple exclude each other."""


@dataclass(frozen=True)
class Command:
    """A command, or a group of commands such as ``morphgen split``."""

    name: str
    """Word of the command line."""
    summary: str
    """Purpose of the command: a verb and its object, without a full stop."""
    options: Options = ()
    """Options and positional arguments."""
    run: Run | None = None
    """Function that runs the command; it may return an exit code. None for a group that needs one
    of its commands."""
    details: str = ""
    """Sentences that follow the summary in the command's own help."""
    examples: Sequence[str] = ()
    """Command lines that the help shows."""
    commands: Sequence[Command] = ()
    """Commands of the group."""
    extra: str = ""
    """Extra of morphgen that the command needs, which errors name if a package is missing."""
    defaults: Mapping[str, Any] = field(default_factory=dict)
    """Further attributes of the parsed arguments."""

    def add_to(self, parsers: argparse._SubParsersAction[Parser]) -> None:
        """Add the command's parser to those of its group."""
        parser = parsers.add_parser(self.name, help=self.summary, **self._texts())
        if self.commands:
            runs = self.run is not None
            add_commands(
                parser, self.commands, required=not runs, dest="subcommand", has_options=runs
            )
        if self.run is None:
            return
        for entry in self.options:
            alternatives = entry if isinstance(entry, tuple) else (entry,)
            group = parser.add_mutually_exclusive_group() if isinstance(entry, tuple) else parser
            for argument in alternatives:
                group.add_argument(*argument.names, **argument.settings)
        parser.set_defaults(run=self._start, parser=parser, extra=self.extra, **self.defaults)

    def _start(self, args: argparse.Namespace) -> int | None:
        """Refuse options that have no effect, then run the command."""
        groups = (each if isinstance(each, tuple) else (each,) for each in self.options)
        options = [each for group in groups for each in group if each.names[0].startswith("-")]
        given = {each.names[0]: each for each in options if _is_given(each, args)}
        faults = {name: fault for name, each in given.items() if (fault := each.fault(given))}
        if faults:
            reason = next(iter(faults.values()))
            names = " ".join(name for name, other in faults.items() if other == reason)
            raise MorphgenError(f"{names}: {reason}")
        assert self.run is not None
        return self.run(args)

    def _texts(self) -> dict[str, Any]:
        # Argparse leaves these two columns free, too.
        width = max(shutil.get_terminal_size().columns - 2, _MIN_HELP_WIDTH)
        summary = f"{self.summary[0].upper()}{self.summary[1:]}."
        lines = [f"  morphgen {example}" for example in self.examples]
        return {
            "description": textwrap.fill(f"{summary} {self.details}".strip(), width),
            "epilog": "\n".join(["examples:", *lines]) if lines else None,
            "formatter_class": argparse.RawDescriptionHelpFormatter,
        }


def _is_given(option: Option, args: argparse.Namespace) -> bool:
    """Return whether an option has another value than its default."""
    name = option.settings.get("dest") or option.names[0].lstrip("-").replace("-", "_")
    # Argparse does not say which options were given.
    is_flag = option.settings.get("action") == "store_true"
    return bool(getattr(args, name) != option.settings.get("default", False if is_flag else None))


def command(
    name: str,
    summary: str,
    *options: Option | tuple[Option, ...],
    details: str = "",
    examples: Sequence[str] = (),
    extra: str = "",
) -> Callable[[Run], Command]:
    """Return a decorator that makes a command of the function that runs it."""
    return lambda run: Command(name, summary, options, run, details, examples, extra=extra)


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line and name the nearest valid choice."""

    def error(self, message: str) -> NoReturn:
        """Raise a ``UsageError`` that says what is wrong and where the usage is explained."""
        raise UsageError(f"{message}; see {self.prog} --help")

    def _check_value(self, action: argparse.Action, value: object) -> None:
        """Refuse an invalid choice as the rest of morphgen does."""
        if action.choices is not None and value not in action.choices:
            names = map(str, action.choices)
            raise argparse.ArgumentError(
                action, f"invalid choice: {value!r}{nearest(str(value), names)}"
            )


class _CommandAfterOptions(argparse._SubParsersAction):  # type: ignore[type-arg]  # not at run time
    """Chooses a command of a group that has options of its own.

    The command's defaults would replace options that stand before it, so they are refused.
    """

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        """Refuse options before the command, then parse what follows it."""
        for action in parser._actions:
            if (
                action.option_strings
                and getattr(namespace, action.dest, action.default) != action.default
            ):
                name = values[0] if values else self.dest
                parser.error(f"{action.option_strings[-1]} before {name}: options stand after it")
        super().__call__(parser, namespace, values, option_string)


def add_commands(
    parser: argparse.ArgumentParser,
    commands: Sequence[Command],
    *,
    required: bool = False,
    dest: str = "command",
    has_options: bool = False,
) -> None:
    """Add commands to a parser; the chosen one sets ``run``, ``parser`` and, to its name, dest."""
    action = _CommandAfterOptions if has_options else argparse._SubParsersAction
    parsers = parser.add_subparsers(
        metavar="COMMAND", dest=dest, required=required, parser_class=Parser, action=action
    )
    for entry in commands:
        entry.add_to(parsers)


def parse(parser: Parser, argv: Sequence[str] | None) -> argparse.Namespace:
    """Return the arguments; words of a request may stand before and after options."""
    # Argparse takes the words of one gap between options only.
    args, rest = parser.parse_known_args(argv)
    used = getattr(args, "parser", parser)
    unknown = next((word for word in rest if word.startswith("-")), None)
    if unknown is not None:
        valid = (name for name in used._option_string_actions if name.startswith("--"))
        used.error(f"unknown option {unknown!r}{nearest(unknown, valid)}")
    if rest and not hasattr(args, "words"):
        used.error(f"unknown arguments: {' '.join(rest)}")
    if rest:
        args.words += rest
    return args
