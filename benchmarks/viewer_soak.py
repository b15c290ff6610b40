"""Memory of the viewer's server while browsers use it for an hour.

    python benchmarks/viewer_soak.py [--minutes 60] [--robots 100]

Serves a sampled set of arm3 with `morphgen view`. Round after round a new headless browser opens
the library, a gallery, a robot from a card, Back, the population, a comparison, a robot of
a grammar in Compose, a split and a rollout of reach, and closes; every second one while it loads
another page.
Prints after every tenth of the time the resident memory of the server and of its worker processes,
and the server's threads and open files (Linux). The exit code is 1 if the server's memory grows by
more than a tenth between half of the time and the end.

Needs `pip install morphgen[test]` and chromium.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from tabulate import tabulate

from viewer_speed import (
    MORPHGEN,
    opened_page,
    resident,
    sample,
    started_browser,
    started_viewer,
    wait_for_cards,
    wait_until_tested,
)

ROWS = 10
"""Rows of the printed table after the first."""
GROWTH = 1.1
"""Largest accepted ratio of the memory at the end to the memory at half of the time."""
HEADER = ("minute", "rounds", "server MB", "workers MB", "threads", "open files")
Row = tuple[float, int, int, int, int, int]


def main() -> int:
    """Use the viewer and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--robots", type=int, default=100)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch, started_browser() as browser:
        folder = Path(scratch)
        os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
        sample(folder, "arm3", args.robots, "--no-picture")
        with started_viewer([*MORPHGEN, "view"], folder) as (address, _, process):
            rows = _use(browser, address, process, 60 * args.minutes)
    print(tabulate(rows, HEADER, floatfmt=".1f"))
    middle, end = rows[len(rows) // 2][2], rows[-1][2]
    return int(end > GROWTH * middle)


def _use(browser: Any, address: str, process: int, seconds: float) -> list[Row]:  # noqa: ANN401
    """Use the viewer round after round; return what the server needs, from the first page on."""
    rows: list[Row] = []
    begun, rounds = time.monotonic(), 0
    with opened_page(browser) as page:
        page.goto(address)
        wait_for_cards(page)
    while True:
        elapsed = time.monotonic() - begun
        if elapsed >= len(rows) * seconds / ROWS:
            rows.append(_needs(process, elapsed / 60, rounds))
            print(*rows[-1], file=sys.stderr, flush=True)
        if elapsed >= seconds:
            return rows
        with opened_page(browser) as page:
            _round(page, address)
            if rounds % 2:
                page.goto(f"{address}/?robot=words:arm=panda ee=panda_hand&show=visual,workspace")
        rounds += 1


def _round(page: Any, address: str) -> None:  # noqa: ANN401
    """Go once through the pages."""
    page.goto(address)
    wait_for_cards(page)
    bar = page.locator("#morphgen-bar")
    page.goto(f"{address}/?gallery=robots/arm3")
    wait_for_cards(page)
    page.locator("a.card").nth(3).click()
    wait_until_tested(page)
    page.go_back()
    wait_for_cards(page)
    bar.get_by_role("link", name="Population", exact=True).click()
    page.get_by_text("no robot is selected").wait_for()
    page.goto(f"{address}/?compare=robots/arm3/arm3-000001&compare=robots/arm3/arm3-000002")
    page.get_by_text("Similarity").first.wait_for()
    page.goto(f"{address}/?compose=arm3&seed=0&number=1")
    page.get_by_text("open its page").wait_for()
    page.goto(f"{address}/?split=interpolation/arm3/reach")
    page.get_by_role("tab").first.wait_for()
    page.goto(f"{address}/?play=reach&robot=words:arm=arm3 ee=stick&policy=jacobian")
    page.get_by_role("button", name="New episode").wait_for()


def _needs(process: int, minute: float, rounds: int) -> Row:
    """Return the row of the table for the present state of the server."""
    own = Path(f"/proc/{process}")
    children = (own / f"task/{process}/children").read_text().split()
    for task in (own / "task").iterdir():
        children += (task / "children").read_text().split()
    workers = sum(resident(int(child)) for child in set(children))
    return (
        minute,
        rounds,
        round(resident(process) / 2**20),
        round(workers / 2**20),
        len(list((own / "task").iterdir())),
        len(list((own / "fd").iterdir())),
    )


if __name__ == "__main__":
    sys.exit(main())
