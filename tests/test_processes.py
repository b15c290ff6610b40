"""Parallel work gives the results of serial work; importing changes no state of a process."""

import ast
import os
import signal
import subprocess
import sys
import time
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from threading import Condition, Thread, current_thread, main_thread

import pytest

from helpers.worker_functions import be_idle, die, die_at_three, fail, power
from morphgen.errors import BenchmarkError, MorphgenError
from morphgen.processes import CHUNK_SIZE, parallel_map, ray_cluster, require_ray
from morphgen.progress import interrupts, own_progress, part_of, report, show_progress


@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize("n", [0, 1, CHUNK_SIZE, 5 * CHUNK_SIZE + 3])
def test_results_come_in_order(jobs, n):
    counts = []
    with show_progress(lambda *count: counts.append(count)):
        results = list(parallel_map(partial(power, 2), range(n), jobs))
    assert [value for value, _ in results] == [i**2 for i in range(n)]
    assert counts == [(i + 1, n) for i in range(n)]
    elsewhere = {process for _, process in results} - {os.getpid()}
    assert bool(elsewhere) == (jobs > 1 and n > CHUNK_SIZE)


def test_ray_without_its_package_or_a_cluster_is_an_error(monkeypatch):
    pytest.importorskip("ray")
    with pytest.raises(MorphgenError, match=r"1:1': .*refused"), ray_cluster("127.0.0.1:1"):
        pass
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MorphgenError, match=r"pip install 'morphgen\[ray\]'"):
        require_ray()


@pytest.mark.slow
def test_the_error_of_a_task_of_ray_is_its_cause(monkeypatch):
    ray = pytest.importorskip("ray")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))  # of the module helpers
    with pytest.raises(BenchmarkError, match="20 is wrong"), ray_cluster(None):
        ray.get(ray.remote(fail).remote(20))


@pytest.mark.parametrize("jobs", [1, 2])
def test_worker_error_is_raised(jobs):
    results = parallel_map(fail, range(40), jobs)
    assert [next(results) for _ in range(2 * CHUNK_SIZE)] == list(range(2 * CHUNK_SIZE))
    with pytest.raises(BenchmarkError, match="20 is wrong"):
        list(results)


def test_dead_process_is_reported():
    with pytest.raises(MorphgenError, match=r"a worker died.*finished results are kept: run again"):
        list(parallel_map(die, range(20), 2))


def test_a_process_that_dies_while_results_are_used_is_reported():
    def slowly(result):
        time.sleep(0.1)  # meanwhile the pool breaks, before the next item is submitted
        return result

    with pytest.raises(MorphgenError, match="a worker died"):
        list(map(slowly, parallel_map(die_at_three, range(40), 2, chunk=1)))


def test_an_idle_worker_ends_soon_after_its_parent_has_stopped():
    """The pool of Python 3.12 does not tell workers to end where another one has died."""
    context = get_context("spawn")
    stopped = context.RawValue("b", 1)
    worker = context.Process(target=be_idle, args=(stopped,))
    worker.start()
    worker.join(50)
    assert worker.exitcode == 1


@pytest.fixture
def _ctrl_c():
    """Heed Ctrl-C, which background processes of a shell ignore."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("_ctrl_c")
def test_ctrl_c_between_a_lock_and_its_release_ends_the_pool(monkeypatch):
    enter = Condition.__enter__

    def interrupted(condition):
        entered = enter(condition)
        if current_thread() is main_thread():
            signal.raise_signal(signal.SIGINT)
        return entered

    results = parallel_map(time.sleep, [0.0, 60.0, 60.0], 2, chunk=1)
    next(results)
    with monkeypatch.context() as patched:  # else it would interrupt pytest as it sends its report
        patched.setattr(Condition, "__enter__", interrupted)
        with pytest.raises(KeyboardInterrupt):
            list(results)


def test_ctrl_c_that_python_loses_ends_the_pool_before_the_next_result():
    results = parallel_map(time.sleep, [0.0, 60.0, 60.0], 2, chunk=1)
    next(results)
    interrupts.append(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        next(results)
    assert interrupts == []


@pytest.mark.parametrize("jobs", [0, -1])
def test_number_of_jobs_is_at_least_one(jobs):
    with pytest.raises(MorphgenError, match=f"jobs {jobs}: expected a whole number, 1 or more"):
        list(parallel_map(fail, [1], jobs))


def test_reports_count_the_items_of_the_outermost_work():
    seen = []
    with show_progress(lambda *count: seen.append(count)):
        list(parallel_map(lambda n: list(parallel_map(abs, range(n), 1)), [2, 3], 1))
        for first in (0, 2):
            with part_of(4, first):
                list(parallel_map(abs, [1, 2], 1))
        with own_progress() as show:
            report(9, 9)
            show(1, None)
        thread = Thread(target=report, args=(8, 8))
        thread.start()
        thread.join()
    report(7, 7)
    assert seen == [(1, 2), (2, 2), (1, 4), (2, 4), (3, 4), (4, 4), (1, None)]


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


def test_importing_every_module_and_starting_the_viewer_changes_no_state():
    code = f"""
import contextlib, csv, importlib, locale, logging, os, random, signal, socket, sys, threading
import warnings
import gymnasium, imageio.v2, imageio_ffmpeg, matplotlib.figure, mujoco, numpy, PIL.Image
import PIL.ImageFile, scipy.optimize, scipy.spatial, scipy.stats, torch, trimesh, viser
import websockets.asyncio.server, websockets.http11
for optional in ("mujoco_warp", "warp", "stable_baselines3", "pybullet"):
    with contextlib.suppress(ImportError):
        importlib.import_module(optional)
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
    changes = [line for line in done.stdout.splitlines() if line.startswith("changed:")]
    assert changes == ["changed:"]


def test_every_cache_has_a_bound():
    endless = []
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and any(vars(node.args).values()):
                caches = [ast.unparse(each) for each in node.decorator_list]
                if any(c in ("cache", "functools.cache") or "maxsize=None" in c for c in caches):
                    endless.append(f"{path}: {node.name}")
    assert endless == []
