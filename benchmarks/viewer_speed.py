"""Load times of the viewer's pages, and the memory of its server.

    python benchmarks/viewer_speed.py [--robots 100] [--many 500] [--moves 200]

Samples sets of arm3 into a temporary folder, as bundles without pictures and with an empty cache of
thumbnails. `morphgen view` serves them in a process of its own, and a headless browser on the same
machine opens them. Times in seconds:

- from the start of `morphgen view robots/arm3` until it prints its address;
- from requesting the gallery page until its first thumbnail, and until all 24 thumbnails, which two
  workers draw;
- from requesting the page of a Panda with its hand until it can be moved and its collisions are
  known.

Prints the server's time for one slider move of that page with collision tests [ms], median and 95th
percentile, for a slider that the browser moves every 30 ms. Prints the memory of the server without
its workers at its first page and with a gallery of many robots, 96 per page (Linux).

Needs `pip install morphgen[test]` and chromium.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from unittest.mock import patch

from tabulate import tabulate

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
WAIT = 120_000
"""Longest time to wait for a page [ms]."""
PAUSE = 30
"""Time between two moves [ms]."""
FIRST = 5
"""Moves that are not counted: loading the page causes some, and first calls are slow."""
PANDA = "?robot=words:arm=panda ee=panda_hand"
CARD = ".card img"
MORPHGEN = (sys.executable, "-m", "morphgen")
Row = tuple[str, str]


def main() -> int:
    """Measure all pages and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=100)
    parser.add_argument("--many", type=int, default=500)
    parser.add_argument("--moves", type=int, default=200)
    parser.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.serve is not None:
        _serve(args.serve)
        return 0
    with tempfile.TemporaryDirectory() as scratch, _browser() as browser:
        folder = Path(scratch)
        os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
        _sample(folder, "arm3", args.robots, "--no-picture")
        _sample(folder, "many", args.many, "--light")
        rows = _pages(browser, folder, args.robots)
        rows += _memory(browser, folder, args.many)
        rows += _moves(browser, folder, args.moves)
    print(tabulate(rows, ["what", "figure"], disable_numparse=True))
    return 0


def _sample(folder: Path, name: str, n: int, how: str) -> None:
    words = ("sample", "arm3", "-n", str(n), "--out", f"robots/{name}", how)
    subprocess.run([*MORPHGEN, *words], cwd=folder, check=True, stdout=subprocess.DEVNULL)


@contextmanager
def _browser() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        sys.exit("there is no chromium")
    sandbox = () if os.geteuid() else ("--no-sandbox",)
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=path, args=[*GL, *sandbox])
        yield browser
        browser.close()


@contextmanager
def _page(browser: Any) -> Iterator[Any]:  # noqa: ANN401
    context = browser.new_context(viewport={"width": 1400, "height": 900})
    context.set_default_timeout(WAIT)
    yield context.new_page()
    context.close()


@contextmanager
def _started(command: Sequence[str], folder: Path) -> Iterator[tuple[str, float, int]]:
    """Start a viewer; return its address, the time until it answered [s], and its process."""
    begun = time.perf_counter()
    viewing = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True)
    try:
        assert viewing.stdout is not None
        address = viewing.stdout.readline().split()[0]
        yield address, time.perf_counter() - begun, viewing.pid
    finally:
        viewing.send_signal(signal.SIGINT)
        viewing.wait()


def _pages(browser: Any, folder: Path, robots: int) -> list[Row]:  # noqa: ANN401
    with _started([*MORPHGEN, "view", "robots/arm3"], folder) as (address, ready, _):
        with _page(browser) as page:
            begun = time.perf_counter()
            page.goto(address)
            page.locator(CARD).first.wait_for()
            first = time.perf_counter() - begun
            shown = page.locator(".card").count()
            page.wait_for_function(f"document.querySelectorAll('{CARD}').length == {shown}")
            every = time.perf_counter() - begun
        with _page(browser) as page:
            begun = time.perf_counter()
            page.goto(f"{address}/{PANDA}")
            _wait_until_tested(page)
            panda = time.perf_counter() - begun
    return [
        ("morphgen view robots/arm3, until it serves", f"{ready:.1f} s"),
        (f"first thumbnail of {robots} robots", f"{first:.1f} s"),
        (f"all {shown} thumbnails of the page", f"{every:.1f} s"),
        ("page of a Panda with its hand", f"{panda:.1f} s"),
    ]


def _memory(browser: Any, folder: Path, many: int) -> list[Row]:  # noqa: ANN401
    with _started([*MORPHGEN, "view"], folder) as (address, _, process), _page(browser) as page:
        page.goto(address)
        page.locator(".card").first.wait_for()
        before = _resident(process)
        page.goto(f"{address}/?gallery=robots/many&size=96")
        page.get_by_text(f"{many} robots").first.wait_for()
        page.wait_for_function(f"document.querySelectorAll('{CARD}').length == {min(many, 96)}")
        return [
            ("memory of the server at its first page", f"{before / 2**20:.0f} MB"),
            (f"with a gallery of {many} robots", f"{_resident(process) / 2**20:.0f} MB"),
        ]


def _resident(process: int) -> int:
    """Return the resident memory of a process [bytes]."""
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _moves(browser: Any, folder: Path, moves: int) -> list[Row]:  # noqa: ANN401
    """Return the server's time of each move [ms], measured in the server."""
    told = folder / "moves.json"
    command = [sys.executable, str(Path(__file__).resolve()), "--serve", str(told)]
    with _started(command, folder) as (address, _, _), _page(browser) as page:
        page.goto(f"{address}/{PANDA}")
        _wait_until_tested(page)
        slider = page.locator(".mantine-NumberInput-input").first
        for i in range(moves):
            slider.fill(f"{(i % 40) / 20 - 1:.2f}")
            page.wait_for_timeout(PAUSE)
        page.wait_for_timeout(1000)
    times = json.loads(told.read_text())
    late = statistics.quantiles(times, n=20)[-1]
    text = f"{statistics.median(times):.1f} ms, 95 % below {late:.1f} ms"
    return [(f"a move of a slider, of {len(times)}", text)]


def _serve(told: Path) -> None:
    """Serve until interrupted, then write the time of every move [ms]."""
    from morphgen.viewer import page_robot_show
    from morphgen.viewer.app import serve
    from morphgen.viewer.page_robot_show import RobotPage, update_scene

    times: list[float] = []

    def timed(moved: RobotPage) -> None:
        begun = time.perf_counter()
        update_scene(moved)
        times.append(1e3 * (time.perf_counter() - begun))

    with patch.object(page_robot_show, "update_scene", timed):
        viewer = serve()
        print(f"http://127.0.0.1:{viewer.port}", flush=True)
        with suppress(KeyboardInterrupt):
            viewer.server.sleep_forever()
        viewer.stop()
    told.write_text(json.dumps(times[FIRST:]))


def _wait_until_tested(page: Any) -> None:  # noqa: ANN401
    tested = page.get_by_text("no self-collision").or_(page.get_by_text("collision", exact=True))
    tested.first.wait_for()


if __name__ == "__main__":
    sys.exit(main())
