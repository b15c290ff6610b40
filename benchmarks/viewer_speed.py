"""Load times of the viewer's pages, and the memory of its server.

    python benchmarks/viewer_speed.py [--robots 100] [--many 500] [--moves 200]
    python benchmarks/viewer_speed.py --only population
    python benchmarks/viewer_speed.py --only pages

Samples sets of arm3 into a temporary folder, as bundles without pictures and with an empty cache of
thumbnails. `morphgen view` serves them in a process of its own, and a headless browser on the same
machine opens them. Times in seconds:

- from requesting the library until the first picture and until all 24 pictures, with an empty cache
  of thumbnails, and in a new browser with a full one;
- from a click on a card of the gallery until the robot can be moved and its collisions are known;
- from Back until the gallery has its pictures again;
- from a new value of a parameter in Compose until the facts of the new robot are shown, median and
  95th percentile;

- from the start of `morphgen view robots/arm3` until it prints its address;
- from requesting the gallery page until its first thumbnail, and until all 24 thumbnails, which two
  workers draw;
- from requesting the page of a Panda with its hand until it can be moved and its collisions are
  known.

Prints the server's time for one slider move of that page with collision tests [ms], median and 95th
percentile, for a slider that the browser moves every 30 ms. Prints the memory of the server without
its workers at its first page and with a gallery of many robots (Linux).

For the population page with 100 and with 1000 arm3, all moved by the slider of one joint: the
server's time of a move (kinematics of all robots, and the messages), the bytes that the browser
gets for it, the draw calls of a frame, and the time between frames while the camera turns, in
headless chromium with software GL. A browser with a GPU draws the same calls in a fraction.

Needs `pip install morphgen[test]` and chromium.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import re
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
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
VISITS = 5
"""Robots that are opened from the gallery."""
EDITS = 20
"""Edits of a robot on the compose page."""
PARAMETER = "length (m)"
FACTS = re.compile("DoF.*kg")
CHANGED = """(before) => {
  const text = document.evaluate("//*[text()[contains(., 'DoF') and contains(., 'kg')]]", document,
    null, XPathResult.FIRST_ORDERED_NODE_TYPE, null).singleNodeValue?.innerText;
  return text && text != before;
}"""
"""Script that tells whether the line with the facts of a robot has changed."""
POPULATIONS = (100, 1000)
"""Sizes of the populations [robots]."""
TURNS = 40
"""Moves of the pointer that turns the camera."""
COUNT_DRAWS = """
const draws = window.draws = { calls: 0, frames: [] };
for (const name of ["drawArrays", "drawArraysInstanced", "drawElements", "drawElementsInstanced",
                    "drawRangeElements", "multiDrawElementsWEBGL"]) {
  const original = WebGL2RenderingContext.prototype[name];
  if (original) WebGL2RenderingContext.prototype[name] = function (...values) {
    draws.calls += 1;
    return original.apply(this, values);
  };
}
const tick = (time) => {
  if (draws.calls) draws.frames.push([time, draws.calls]);
  draws.calls = 0;
  requestAnimationFrame(tick);
};
requestAnimationFrame(tick);
"""
"""Script of a page that stores the time [ms] and the draw calls of every frame that draws."""
MORPHGEN = (sys.executable, "-m", "morphgen")
Row = tuple[str, str]


def main() -> int:
    """Measure all pages and print the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robots", type=int, default=100)
    parser.add_argument("--many", type=int, default=500)
    parser.add_argument("--moves", type=int, default=200)
    parser.add_argument("--only", choices=("population", "pages"), help="measure nothing else")
    parser.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.serve is not None:
        _serve(args.serve)
        return 0
    with tempfile.TemporaryDirectory() as scratch, started_browser() as browser:
        folder = Path(scratch)
        os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
        rows = []
        if args.only != "population":
            sample(folder, "arm3", args.robots, "--no-picture")
            rows += _library(browser, folder)
            rows += _pages(browser, folder, args.robots)
        if args.only is None:
            sample(folder, "many", args.many, "--light")
            rows += _memory(browser, folder, args.many)
            rows += _moves(browser, folder, args.moves)
        for robots in POPULATIONS if args.only != "pages" else ():
            sample(folder, f"population{robots}", robots, "--light")
            rows += _population(browser, folder, robots, args.moves)
    print(tabulate(rows, ["what", "figure"], disable_numparse=True))
    return 0


def sample(folder: Path, name: str, n: int, how: str) -> None:
    """Sample a set of arm3 into ``robots/NAME`` of a folder."""
    words = ("sample", "arm3", "-n", str(n), "--out", f"robots/{name}", how)
    subprocess.run([*MORPHGEN, *words], cwd=folder, check=True, stdout=subprocess.DEVNULL)


@contextmanager
def started_browser() -> Iterator[Any]:
    """Start a headless browser."""
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
def opened_page(browser: Any) -> Iterator[Any]:  # noqa: ANN401
    """Open an empty page without cookies or cached files."""
    context = browser.new_context(viewport={"width": 1400, "height": 900})
    context.set_default_timeout(WAIT)
    yield context.new_page()
    context.close()


@contextmanager
def started_viewer(command: Sequence[str], folder: Path) -> Iterator[tuple[str, float, int]]:
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


def wait_for_cards(page: Any) -> int:  # noqa: ANN401
    """Wait until all cards of a gallery have their pictures; return how many there are."""
    page.locator(CARD).first.wait_for()
    shown = page.locator(".card").count()
    page.wait_for_function(f"document.querySelectorAll('{CARD}').length == {shown}")
    return int(shown)


def _open_gallery(page: Any, address: str) -> tuple[float, float, int]:  # noqa: ANN401
    """Open a gallery; return the times of its first and its last picture [s], and their number."""
    begun = time.perf_counter()
    page.goto(address)
    page.locator(CARD).first.wait_for()
    first = time.perf_counter() - begun
    shown = wait_for_cards(page)
    return first, time.perf_counter() - begun, shown


def _library(browser: Any, folder: Path) -> list[Row]:  # noqa: ANN401
    rows = []
    with started_viewer([*MORPHGEN, "view"], folder) as (address, _, _):
        for cache in ("no thumbnail stored", "all stored"):
            with opened_page(browser) as page:
                first, every, shown = _open_gallery(page, address)
            rows.append((f"first picture of the library, {cache}", f"{first:.1f} s"))
            rows.append((f"all {shown} pictures, {cache}", f"{every:.1f} s"))
    return rows


def _edits(page: Any) -> list[float]:  # noqa: ANN401
    """Return the times of edits of a robot on the compose page [ms]."""
    times = []
    page.get_by_text(FACTS).first.wait_for()
    page.wait_for_timeout(5000)  # until the light has faded in
    field = page.get_by_text(PARAMETER, exact=True).locator("xpath=ancestor::*[.//input][1]//input")
    for i in range(EDITS):
        before = page.get_by_text(FACTS).first.inner_text()
        begun = time.perf_counter()
        field.last.fill(("0.35", "0.45")[i % 2])
        page.wait_for_function(CHANGED, arg=before)
        times.append(1e3 * (time.perf_counter() - begun))
        page.wait_for_timeout(1000)
    return times


def _pages(browser: Any, folder: Path, robots: int) -> list[Row]:  # noqa: ANN401
    with started_viewer([*MORPHGEN, "view", "robots/arm3"], folder) as (address, ready, _):
        with opened_page(browser) as page:
            first, every, shown = _open_gallery(page, address)
            cards, backs = [], []
            for i in range(VISITS):
                begun = time.perf_counter()
                page.locator("a.card").nth(i).click()
                wait_until_tested(page)
                cards.append(time.perf_counter() - begun)
                begun = time.perf_counter()
                page.go_back()
                wait_for_cards(page)
                backs.append(time.perf_counter() - begun)
        with opened_page(browser) as page:
            page.goto(f"{address}/?compose=arm=arm3 ee=stick")
            edits = _edits(page)
        with opened_page(browser) as page:
            begun = time.perf_counter()
            page.goto(f"{address}/{PANDA}")
            wait_until_tested(page)
            panda = time.perf_counter() - begun
    return [
        ("morphgen view robots/arm3, until it serves", f"{ready:.1f} s"),
        (f"first thumbnail of {robots} robots", f"{first:.1f} s"),
        (f"all {shown} thumbnails of the page", f"{every:.1f} s"),
        (f"a robot from a card, median of {VISITS}", f"{statistics.median(cards):.2f} s"),
        (f"Back to the gallery with {shown} pictures", f"{statistics.median(backs):.2f} s"),
        (f"an edit in Compose, of {EDITS}", _spread(edits)),
        ("page of a Panda with its hand", f"{panda:.1f} s"),
    ]


def _memory(browser: Any, folder: Path, many: int) -> list[Row]:  # noqa: ANN401
    with (
        started_viewer([*MORPHGEN, "view"], folder) as (address, _, process),
        opened_page(browser) as page,
    ):
        page.goto(address)
        page.locator(".card").first.wait_for()
        before = resident(process)
        page.goto(f"{address}/?gallery=robots/many")
        page.get_by_text(f"{many} robots").first.wait_for()
        wait_for_cards(page)
        return [
            ("memory of the server at its first page", f"{before / 2**20:.0f} MB"),
            (f"with a gallery of {many} robots", f"{resident(process) / 2**20:.0f} MB"),
        ]


def resident(process: int) -> int:
    """Return the resident memory of a process [bytes]."""
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _moves(browser: Any, folder: Path, moves: int) -> list[Row]:  # noqa: ANN401
    """Return the server's time of each move [ms], measured in the server."""
    told = folder / "moves.json"
    command = [sys.executable, str(Path(__file__).resolve()), "--serve", str(told)]
    with started_viewer(command, folder) as (address, _, _), opened_page(browser) as page:
        page.goto(f"{address}/{PANDA}")
        wait_until_tested(page)
        slider = page.locator(".mantine-NumberInput-input").first
        for i in range(moves):
            slider.fill(f"{(i % 40) / 20 - 1:.2f}")
            page.wait_for_timeout(PAUSE)
        page.wait_for_timeout(1000)
    times = json.loads(told.read_text())["robot"]
    return [(f"a move of a slider, of {len(times)}", _spread(times))]


def _spread(times: Sequence[float]) -> str:
    late = statistics.quantiles(times, n=20)[-1]
    return f"{statistics.median(times):.1f} ms, 95 % below {late:.1f} ms"


def _population(browser: Any, folder: Path, robots: int, moves: int) -> list[Row]:  # noqa: ANN401
    """Return what a population's moves and frames cost."""
    told = folder / "moves.json"
    command = [sys.executable, str(Path(__file__).resolve()), "--serve", str(told)]
    received = [0]

    def count(payload: bytes | str) -> None:
        received[0] += len(payload)

    with started_viewer(command, folder) as (address, _, _), opened_page(browser) as page:
        page.add_init_script(COUNT_DRAWS)
        page.on("websocket", lambda socket: socket.on("framereceived", count))
        begun = time.perf_counter()
        page.goto(f"{address}/?population=robots/population{robots}")
        page.get_by_text("no robot is selected").wait_for()
        shown = time.perf_counter() - begun
        page.wait_for_timeout(5000)  # until the light has faded in
        box = page.locator("canvas").first.bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.evaluate("window.draws.frames = []")
        for i in range(TURNS):
            page.mouse.move(x + 4 * i, y)
        frames = page.evaluate("window.draws.frames")
        page.mouse.up()
        page.wait_for_timeout(3000)
        slider, before = page.locator(".mantine-NumberInput-input").first, received[0]
        for i in range(moves):
            slider.fill(f"{(i % 40) / 40:.2f}")
            page.wait_for_timeout(PAUSE)
        page.wait_for_timeout(3000)
        size = received[0] - before
    times = json.loads(told.read_text())["population"]
    gaps = [b[0] - a[0] for a, b in itertools.pairwise(frames)]
    name = f"population of {robots}"
    return [
        (f"{name}: until it is shown", f"{shown:.1f} s"),
        (f"{name}: a move on the server", _spread(times)),
        (f"{name}: bytes of a move", f"{size / (len(times) + FIRST) / 1000:.0f} kB"),
        (f"{name}: draw calls of a frame", f"{statistics.median(n for _, n in frames):.0f}"),
        (f"{name}: time between frames, software GL", _spread(gaps)),
    ]


def _serve(told: Path) -> None:
    """Serve until interrupted, then write the time of every move [ms]."""
    from morphgen.viewer.app.app import serve
    from morphgen.viewer.pages.robot import RobotPage
    from morphgen.viewer.scene.population import PopulationScene

    times: dict[str, list[float]] = {"robot": [], "population": []}

    def timed(work: Callable[..., None], into: list[float]) -> Callable[..., None]:
        def call(*arguments: object) -> None:
            begun = time.perf_counter()
            work(*arguments)
            into.append(1e3 * (time.perf_counter() - begun))

        return call

    update_scene = timed(RobotPage.update_scene, times["robot"])
    move = timed(PopulationScene.move, times["population"])
    with (
        patch.object(RobotPage, "update_scene", update_scene),
        patch.object(PopulationScene, "move", move),
    ):
        viewer = serve()
        print(f"http://127.0.0.1:{viewer.port}", flush=True)
        with suppress(KeyboardInterrupt):
            viewer.server.sleep_forever()
        viewer.stop()
    told.write_text(json.dumps({name: values[FIRST:] for name, values in times.items()}))


def wait_until_tested(page: Any) -> None:  # noqa: ANN401
    """Wait until the page of a robot knows its collisions."""
    tested = page.get_by_text("no self-collision").or_(page.get_by_text("collision", exact=True))
    tested.first.wait_for()


if __name__ == "__main__":
    sys.exit(main())
