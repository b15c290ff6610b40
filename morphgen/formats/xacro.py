"""Expand xacro without ROS. Each call stands alone: nothing of one is left for the next."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from xml.dom import minidom
from xml.parsers.expat import ExpatError
from xml.sax.saxutils import escape, quoteattr

import yaml

from morphgen.errors import FormatError, nearest
from morphgen.formats.resolve import PackageFinder
from morphgen.formats.xacro_engine import thread_engine
from morphgen.formats.xml import parse_xml

MAX_INCLUDE_DEPTH = 40
"""Files that may be open within one another before it is called a loop."""

_COMMANDS = ("arg", "dirname", "eval", "find", "optenv")
_FAULTS = (
    ArithmeticError,
    AttributeError,
    ExpatError,
    LookupError,
    NameError,
    OSError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
    yaml.YAMLError,
)
"""What a faulty document can make the evaluator raise, besides its own exception."""


def expand(path: Path, args: Mapping[str, str], finder: PackageFinder) -> bytes:
    """Expand a xacro file.

    The result depends on the files and the arguments only: the working directory plays no part,
    ``$(optenv NAME default)`` is always its default, and ``$(env NAME)`` and ``$(cwd)`` are errors.

    Args:
        path: The file.
        args: Values of the document's ``xacro:arg``; the others keep their defaults.
        finder: Where ``$(find package)`` looks, besides around the file.

    Returns:
        The expanded document: UTF-8, no XML declaration, no comments.

    Raises:
        FormatError: The file or one that it includes is missing, broken or cannot be expanded, or
            ``args`` names an argument that neither declares.
    """
    return Expansion(args, path.absolute(), finder).run_file()


def expand_text(
    text: str | bytes, args: Mapping[str, str], origin: Path, finder: PackageFinder
) -> bytes:
    """Expand a xacro document that is in memory; see `expand`.

    Args:
        text: The document.
        args: Values of the document's ``xacro:arg``.
        origin: The file that it stands for: names it in errors and anchors its relative includes.
        finder: Where ``$(find package)`` looks.

    Raises:
        FormatError: As `expand`.
    """
    expansion = Expansion(args, origin.absolute(), finder)
    return expansion.run(text.encode() if isinstance(text, str) else text)


def evaluate(expression: str, values: Mapping[str, float]) -> float:
    """Return the number that a text with ``${...}`` stands for.

    Args:
        expression: Such as ``"0.5"`` or ``"${length / 2}"``, with xacro's functions (``pi``,
            ``sin``, ``max``, ``radians``, ...).
        values: Numbers that it may use by name; they hide xacro's own names.

    Raises:
        FormatError: It cannot be evaluated, or is no finite number.
    """
    engine = thread_engine()
    engine.eval_extension = _no_substitution
    symbols = engine.Table(engine._global_symbols)
    dict.update(symbols, values)
    try:
        result = symbols._eval_literal(engine.eval_text(expression, symbols))
    except (engine.XacroException, *_FAULTS) as error:
        hint = _unknown_name_hint(error, values)
        raise FormatError(f"{expression!r}: {_one_line(error)}{hint}") from error
    if isinstance(result, bool) or not isinstance(result, int | float) or not math.isfinite(result):
        raise FormatError(f"{expression!r} is {result!r}, not a finite number")
    return float(result)


class Expansion:
    """One call's state: the arguments, the files read, and what they declare."""

    def __init__(
        self,
        args: Mapping[str, str],
        origin: Path,
        finder: PackageFinder,
        objects: Mapping[str, object] | None = None,
    ) -> None:
        """Prepare.

        Args:
            args: Values of the document's ``xacro:arg``.
            origin: The file, absolute.
            finder: Where ``$(find package)`` looks.
            objects: Values of further arguments that reach expressions as they are.
        """
        self.engine = thread_engine()
        self.engine.parse = self._parse_include
        self.engine.eval_extension = self._substitute
        self.objects = dict(objects or {})
        self.given = {name: str(value) for name, value in args.items()}
        self.arguments = _Arguments(self.engine.XacroException, self.given)
        self.declared: set[str] = set()
        self.origin = origin
        self.finder = finder

    def run_file(self) -> bytes:
        """Expand the file.

        Raises:
            FormatError: As ``expand``.
        """
        try:
            data = self.origin.read_bytes()
        except OSError as error:
            raise FormatError(f"{self.origin}: cannot be read: {error.strerror}") from error
        return self.run(data)

    def run(self, data: bytes) -> bytes:
        """Expand a document that stands for the file.

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
        return "".join(_serialised(document.documentElement)).encode()

    @contextmanager
    def _located(self) -> Iterator[None]:
        """Turn what goes wrong into one line that names the file in hand."""
        try:
            yield
        except (self.engine.XacroException, *_FAULTS) as error:
            files, macros = self.engine.filestack, self.engine.macrostack
            loop = isinstance(error, RecursionError)
            reason = "macros call one another without end" if loop else _one_line(error)
            macro = f" in macro {macros[-1].body.getAttribute('name')!r}" if macros else ""
            above = f" (included from {self.origin})" if files[-1] != str(self.origin) else ""
            raise FormatError(f"{files[-1]}: {reason}{macro}{above}") from error

    def _parse(self, data: bytes, origin: str) -> minidom.Document:
        for element in parse_xml(data, origin).iter("{*}arg"):
            self.declared.add(element.get("name", ""))
        return minidom.parseString(data)

    def _parse_include(self, _: object, filename: str) -> minidom.Document:
        files = self.engine.filestack
        if len(files) > MAX_INCLUDE_DEPTH:
            raise FormatError(f"{files[-2]}: includes {filename} without end (from {self.origin})")
        try:
            data = Path(filename).read_bytes()
        except OSError as error:
            files.pop()
            missing = OSError(f"cannot include {filename}: {error.strerror}")
            raise self.engine.XacroException(exc=missing) from error
        return self._parse(data, filename)

    def _substitute(self, text: str) -> object:
        """Evaluate one ``$(command words)``."""
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
            f"{text} is no substitution; valid: {', '.join(_COMMANDS)}"
        )


class _Arguments(dict[str, str]):
    """Arguments by name; remembers which were asked for."""

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
    raise ValueError(f"{text} has no meaning here")


def _serialised(node: minidom.Node | None) -> Iterator[str]:
    """Write a DOM; ``minidom``'s own writer may have been replaced by somebody else."""
    if isinstance(node, minidom.Text):
        yield escape(node.data)
    elif isinstance(node, minidom.Element):
        attributes = (f" {name}={quoteattr(value)}" for name, value in node.attributes.items())
        yield f"<{node.tagName}{''.join(attributes)}>"
        for child in node.childNodes:
            yield from _serialised(child)
        yield f"</{node.tagName}>"


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def _unknown_name_hint(error: BaseException | None, values: Mapping[str, float]) -> str:
    while error is not None:
        if isinstance(error, NameError) and error.name:
            return nearest(error.name, values)
        error = error.__context__
    return ""
