"""Expand xacro files, those of strangers in a process with limits."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from glob import glob
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeAlias
from xml.dom import expatbuilder, minidom
from xml.parsers.expat import ExpatError
from xml.sax.saxutils import escape, quoteattr

import yaml

from morphgen.errors import MALFORMED, FormatError, nearest
from morphgen.formats.data_files import read_bytes, yaml_problem
from morphgen.formats.resolve import PackageFinder, is_installed, require_allowed_text
from morphgen.formats.xacro.evaluator import (
    MAX_SIZE,
    NAMES,
    Function,
    Namespace,
    RefusedError,
    expression,
    reason_of,
    size_of,
)
from morphgen.formats.xml import parse_xml

MAX_FILE = 16 * 2**20  # largest file that an expansion reads [bytes]
MAX_OUTPUT = 20_000_000  # largest expanded document [characters]
MAX_CLONES = 200_000
"""Largest number of elements that an expansion may copy, as macros do; the PR2 has 6,978 nodes."""

Untyped: TypeAlias = Any  # objects of minidom and xacro, which have no type hints

_LOCATION = "morphgen-location"


class ElementLocations:
    """Source locations of the elements of an expansion; a DOM ``UserDataHandler``.

    minidom calls it for every clone of an element, which gets the location of the original. The
    clones are counted, because macros can multiply them.
    """

    def __init__(self) -> None:
        self.clones = 0

    def handle(
        self, operation: int, key: str, location: object, source: object, clone: Untyped
    ) -> None:
        """Store the location of a clone; minidom calls this."""
        del operation, source
        clone.setUserData(key, location, self)
        self.clones += 1
        if self.clones > MAX_CLONES:
            raise RefusedError(f"the expansion copies more than {MAX_CLONES} elements")


class _Builder(expatbuilder.ExpatBuilderNS):
    def __init__(self, origin: str, locations: ElementLocations) -> None:
        super().__init__()
        self.origin = origin
        self.locations = locations

    def start_element_handler(self, name: Untyped, attributes: Untyped) -> None:
        super().start_element_handler(name, attributes)
        location = f"{self.origin}:{self.getParser().CurrentLineNumber}"
        self.curNode.setUserData(_LOCATION, location, self.locations)


def parse_yaml(data: bytes, path: Path, units: Iterable[Untyped]) -> object:
    """Parse a YAML file of texts, numbers, lists and dictionaries."""

    class Loader(yaml.SafeLoader):
        """Safe YAML with xacro's unit tags, which must not be added to the shared loader."""

        def flatten_mapping(self, node: yaml.MappingNode) -> None:
            super().flatten_mapping(node)
            if len(node.value) > MAX_SIZE:
                raise RefusedError(f"{path}: a mapping has more than {MAX_SIZE} entries")

    for unit in units:
        Loader.add_constructor(unit.value.tag, unit.constructor)
    # Sets and bytes are no data of an expression, and size_of does not count them.
    for tag in ("set", "binary"):
        Loader.add_constructor(f"tag:yaml.org,2002:{tag}", _refuse_tag)
    try:
        content = yaml.load(data, Loader)
    except yaml.YAMLError as error:
        raise FormatError(f"{path}{yaml_problem(error)}") from error
    size_of(content)
    return content


def _refuse_tag(loader: yaml.SafeLoader, node: yaml.Node) -> object:
    del loader
    raise yaml.constructor.ConstructorError(
        None, None, f"{node.tag} is neither text, number, list nor mapping", node.start_mark
    )


def document_text(document: minidom.Document) -> str:
    """Return a document as text."""
    pieces = []
    length = 0
    for piece in _serialised(document.documentElement):
        pieces.append(piece)
        length += len(piece)
        if length > MAX_OUTPUT:
            raise RefusedError(f"the expanded document has more than {MAX_OUTPUT} characters")
    return "".join(pieces)


def _serialised(node: minidom.Node | None) -> Iterator[str]:
    """Serialise a DOM; another user of xacro may have replaced ``minidom``'s own writer."""
    if isinstance(node, minidom.Text):
        yield escape(node.data)
    elif isinstance(node, minidom.Element):
        attributes = (f" {name}={quoteattr(value)}" for name, value in node.attributes.items())
        yield f"<{node.tagName}{''.join(attributes)}>"
        for child in node.childNodes:
            yield from _serialised(child)
        yield f"</{node.tagName}>"


Engine: TypeAlias = Any  # a xacro module, which has no type hints

MAX_ELEMENTS = 50_000  # largest number of elements that an expansion may process; the PR2 has 2,734
MAX_TEXT = 20_000_000  # largest text that the substitutions of an expansion may create [characters]

_NAME = "morphgen.formats._xacro"
_LOCK = threading.Lock()  # held by an expansion: the state of xacro is that of its module


def _safe_eval(
    text: str, symbols: Mapping[str, object], local: Mapping[str, object] | None = None
) -> object:
    return expression(text.strip()).evaluate(symbols, local)


def _shortcut(engine: Engine) -> Callable[[str, Any], object]:
    """Return ``eval_text`` with a limit on the size of its results.

    It skips the lexer, a quarter of an expansion's time, for texts without expressions.
    """
    eval_text = engine.eval_text

    def evaluated(text: str, symbols: Untyped) -> object:
        if "$" not in text:
            return text
        result = eval_text(text, symbols)
        if isinstance(result, str):
            engine.text += len(result)
            if engine.text > MAX_TEXT:
                raise RefusedError(f"the expansion creates more than {MAX_TEXT} characters")
        return result

    return evaluated


def _counting(engine: Engine) -> Callable[[Any, Any, Any], None]:
    """Return ``eval_all`` with a limit on the number of elements; it stores the element."""
    eval_all = engine.eval_all

    def counted(node: Untyped, macros: Untyped, symbols: Untyped) -> None:
        engine.elements += 1
        if engine.elements > MAX_ELEMENTS:
            raise RefusedError(f"the expansion processes more than {MAX_ELEMENTS} elements")
        engine.node = node
        eval_all(node, macros, symbols)

    return counted


def _returning(engine: Engine, function: Callable[..., object]) -> Callable[..., object]:
    """Wrap a function so that ``node`` is its element again after it processed other elements."""

    def call_and_restore(node: Untyped, *rest: Untyped) -> object:
        engine.node = node
        result = function(node, *rest)
        engine.node = node
        return result

    return call_and_restore


def _symbols(engine: Engine) -> dict[str, object]:
    """Return the names that every document may use, with and without a namespace."""

    def fatal(*words: object) -> None:
        raise engine.XacroException(" ".join(map(str, words)))

    def tokenize(text: str, sep: str = ",; ", skip_empty: bool = True) -> list[str]:
        for character in sep[1:]:
            text = text.replace(character, sep[0])
        return [word for word in text.split(sep[0]) if word or not skip_empty]

    files = {
        "load_yaml": lambda name: engine.load_yaml(name),
        "abs_filename": engine.abs_filename_spec,
        "dotify": dict,  # dots work on every dictionary here
    }
    calls = {
        **files,
        "arg": lambda name: engine.substitution_args_context["arg"][name],
        "fatal": fatal,
        "tokenize": tokenize,
        **dict.fromkeys(("message", "warning", "error", "print_location"), _discard),
    }
    functions = {name: Function(name, call) for name, call in calls.items()}
    return {**NAMES, **{name: functions[name] for name in files}, "xacro": Namespace(functions)}


def _discard(*words: object, **_: object) -> str:
    """Return the text of a message of a xacro, which is shown nowhere: nothing."""
    del words
    return ""


def _load_engine() -> Engine:
    """Import a copy of the ``xacro`` module under a private name.

    Differences from the package: an allow-list evaluates expressions, the number of elements and
    the size of text are bounded, ``node`` is the element being processed, and nothing is printed.
    """
    spec = importlib.util.find_spec("xacro")
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError("morphgen needs the package xacro: pip install xacro")
    private = importlib.util.spec_from_file_location(
        _NAME, spec.origin, submodule_search_locations=list(spec.submodule_search_locations or ())
    )
    assert private is not None
    assert private.loader is not None
    module: Engine = importlib.util.module_from_spec(private)
    sys.modules[_NAME] = module
    module.print = _discard
    writer = minidom.Element.writexml
    private.loader.exec_module(module)
    # The import of xacro 2.1.1 replaces minidom's writer for the whole process.
    minidom.Element.writexml = writer  # type: ignore[method-assign]
    sys.modules[f"{_NAME}.color"].print = _discard  # type: ignore[attr-defined]
    module.eval_text = _shortcut(module)
    module.safe_eval = _safe_eval
    module.glob = SimpleNamespace(glob=lambda pattern: module.list_files(pattern))
    module.eval_all = _counting(module)
    for name in ("handle_macro_call", "process_include", "check_attrs", "reqd_attrs"):
        setattr(module, name, _returning(module, getattr(module, name)))
    return module


_ENGINE = _load_engine()


CPU_LIMIT = 8  # longest computation of an expansion [s of CPU time]
WALL_LIMIT = 30
"""Longest wait for an expansion [s]. On Windows, which has no other limit, the only one."""
MEMORY_LIMIT = 2**30
"""Largest address space of an expansion [bytes]; Linux enforces it, macOS only in part."""

_RECURSION_LIMIT = 4000  # Python frames for nested macros; one level takes about ten
_CHILD_CODE = (
    "import json, sys; request = json.load(sys.stdin); sys.path[:] = request['sys_path']; "
    "from morphgen.formats.xacro.expand import serve; serve(request)"
)


def run_in_child(
    task: Callable[..., object], path: Path, finder: PackageFinder, **values: Mapping[str, str]
) -> Any:  # noqa: ANN401
    """Run a function in a child process with limits, and return its result."""
    source = str(Path(__file__).parents[3])
    request = {
        "task": [task.__module__, task.__name__],
        "path": str(path),
        "roots": [str(root) for root in finder.roots],
        "root": None if finder.root is None else str(finder.root),
        "values": {name: dict(given) for name, given in values.items()},
        "limits": {"cpu": CPU_LIMIT, "memory": MEMORY_LIMIT},
        "sys_path": [entry for entry in sys.path if Path(entry).is_absolute()] + [source],
    }
    try:
        # -I: neither the environment nor the current folder decides what the child imports.
        child = subprocess.run(
            [sys.executable, "-I", "-c", _CHILD_CODE],
            input=json.dumps(request).encode(),
            capture_output=True,
            timeout=WALL_LIMIT,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise FormatError(f"{path}: its expansion takes more than {WALL_LIMIT} s") from error
    except OSError as error:
        raise FormatError(f"{path}: no process for its expansion: {error.strerror}") from error
    if child.returncode:
        raise FormatError(f"{path}: {_failure(child.returncode, child.stderr)}")
    answer: dict[str, Any] = json.loads(child.stdout)
    if "error" in answer:
        raise FormatError(answer["error"])
    return answer["result"]


def _failure(code: int, stderr: bytes) -> str:
    """Return why a child ended without an answer."""
    if code < 0:  # minus the signal that ended it; Windows has no signals
        if -code == signal.SIGXCPU:
            return f"its expansion takes more than {CPU_LIMIT} s of CPU time"
        return f"its expansion was ended by signal {-code}, perhaps for lack of memory"
    last = stderr.decode(errors="replace").strip().splitlines()[-1:]
    if any("MemoryError" in line for line in last):
        return f"its expansion needs more than {MEMORY_LIMIT >> 20} MiB of memory"
    return f"its expansion ended with code {code}: {' '.join(last)[:200]}"


def serve(request: Mapping[str, Any]) -> None:
    """Run the parent's task in this process, the child, and print its result as JSON."""
    finder = PackageFinder(
        tuple(map(Path, request["roots"])),
        None if request["root"] is None else Path(request["root"]),
    )
    module, name = request["task"]
    task = getattr(import_module(module), name)
    limit_process(**request["limits"])
    answer: dict[str, Any]
    try:
        answer = {"result": task(Path(request["path"]), finder, **request["values"])}
    except FormatError as error:
        answer = {"error": str(error)}
    sys.stdout.write(json.dumps(answer))


def limit_process(cpu: int, memory: int) -> None:
    """Limit CPU time [s] and address space [bytes] of this process, and forbid writing files."""
    global MEMORY_LIMIT
    MEMORY_LIMIT = memory  # errors of the expansion name it
    sys.setrecursionlimit(_RECURSION_LIMIT)
    try:
        import resource
    except ImportError:  # Windows: the parent's WALL_LIMIT remains
        return
    limits = (
        # The second limit kills a process that survives the signal of the first.
        (resource.RLIMIT_CPU, cpu, cpu + 1),
        (resource.RLIMIT_AS, memory, memory),
        (resource.RLIMIT_FSIZE, 0, 0),
        (resource.RLIMIT_CORE, 0, 0),
    )
    for kind, soft, hard in limits:
        # macOS refuses some; the others, the bounds of the expansion and WALL_LIMIT remain.
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(kind, (soft, hard))


MAX_INCLUDE_DEPTH = 40  # deepest nesting of includes; deeper ones are taken for a loop

_COMMANDS = ("arg", "dirname", "eval", "find", "optenv")
_FAULTS = (*MALFORMED, ExpatError)
"""Exceptions that an invalid document can raise in the evaluator, besides XacroException."""


def expand(path: Path, args: Mapping[str, str], finder: PackageFinder) -> bytes:
    """Expand a xacro file to UTF-8 without XML declaration and comments.

    File and arguments may come from a stranger; see docs/security.md. A file that was installed
    with morphgen or a data package was chosen by whoever installed it, so it is expanded in this
    process as long as it reads installed files only. Every other file is expanded in a child
    process with limits.
    """
    path = path.absolute()
    if is_installed(path):
        expansion = Expansion(args, path, finder, installed_only=True)
        try:
            return expansion.run_file()
        except FormatError:
            if not expansion.met_foreign:
                raise
    document: str = run_in_child(expand_here, path, finder, args=args)
    return document.encode()


def expand_here(path: Path, finder: PackageFinder, args: Mapping[str, str]) -> str:
    """Expand a xacro file in this process; ``expand`` decides which process that is."""
    return Expansion(args, path, finder).run_file().decode()


class Expansion:
    """State of one expansion: its arguments, and the arguments that the files read declare."""

    def __init__(
        self,
        args: Mapping[str, str],
        origin: Path,
        finder: PackageFinder,
        objects: Mapping[str, object] | None = None,
        functions: Mapping[str, Function] | None = None,
        *,
        installed_only: bool = False,
    ) -> None:
        """Prepare; objects stand for arguments, and functions replace those of expressions."""
        self.engine = _ENGINE
        self.objects, self.functions = dict(objects or {}), dict(functions or {})
        self.given = {name: str(value) for name, value in args.items()}
        self.arguments = _Arguments(self.engine.XacroException, self.given)
        self.declared: set[str] = set()
        self.locations = ElementLocations()
        self.origin = origin
        self.finder = finder
        self.installed_only = installed_only
        self.met_foreign = False

    def run_file(self) -> bytes:
        """Expand the file."""
        return self.run(read_bytes(self.origin, MAX_FILE))

    def run(self, data: bytes) -> bytes:
        """Expand a document in place of the file's content."""
        with _LOCK, self._located():
            self._reset_engine()
            document = self._parse(data, str(self.origin))
            self.engine.process_doc(document, mappings=self.arguments)
            known = self.declared | self.arguments.used
            for name in (*self.given, *self.objects):
                if name not in known:
                    raise FormatError(f"{self.origin}: no argument {name!r}{nearest(name, known)}")
            return document_text(document).encode()

    def _reset_engine(self) -> None:
        engine = self.engine
        engine.parse, engine.load_yaml = self._parse_include, self._load_yaml
        engine.list_files, engine.eval_extension = self._list_files, self._substitute
        engine.all_includes, engine.substitution_args_context = [], {}
        engine.verbosity = engine.elements = engine.text = 0
        engine.node = None
        engine._global_symbols = _symbols(engine) | self.functions
        engine.init_stacks(str(self.origin))

    @contextmanager
    def _located(self) -> Iterator[None]:
        """Turn exceptions into one-line errors with the file and line being processed."""
        try:
            yield
        except (self.engine.XacroException, *_FAULTS) as error:
            macros, node = self.engine.macrostack, self.engine.node
            location = str(node.getUserData(_LOCATION) if node is not None else self.origin)
            macro = f" in macro {macros[-1].body.getAttribute('name')!r}" if macros else ""
            is_included = not location.startswith(str(self.origin))
            including = "" if not is_included else f" (included from {self.origin})"
            raise FormatError(f"{location}: {_reason(error)}{macro}{including}") from error

    def _parse(self, data: bytes, origin: str) -> minidom.Document:
        for element in parse_xml(data, origin).iter("{*}arg"):
            self.declared.add(element.get("name", ""))
        document = _Builder(origin, self.locations).parseString(data)
        assert isinstance(document, minidom.Document)
        return document

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
            files.pop()  # xacro has pushed the file, and pops it after a successful parse only
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
        Path(filename).stat()  # so that the error of a missing file names the line of its use
        try:
            return read_bytes(Path(filename), MAX_FILE)
        except FormatError as error:
            raise RefusedError(str(error)) from error  # gets the line of its use

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


def _reason(error: BaseException) -> str:
    """Return the innermost error in one line; xacro wraps it once for each expression."""
    suffix = ""
    while isinstance(inner := getattr(error, "exc", None), BaseException):
        suffix = getattr(error, "suffix", None) or suffix
        error = inner
    if isinstance(error, RecursionError):
        return "macros or properties refer to each other endlessly or too deeply"
    if isinstance(error, MemoryError):
        return f"its expansion needs more than {MEMORY_LIMIT >> 20} MiB of memory"
    return reason_of(error, suffix)
