"""Import order, module size and import cost of the packages."""

import ast
import json
import os
import subprocess
import sys
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import morphgen
from helpers.commands import WITHOUT_PROGRESS
from morphgen.errors import EXTRAS

ROOT = Path(__file__).parent.parent
PACKAGE = Path(morphgen.__file__).parent
FOLDERS = [
    *(PACKAGE / name for name in ("", "viewer", "tasks", "rl")),
    *(ROOT / name for name in ("benchmarks", "docs")),
]
"""Folders of modules; a source distribution has ``tasks`` only as ``morphgen/tasks``."""
PACKAGES = (
    *("errors", "typing", "files", "progress", "processes", "tables"),
    *("model", "formats", "checks", "grammar", "fitting", "encoding", "splits"),
    *("tasks", "rl", "benchmark", "viewer", "api", "cli"),
)
"""Packages and modules of morphgen, the lowest first; each may import itself and those below."""
MODULES = sorted(
    Path(folder, file)
    for folder, _, files in os.walk(PACKAGE, followlinks=True)  # tasks, rl and viewer are symlinks
    for file in files
    if file.endswith(".py")
)
COMMAND_LINE_USERS = (
    PACKAGE / "__main__.py",
    ROOT / "docs" / "site" / "hooks.py",  # writes the reference of the commands
)
HEAVY = ("coacd", "manifold3d", "mujoco", "pybullet", "torch", "trimesh", "viser", "yourdfpy")
"""Packages of simulators, meshes and networks."""


def name_of(path):
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


NAMES = {name_of(path): path for path in MODULES}


@cache
def imports(path):
    """Return the modules that a module imports anywhere in its code."""
    return set(imported(path))


def imported(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: a relative import"
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in NAMES else node.module


def package_of(module):
    _, _, below = module.partition(".")
    return below.partition(".")[0]


def test_imports_go_down_only():
    upwards = [
        f"{name} imports {module}"
        for name, path in NAMES.items()
        if (own := package_of(name)) in PACKAGES  # not morphgen/__init__.py and data folders
        for module in imports(path)
        if module.startswith("morphgen.")
        and package_of(module) not in PACKAGES[: PACKAGES.index(own) + 1]
    ]
    assert upwards == []


def test_imports_have_no_cycles():
    modules = {*NAMES} - {"morphgen"}
    graph = {name: (imports(NAMES[name]) & {*NAMES}) - {name} for name in modules}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_no_module_imports_the_top_level_package(folder):
    users = [path for path in folder.rglob("*.py") if "morphgen.cli" in imports(path)]
    below = [path for path in users if PACKAGE / "cli" not in path.parents]
    assert {*below} <= {*COMMAND_LINE_USERS}


def test_every_package_has_a_layer():
    others = {"templates", "robots_real", "__main__"}  # data folders and the CLI entry point
    assert {package_of(name) for name in NAMES} - {""} == set(PACKAGES) | others


@pytest.mark.parametrize("folder", [*FOLDERS, ROOT / "tests"], ids=lambda folder: folder.name)
def test_no_module_is_too_long(folder):
    modules = folder.rglob("*.py")
    lengths = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in modules}
    assert lengths
    assert {str(path): n for path, n in lengths.items() if n > 1000} == {}


def modules_after(statement):
    code = f"import sys; {statement}; print(' '.join({{m.partition('.')[0] for m in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


SPLITS_AND_GOALS = (
    "benchmark.split_folder fitting.token_shapes model.kinematics tasks.scenes.env_specs"
)


@pytest.mark.parametrize(
    ("modules", "needed", "others"),
    [
        ("morphgen", "morphgen", (*HEAVY, "numpy", "scipy", "lxml", "yaml")),
        ("morphgen.cli", "morphgen", (*HEAVY, "numpy", "scipy", "lxml", "yaml")),
        ("morphgen.grammar.library", "yaml", HEAVY),
        ("morphgen.cli.lists", "morphgen", HEAVY),
        ("morphgen.checks", "numpy", (*HEAVY, "fcl", "igl", "lxml", "scipy")),
        (", ".join(f"morphgen.{name}" for name in SPLITS_AND_GOALS.split()), "mujoco", ["torch"]),
    ],
)
def test_importing_modules_loads_only_the_packages_that_they_need(modules, needed, others):
    loaded = modules_after(f"import {modules}")
    assert needed in loaded
    assert loaded.isdisjoint(others)


def modules_of_command(folder, *words):
    """Return the modules that a command loads, with a cache in the folder."""
    code = (
        "import sys; from morphgen.cli import main; code = main(sys.argv[1:]); "
        "print(*sorted(sys.modules)); sys.exit(code)"
    )
    options = {"env": {**os.environ, "XDG_CACHE_HOME": str(folder / "cache")}, "cwd": folder}
    command = [sys.executable, "-c", code, *words]
    done = subprocess.run(command, capture_output=True, text=True, check=True, **options)
    return set(done.stdout.splitlines()[-1].split())


def test_a_list_loads_neither_numpy_nor_a_parser(tmp_path):
    loaded = modules_of_command(tmp_path, "list", "arms")
    assert "morphgen.cli.lists" in loaded
    others = {"numpy", "lark", "lxml", "tqdm", "multiprocessing", "morphgen.model.robot"}
    assert loaded.isdisjoint({*HEAVY, *others})


@pytest.mark.slow
def test_composing_loads_no_reader_of_what_is_kept(tmp_path):
    words = ("compose", "arm=px100", "ee=plane", "--no-picture")
    first, again = (modules_of_command(tmp_path, *words) for _ in range(2))
    heavy = {"trimesh", "scipy", "networkx", "PIL", "xacro", "xml.dom", "morphgen.formats._xacro"}
    assert {"trimesh", "scipy", "morphgen.formats._xacro"} <= first
    assert {"mujoco", "morphgen.formats.bundle"} <= again
    assert again.isdisjoint({*heavy, *HEAVY, "igl", "tqdm"} - {"mujoco"})
    rooms = ("fitting", "formats.mjcf.read", "model.mesh_files", "grammar.robot_source")
    assert again.isdisjoint(f"morphgen.{room}" for room in rooms)


WITHOUT_EXTRAS = """
import sys
from importlib.machinery import PathFinder

class Without(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name in {extras} else PathFinder.find_spec(name, path, target)

sys.meta_path[sys.meta_path.index(PathFinder)] = Without
"""


def python_without_extras(folder, statements, *words):
    extras = [*EXTRAS, "pinocchio", "pybullet", "yourdfpy", "ray"]
    code = WITHOUT_EXTRAS.format(extras=extras) + statements
    command = [sys.executable, "-c", code, *words]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder)


SLOW_COMMANDS = (
    *("compose arm=ur5 --geometry primitive", "sample chain -n 1", "check arm3-stick", "doctor"),
    *("tokens ur5-plane", "similarity prims stick", "conform prims"),
    "split show interpolation/panda/reach",
)


@pytest.mark.parametrize(
    "command", ["demo", *(pytest.param(each, marks=pytest.mark.slow) for each in SLOW_COMMANDS)]
)
def test_core_works_without_optional_extras(command, tmp_path):
    done = python_without_extras(tmp_path, WITHOUT_PROGRESS, *command.split())
    assert (done.returncode, done.stderr) == (0, "")


MISSING = {
    **{"fit ur5": "fit", "compose arm=ur5 --geometry convex": "convex", 'fit("z1")': "fit"},
    **{"export prims --format usd": "usd", "view": "viewer", "finetune zero-shot": "rl"},
    **{"train interpolation/arm3/reach": "rl", 'train("prims task=reach")': "rl"},
    **dict.fromkeys(("play reach prims", 'make_env("reach", "prims")'), "tasks"),
}
"""Extra that a command, or a call of ``import morphgen``, needs."""
TRIED_WITHOUT = """
import contextlib, io, json, morphgen
from morphgen.cli import main, progress

progress.FIRST_LINE = float("inf")  # as without progress
assert all(getattr(morphgen, name) for name in dir(morphgen))
results = []
for each in {calls}:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = eval(f"morphgen.{{each}}") if "(" in each else main(each.split())
        except morphgen.MorphgenError as error:
            code = f"{{type(error).__name__}} {{error}}"
    results.append((code, out.getvalue(), err.getvalue()))
print(json.dumps(results))
"""


def test_missing_extra_error_says_how_to_install_it(tmp_path):
    done = python_without_extras(tmp_path, TRIED_WITHOUT.format(calls=[*MISSING]))
    assert done.stderr == ""
    results = json.loads(done.stdout)
    for (call, extra), (code, out, err) in zip(MISSING.items(), results, strict=True):
        assert out == "", call
        if "(" in call:
            assert (code.startswith("MissingDependencyError the package "), err) == (True, ""), call
        else:
            assert (code, err.count("\n")) == (2, 1), err
        assert f"pip install 'morphgen[{extra}]'" in f"{code} {err}", call
