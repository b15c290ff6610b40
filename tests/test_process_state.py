"""Importing and starting morphgen leaves the state of the process as it was."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FILES = [
    path
    for folder in ("morphgen", "rl", "tasks", "viewer")
    for path in sorted((ROOT / folder).rglob("*.py"))
    if not any(parent.is_symlink() for parent in path.parents)
]
MODULES = [
    ".".join((*(() if path.parts[0] == "morphgen" else ("morphgen",)), *path.with_suffix("").parts))
    for path in (file.relative_to(ROOT) for file in FILES)
    if path.name not in ("__main__.py", "__init__.py")
]
STATE = {
    "warnings": "[f[:1] + f[2:] for f in map(str, warnings.filters)]",
    "signals": "[signal.getsignal(s) for s in signal.valid_signals()]",
    "environment": "dict(os.environ)",
    "folder": "os.getcwd()",
    "recursion": "sys.getrecursionlimit()",
    "logging": "(logging.root.level, logging.root.handlers, logging.raiseExceptions)",
    "excepthook": "(sys.excepthook is sys.__excepthook__, threading.excepthook.__name__)",
    "locale": "locale.setlocale(locale.LC_ALL)",
    "numpy": "(numpy.get_printoptions(), numpy.geterr(), str(numpy.random.get_state()))",
    "torch": "(torch.get_num_threads(), torch.get_default_dtype(), torch.initial_seed())",
    "random": "random.getstate()",
    "matplotlib": "(matplotlib.rcParams['backend'], dict(matplotlib.rcParams))",
    "pillow": "(PIL.Image.MAX_IMAGE_PIXELS, PIL.ImageFile.LOAD_TRUNCATED_IMAGES)",
    "websockets": "(websockets.http11.MAX_LINE_LENGTH, websockets.asyncio.server.serve)",
    "csv": "csv.field_size_limit()",
    "sockets": "socket.getdefaulttimeout()",
}
"""Expressions of what a module of morphgen must not change, by kind."""


@pytest.fixture(scope="module")
def changed():
    """Kinds of state that importing all modules, and starting the viewer, changes."""
    code = f"""
import csv, importlib, locale, logging, os, random, signal, socket, sys, threading, warnings
import gymnasium, imageio.v2, imageio_ffmpeg, matplotlib.figure, mujoco, numpy, PIL.Image
import PIL.ImageFile, scipy.optimize, scipy.spatial, scipy.stats, torch, trimesh, viser
import websockets.asyncio.server, websockets.http11
try:
    import mujoco_warp, warp
except ImportError:
    pass
try:
    import stable_baselines3
except ImportError:
    pass
try:
    import pybullet
except ImportError:
    pass
STATE = {STATE!r}
def state():
    return {{kind: repr(eval(text)) for kind, text in STATE.items()}}
before = state()
for name in {MODULES!r}:
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name.startswith("morphgen"):
            raise
from morphgen.formats.xacro.evaluator import expression
expression("2if 1 else 3").evaluate({{}})
from morphgen.viewer.app.app import serve
serve([], "127.0.0.1", 0, []).stop()
after = state()
print("changed:", *(kind for kind in STATE if before[kind] != after[kind]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("changed:")]
    return line.split()[1:]


@pytest.mark.parametrize("kind", STATE)
def test_importing_every_module_changes_nothing(kind, changed):
    assert kind not in changed


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_cache_has_a_bound(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if not isinstance(node, ast.FunctionDef):
            continue
        takes_arguments = ast.unparse(node.args) != ""
        for decorator in map(ast.unparse, node.decorator_list if takes_arguments else ()):
            assert decorator not in ("cache", "functools.cache"), f"{node.name}: {decorator}"
            assert "maxsize=None" not in decorator, f"{node.name}: {decorator}"
