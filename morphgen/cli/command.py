"""Commands as the text ``commands.txt`` defines them, and the parser that is made of them."""

from __future__ import annotations

import argparse
import math
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from pathlib import Path
from string import Template
from typing import Any, NoReturn, TypeAlias

from morphgen.errors import MAX_WHOLE, MorphgenError, nearest
from morphgen.rl.agents import AGENTS, PRESETS
from morphgen.rl.baselines import BASELINES
from morphgen.rl.shipped_policies import POLICIES
from morphgen.tasks.registry import CHANNELS, SIMULATORS, TASKS

COMMANDS = Path(__file__).with_name("commands.txt")
"""Definition of all commands; its head explains the notation."""
_MIN_HELP_WIDTH = 11
"""Least width of a line of a help, however narrow the terminal is; that of argparse."""
_ENTRY = re.compile(
    r"(?P<name>(?:--\[no-\]|-{1,2})?[\w-]+)(?P<required>!)?(?: (?P<value>\S.*?))??"
    r"(?: -> (?P<dest>\w+))?(?: = (?P<default>\S.*))?"
)
_VALUE = re.compile(
    r"(?P<metavar>[^({]*?)(?:\((?P<type>[^)]+)\))?(?:\{(?P<choices>[^}]+)\})?(?P<many> \.\.\.|\*)?"
)
_RULE = re.compile(r"(--[^:]+): only (with|without) (--[\w-]+)(?:=(\S+))?")
Names: TypeAlias = Callable[[], Mapping[str, Any]]
"""Function that returns what stands for the names in ``commands.txt``; see ``_names``."""
_PATHS = re.compile(r"DIR|FOLDER|PATH|FILE\b.*")  # words for a value that is a path


class UsageError(MorphgenError):
    """The arguments of the command line are invalid."""


@dataclass
class Command:
    """A command, or a group of commands such as ``morphgen split``."""

    path: str  # words of the command line, such as `split new`
    function: str = ""
    """Module of ``morphgen.cli`` and its function that runs the command, which gets the arguments
    and may return an exit code; empty for a group that needs one of its commands."""
    extra: str = ""
    """Extra of morphgen that the command needs, which errors name if a package is missing."""
    summary: str = ""  # purpose of the command: a verb and its object, without a full stop
    details: str = ""  # sentences that follow the summary in the command's own help
    examples: list[str] = field(default_factory=list)  # command lines that the help shows
    options: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Keyword arguments of ``ArgumentParser.add_argument`` by flag, or name of a position."""
    basic: Sequence[str] = ()
    """Options that ``--help`` shows if ``--help-all`` shows more; empty if there are no others."""
    rules: list[tuple[list[str], str, str, list[str]]] = field(default_factory=list)
    """Flags that have an effect ``with`` or ``without`` another only, the other, and those of its
    values that count, all if there are none."""

    def start(self, args: argparse.Namespace) -> int | None:
        """Refuse options that have no effect, then run the command."""
        values = {
            name: getattr(args, settings.get("dest") or name.lstrip("-").replace("-", "_"))
            for name, settings in self.options.items()
        }
        # Argparse does not say which options were given.
        given = [name for name in values if values[name] != self.options[name].get("default")]
        for flags, preposition, name, valid in self.rules:
            holds = values[name] in valid if valid else name in given
            idle = [flag for flag in given if flag in flags]
            if idle and holds != (preposition == "with"):
                *others, last = valid or [""]
                choices = " or ".join(filter(None, [", ".join(others), last]))
                condition = f"{preposition} {name} {choices}".rstrip()
                raise MorphgenError(f"{' '.join(idle)}: only {condition}")
        module, _, function = self.function.rpartition(".")
        from morphgen.cli.progress import status

        # Packages, which take seconds; in a pipe the work itself says what it is.
        with status(args, "loading") if sys.stderr.isatty() else nullcontext():
            run = getattr(import_module(f"morphgen.cli.{module}"), function)
        code: int | None = run(args)
        return code


def read_commands(words: Sequence[str] = ()) -> list[Command]:
    """Return the commands of ``commands.txt``, or only the one that begins a command line."""
    text = COMMANDS.read_text(encoding="utf-8")
    first = next((word for word in words if not word.startswith("-")), "")
    is_command = first and re.search(rf"(?m)^{re.escape(first)}( [\w-]+)* = ", text)
    names = cache(_names)  # looks for installed packages, which most commands do not name
    groups: dict[str, list[str]] = {}
    commands = []
    for section in re.split(r"\n(?=[@\w])", re.sub(r"(?m)^#.*\n", "", text).strip()):
        head, _, body = section.partition("\n")
        # What is indented deeper continues the line above it.
        lines = re.sub(r"\n {3,}", "  ", textwrap.dedent(body)).splitlines()
        lines = [each for line in lines for each in _with_groups(line, groups)]
        if head.startswith("@"):
            groups[head[1:]] = lines
            continue
        path, _, function = head.partition(" = ")
        if not is_command or path.partition(" ")[0] == first:
            commands.append(_command(Command(path, *function.split(", extra ")), lines, names))
    return commands


def _with_groups(line: str, groups: Mapping[str, list[str]]) -> list[str]:
    """Return a line, or the lines of the groups that it names."""
    return (
        [each for name in line[2:].split() for each in groups[name]] if line[0] == "+" else [line]
    )


def _command(command: Command, lines: Sequence[str], names: Names) -> Command:
    """Fill a command with what the lines of its section say."""
    command.summary, *lines = lines
    for line in filter(None, lines):
        signature, *help_text = re.split(r" {2,}", line)
        if rule := _RULE.fullmatch(" ".join([signature, *help_text])):
            flags, preposition, name, valid = rule.groups("")
            command.rules.append(
                (flags.split(), preposition, name, valid.split(",") if valid else [])
            )
        elif line.startswith("$ "):
            command.examples.append(line[2:])
        elif line == "advanced:":
            command.basic = list(command.options)
        elif line.startswith("-") or help_text:
            name, settings = _option(signature, " ".join(help_text), names)
            command.options[name] = settings
        else:
            command.details = f"{command.details} {line}".lstrip()
    return command


def _option(signature: str, text: str, names: Names) -> tuple[str, dict[str, Any]]:
    """Return the flag of an option, and its settings for argparse."""
    entry = _ENTRY.fullmatch(signature)
    assert entry is not None, signature
    name = entry["name"]
    if "$" in text:
        text = Template(text).substitute(names(), presets=_presets(name.removeprefix("--[no-]")))
    settings: dict[str, Any] = {"dest": entry["dest"]} if entry["dest"] else {}
    if entry["required"]:
        settings["required"] = True
    if name.startswith("--[no-]"):
        settings |= {"action": argparse.BooleanOptionalAction, "default": None}
        name = name.replace("[no-]", "")
    elif entry["value"] is None and name.startswith("-"):
        # A flag that turns an attribute off has its name: --no-tensorboard -> tensorboard.
        is_off = entry["dest"] is not None
        settings |= {"action": f"store_{str(not is_off).lower()}", "default": is_off}
    else:
        settings |= _value(entry["value"] or "", names, is_flag=name.startswith("-"))
    if settings.get("action") == "append":
        text += "; may be repeated"
    if default := entry["default"]:
        default = default.strip('"')
        convert = settings.get("type") or (lambda text: text != "off" and text)
        settings["default"] = value = convert(default)
        if "default" not in text and default:
            shown = f"{value:,}" if isinstance(value, int) else default
            text += f" (default: {shown})"
    return name, {**settings, "help": text}


def _value(text: str, names: Names, *, is_flag: bool) -> dict[str, Any]:
    """Return the settings for the value of an option, such as ``N(2..)`` or ``[ROBOT ...]``."""
    is_optional = text.startswith("[") and text.endswith("]")
    value = _VALUE.fullmatch(text[1:-1] if is_optional else text)
    assert value is not None, text
    word, kind, choices, many = value.groups()
    kind = kind or ("1.." if word == "N" else "path" if _PATHS.fullmatch(word) else "str")
    settings: dict[str, Any] = {"metavar": word or None, "type": _type(kind)}
    if choices:
        settings["choices"] = names()[choices] if choices.isupper() else choices.split(",")
    if many == "*":
        settings |= {"action": "append", "default": []}
    elif many:
        settings |= {"nargs": "*" if is_optional else "+"} | ({"default": []} if is_flag else {})
    elif is_optional:
        settings |= {"nargs": "?", "const": "" if is_flag else None}
    return settings


def _type(name: str) -> Callable[[str], object] | None:
    """Return the function that reads a value; None for a text."""
    least, dots, largest = name.partition("..")
    if dots:
        return whole_number(int(least), int(largest) if largest else None)
    types = {"str": None, "path": Path, "float": float, "int": int, "policy": policy}
    return {**types, "positive": positive, "names": _names_of, "numbers": _numbers_of}[name]


def _names() -> dict[str, Any]:
    """Return what stands for the names in ``commands.txt``: choices of options, and texts."""
    robot = (
        "a bundle's folder, a URDF, xacro or MJCF, parts such as ur5-plane, or words of morphgen "
        "compose such as arm=ur5 ee=plane"
    )
    observed = (
        f"; --preset {label} has {', '.join(channels)} already, and --agent AGENT-NAME drops one"
        for label, preset in PRESETS.items()
        if (channels := [each for each in preset.switches if each.replace("-", "_") in CHANNELS])
    )
    return {
        "ROBOT": robot,
        "ROBOTS": f"{robot}; a set of morphgen sample or a folder of bundles names all its robots",
        "SPLIT": "name of a split, its file or built folder; or a robot and its task, such as "
        "arm=ur5 ee=stick task=reach",
        "TASKS": TASKS,
        "A_TASK": f"{', '.join(TASKS.builtin)}, or a task of an installed package",
        "SIMULATORS": SIMULATORS,
        "A_SIMULATOR": f"{', '.join(SIMULATORS.builtin)}, or a simulator of an installed package",
        "AGENTS": ", ".join(AGENTS),
        "BASELINES": ", ".join(BASELINES),
        "POLICIES": ", ".join(POLICIES),
        "CHANNELS": ", ".join(CHANNELS).replace("_", "-") + "".join(observed),
        "PRESETS": tuple(PRESETS),
        "A_PRESET": "; ".join(f"{name}: {preset.summary}" for name, preset in PRESETS.items()),
    }


def _presets(switch: str) -> str:
    """Return which presets turn a switch of agents on or off."""
    return "".join(
        f"; {'on' if preset.switches[switch] else 'off'} with --preset {label}"
        for label, preset in PRESETS.items()
        if switch in preset.switches
    )


def _names_of(text: str) -> tuple[str, ...]:
    """Read names that are separated by commas; a type for argparse."""
    return tuple(name.strip() for name in text.split(",")) if text else ()


def _numbers_of(text: str) -> tuple[int, ...]:
    """Read whole numbers that are separated by commas; a type for argparse."""
    return tuple(map(whole_number(1), _names_of(text)))


def whole_number(least: int, largest: int | None = None) -> Callable[[str], int]:
    """Return a type for argparse: a whole number, also as ``2e6``."""
    valid = f"{least} or more" if largest is None else f"{least} to {largest}"

    def parse(text: str) -> int:
        number = _number(text)
        # Nan and inf fail the first condition: their remainder is nan.
        if not (number % 1 == 0 and least <= number <= (math.inf if largest is None else largest)):
            raise argparse.ArgumentTypeError(f"{text}: expected a whole number, {valid}")
        if number > MAX_WHOLE:
            raise argparse.ArgumentTypeError(f"{text}: expected at most 2^63 - 1")
        return int(number)

    return parse


def policy(text: str) -> str:
    """Read the name of a baseline or shipped policy, or an existing path; a type for argparse."""
    names = (*BASELINES, *POLICIES)
    if text not in names and not Path(text).exists():
        raise argparse.ArgumentTypeError(
            f"{text!r} is neither a checkpoint nor a policy{nearest(text, names)}"
        )
    return text


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


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line and name the nearest valid choice."""

    advanced: Sequence[argparse.Action] = ()
    """Options that ``--help`` leaves out and ``--help-all`` shows."""

    def error(self, message: str) -> NoReturn:
        """Raise a ``UsageError`` that says what is wrong and where the usage is explained."""
        raise UsageError(f"{message}; see {self.prog} --help")

    def _check_value(self, action: argparse.Action, value: object) -> None:
        """Refuse an invalid choice as the rest of morphgen does."""
        if action.choices is not None and value not in action.choices:
            names = map(str, action.choices)
            # The word after an option that a group lacks is taken for its command.
            what = "invalid choice"
            if isinstance(action, _CommandAfterOptions):
                what = "neither a command nor the value of an option"
            text = f"{what}: {value!r}{nearest(str(value), names)}"
            raise argparse.ArgumentError(action, text)


class _BriefHelp(argparse._HelpAction):
    """Prints the help without the advanced options, and exits."""

    def __call__(self, parser: argparse.ArgumentParser, *args: Any, **options: Any) -> None:  # noqa: ANN401
        assert isinstance(parser, Parser)
        for action in parser.advanced:
            action.help = argparse.SUPPRESS
        super().__call__(parser, *args, **options)


class _FullHelp(argparse._HelpAction):
    """Prints the help with the names of the hyperparameters, which loads PyTorch, and exits."""

    def __call__(self, parser: argparse.ArgumentParser, *args: Any, **options: Any) -> None:  # noqa: ANN401
        for action in parser._actions:
            if action.dest == "constants":
                try:
                    names = import_module("morphgen.rl.config").constants_text()
                except ImportError as error:
                    names = f"names that need the extra rl: {error}"
                action.help = f"{action.help}; of {names}"
        super().__call__(parser, *args, **options)


class _CommandAfterOptions(argparse._SubParsersAction):  # type: ignore[type-arg]  # not at run time
    """Chooses a command of a group; it refuses options before it, which would be replaced."""

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


def add_commands(parser: Parser, commands: Sequence[Command], path: str = "") -> None:
    """Add commands to a parser; the chosen one sets ``run``, ``parser`` and its own word."""
    level = [each for each in commands if each.path.rpartition(" ")[0] == path]
    if not level:
        return
    group = next((each for each in commands if each.path == path and each.function), None)
    # Argparse leaves these two columns free, too.
    width = max(shutil.get_terminal_size().columns - 2, _MIN_HELP_WIDTH)
    subparsers = parser.add_subparsers(
        metavar="COMMAND",
        dest="subcommand" if path else "command",
        required=bool(path) and group is None,
        parser_class=Parser,
        action=_CommandAfterOptions if group else argparse._SubParsersAction,
    )
    for command in level:
        summary = f"{command.summary[0].upper()}{command.summary[1:]}."
        examples = "\n  morphgen ".join(["examples:", *command.examples])
        child = subparsers.add_parser(
            command.path.rpartition(" ")[2],
            help=command.summary,
            description=textwrap.fill(f"{summary} {command.details}".rstrip(), width),
            epilog=examples if command.examples else None,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            add_help=not command.basic,
        )
        add_commands(child, commands, command.path)
        if command.function:
            _add_options(child, command)


def _add_options(parser: Parser, command: Command) -> None:
    if command.basic:
        text = "show the most used options and exit"
        parser.add_argument("-h", "--help", action=_BriefHelp, help=text)
        text = "show all options and exit"
        parser.add_argument("--help-all", action=_FullHelp, help=text)
    actions = {
        name: parser.add_argument(name, **settings) for name, settings in command.options.items()
    }
    if command.basic:
        parser.advanced = [actions[name] for name in actions if name not in command.basic]
    parser.set_defaults(run=command.start, parser=parser, extra=command.extra)


def parse(parser: Parser, argv: Sequence[str] | None) -> argparse.Namespace:
    """Return the arguments; words of a request may stand before and after options."""
    # Argparse takes the words of one gap between options only.
    args, rest = parser.parse_known_args(argv)
    used = getattr(args, "parser", parser)
    unknown = next((word for word in rest if word.startswith("-")), None)
    if unknown is not None:
        valid = [name for name in used._option_string_actions if name.startswith("--")]
        if unknown.partition("=")[0] in valid:
            used.error(f"{unknown} stands before the command; expected after it")
        used.error(f"unknown option {unknown!r}{nearest(unknown, valid)}")
    if rest and not hasattr(args, "words"):
        used.error(f"unknown arguments: {' '.join(rest)}")
    if rest:
        args.words += rest
    return args
