"""Expand xacro without ROS. Calls are independent: no state passes from one to the next."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from glob import glob
from pathlib import Path
from xml.dom import minidom
from xml.parsers.expat import ExpatError

from morphgen.errors import FormatError, nearest
from morphgen.formats import xacro_process
from morphgen.formats.resolve import PackageFinder, is_installed, require_allowed_text
from morphgen.formats.xacro_engine import thread_engine
from morphgen.formats.xacro_files import (
    ElementLocations,
    document_text,
    location_of,
    parse_yaml,
    read_file,
)
from morphgen.formats.xacro_functions import RefusedError
from morphgen.formats.xml import parse_xml

MAX_INCLUDE_DEPTH = 40
"""Deepest nesting of includes; deeper ones are taken for a loop."""
MAX_REASON = 400
"""Longest reason in an error [characters]; expressions can be long."""

_COMMANDS = ("arg", "dirname", "eval", "find", "optenv")
_FAULTS = (
    ArithmeticError,
    AttributeError,
    ExpatError,
    LookupError,
    MemoryError,
    NameError,
    OSError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
)
"""Exceptions that an invalid document can raise in the evaluator, besides XacroException."""


def expand(path: Path, args: Mapping[str, str], finder: PackageFinder) -> bytes:
    """Expand a xacro file.

    The result depends on the files and the arguments only: the working directory plays no part,
    ``$(optenv NAME default)`` is always its default, and ``$(env NAME)`` and ``$(cwd)`` are errors.

    Threat model: the file and everything it includes may come from a stranger, and the values of
    arguments as well. Expressions are interpreted by an allow-list and never given to Python.
    Files are read only where ``require_allowed_text`` permits. Time, memory and size are bounded.

    A file that was installed with morphgen or a data package was chosen by whoever installed it, so
    it is expanded in this process as long as it reads installed files only. Every other file,
    including one of the user's own library, is expanded in a child process with resource limits.

    Args:
        path: The file.
        args: Values of the document's ``xacro:arg``; the others keep their defaults.
        finder: Where ``$(find package)`` looks, besides around the file.

    Returns:
        The expanded document: UTF-8, no XML declaration, no comments.

    Raises:
        FormatError: The file or one that it includes is missing, broken or cannot be expanded, asks
            for what is not allowed or too much, or neither declares an argument of ``args``.
    """
    path = path.absolute()
    if is_installed(path):
        expansion = Expansion(args, path, finder, installed_only=True)
        try:
            return expansion.run_file()
        except FormatError:
            if not expansion.met_foreign:
                raise
    document: str = xacro_process.run_in_child(expand_here, path, finder, args=args)
    return document.encode()


def expand_here(path: Path, finder: PackageFinder, args: Mapping[str, str]) -> str:
    """Expand a xacro file in this process; ``expand`` decides which process that is."""
    return Expansion(args, path, finder).run_file().decode()


def evaluate(expression: str, values: Mapping[str, float]) -> float:
    """Evaluate a text with ``${...}`` to a number.

    Args:
        expression: Such as ``"0.5"`` or ``"${length / 2}"``, with xacro's functions (``pi``,
            ``sin``, ``max``, ``radians``, ...).
        values: Numbers by name; they hide xacro's own names.

    Raises:
        FormatError: It cannot be evaluated, or is not a finite number.
    """
    engine = thread_engine()
    engine.eval_extension = _no_substitution
    symbols = engine.Table(engine._global_symbols)
    dict.update(symbols, values)
    try:
        result = symbols._eval_literal(engine.eval_text(expression, symbols))
    except (engine.XacroException, *_FAULTS) as error:
        hint = _unknown_name_hint(error, values)
        raise FormatError(f"{expression!r}: {_reason(error)}{hint}") from error
    if isinstance(result, bool) or not isinstance(result, int | float) or not math.isfinite(result):
        raise FormatError(f"{expression!r} is {result!r}, not a finite number")
    return float(result)


class Expansion:
    """State of one expansion: its arguments, and the arguments that the files read declare."""

    def __init__(
        self,
        args: Mapping[str, str],
        origin: Path,
        finder: PackageFinder,
        objects: Mapping[str, object] | None = None,
        *,
        installed_only: bool = False,
    ) -> None:
        """Prepare.

        Args:
            args: Values of the document's ``xacro:arg``.
            origin: The file, absolute.
            finder: Where ``$(find package)`` looks.
            objects: Further arguments, whose values reach expressions without conversion to text.
            installed_only: Whether to refuse files that are not ``is_installed``; ``met_foreign``
                is then true if the document asked for one.
        """
        self.engine = thread_engine()
        self.engine.parse = self._parse_include
        self.engine.load_yaml = self._load_yaml
        self.engine.list_files = self._list_files
        self.engine.eval_extension = self._substitute
        self.objects = dict(objects or {})
        self.given = {name: str(value) for name, value in args.items()}
        self.arguments = _Arguments(self.engine.XacroException, self.given)
        self.declared: set[str] = set()
        self.locations = ElementLocations()
        self.origin = origin
        self.finder = finder
        self.installed_only = installed_only
        self.met_foreign = False

    def run_file(self) -> bytes:
        """Expand the file.

        Raises:
            FormatError: As ``expand``.
        """
        try:
            data = read_file(self.origin)
        except OSError as error:
            raise FormatError(f"{self.origin}: cannot be read: {error.strerror}") from error
        except RefusedError as error:
            raise FormatError(str(error)) from error
        return self.run(data)

    def run(self, data: bytes) -> bytes:
        """Expand a document in place of the file's content.

        Raises:
            FormatError: As ``expand``.
        """
        self.engine.init_stacks(str(self.origin))
        with self._located():
            document = self._parse(data, str(self.origin))
            self.engine.process_doc(document, mappings=self.arguments)
            known = self.declared | self.arguments.used
            for name in (*self.given, *self.objects):
                if name not in known:
                    raise FormatError(f"{self.origin}: no argument {name!r}{nearest(name, known)}")
            return document_text(document).encode()

    @contextmanager
    def _located(self) -> Iterator[None]:
        """Turn exceptions into one-line errors with the file and line being processed."""
        try:
            yield
        except (self.engine.XacroException, *_FAULTS) as error:
            macros, node = self.engine.macrostack, self.engine.node
            location = location_of(node) if node is not None else str(self.origin)
            macro = f" in macro {macros[-1].body.getAttribute('name')!r}" if macros else ""
            is_included = not location.startswith(str(self.origin))
            including = "" if not is_included else f" (included from {self.origin})"
            raise FormatError(f"{location}: {_reason(error)}{macro}{including}") from error

    def _parse(self, data: bytes, origin: str) -> minidom.Document:
        for element in parse_xml(data, origin).iter("{*}arg"):
            self.declared.add(element.get("name", ""))
        return self.locations.parse(data, origin)

    def _parse_include(self, _: object, filename: str) -> minidom.Document:
        files = self.engine.filestack
        if len(files) > MAX_INCLUDE_DEPTH:
            raise FormatError(
                f"{files[-2]}: includes {filename} in an endless loop (from {self.origin})"
            )
        including = files[-2]
        try:
            data = self._read(filename, including)
        except OSError as error:
            files.pop()
            missing = OSError(f"cannot include {filename}: {error.strerror}")
            raise self.engine.XacroException(exc=missing) from error
        return self._parse(data, filename)

    def _load_yaml(self, filename: str) -> object:
        name = self.engine.abs_filename_spec(filename)
        data = self._read(name, self.engine.filestack[-1])
        return parse_yaml(data, Path(name), self.engine.ConstructUnits)

    def _read(self, filename: str, including: str) -> bytes:
        require_allowed_text(Path(filename), self.finder, self.origin, Path(including))
        if self.installed_only and not is_installed(Path(filename)):
            self.met_foreign = True
            raise RefusedError(f"{filename} was not installed")
        return read_file(Path(filename))

    def _list_files(self, pattern: str) -> list[str]:
        """Return the files that match a pattern; its fixed first folders must be allowed."""
        folder = Path(re.split(r"[*?[]", pattern)[0] + "x").parent
        require_allowed_text(folder, self.finder, self.origin, Path(self.engine.filestack[-1]))
        return glob(pattern)  # noqa: PTH207 - an absolute pattern, as xacro takes it

    def _substitute(self, text: str) -> object:
        """Evaluate one substitution ``$(command words)``."""
        match text[2:-1].split():
            case ["arg", name] if name in self.objects:
                return self.objects[name]
            case ["arg", name]:
                return self.arguments[name]
            case ["find", package]:
                return str(self.finder.find(package, Path(self.engine.filestack[-1]), self.origin))
            case ["dirname"]:
                return str(Path(self.engine.filestack[-1]).parent)
            case ["optenv", _, *default]:
                return " ".join(default)
            case ["eval", *words]:
                literal = self.engine.Table._eval_literal
                names = {name: literal(value) for name, value in self.arguments.items()}
                return str(
                    self.engine.safe_eval(" ".join(words), self.engine._global_symbols, names)
                )
            case ["env" | "cwd" as command, *_]:
                raise self.engine.XacroException(
                    f"{text} would make the robot depend on where it is built:"
                    f" $({command}) is not supported, use a xacro:arg"
                )
        raise self.engine.XacroException(
            f"unknown substitution {text}; valid: {', '.join(_COMMANDS)}"
        )


class _Arguments(dict[str, str]):
    """Arguments by name, with a record of the names that were used."""

    def __init__(self, fault: type[Exception], given: Mapping[str, str]) -> None:
        super().__init__(given)
        self.fault = fault
        self.used: set[str] = set()

    def __getitem__(self, name: str) -> str:
        self.used.add(name)
        if name not in self:
            raise self.fault(f"argument {name!r} has neither a value nor a default")
        return super().__getitem__(name)


def _no_substitution(text: str) -> str:
    raise ValueError(f"{text} is not valid here")


def _reason(error: BaseException) -> str:
    """Return the innermost error in one line; xacro wraps it once for each expression."""
    suffix = ""
    while isinstance(inner := getattr(error, "exc", None), BaseException):
        suffix = getattr(error, "suffix", None) or suffix
        error = inner
    if isinstance(error, RecursionError):
        return "macros or properties refer to each other endlessly or too deeply"
    if isinstance(error, MemoryError):
        return f"its expansion needs more than {xacro_process.MEMORY_LIMIT >> 20} MiB of memory"
    reason = " ".join(f"{error or type(error).__name__} {suffix}".split())
    return reason if len(reason) <= MAX_REASON else f"{reason[:MAX_REASON]}..."


def _unknown_name_hint(error: BaseException | None, values: Mapping[str, float]) -> str:
    while error is not None:
        if isinstance(error, NameError) and error.name:
            return nearest(error.name, values)
        error = error.__context__
    return ""
