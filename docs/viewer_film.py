"""Film the way from a gallery to a split in the viewer: python docs/viewer_film.py [--out FILE].

Opens the gallery of a set of 24 arm3 in headless chromium, chooses three, compares them, edits one
in Compose, writes the result to a folder, and makes a split of it and the chosen three. Each state
of the page is shown for a second or two.
Needs `pip install morphgen[test]` and chromium.
"""

from __future__ import annotations

import argparse
import io
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from viewer_pictures import WAIT, hide_notice, served

from morphgen.tasks.renderer import Frame, write_video
from viewer_speed import started_browser

SIZE = (1280, 800)
"""Size of the browser's window [pixels]."""
FILM_SIZE = (960, 600)
"""Size of a frame [pixels]."""
FPS = 2
HOLD = 3
"""Frames of each state of the page."""
SETTLE = 4000
"""Time until a change is drawn in software [ms]."""
OUT = Path(__file__).parent / "images" / "viewer" / "workflow.gif"


def main() -> int:
    """Write the film."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=OUT, help=".gif or .mp4")
    out = parser.parse_args().out.resolve()
    with served(24) as address, started_browser() as browser:
        page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
        page.set_default_timeout(WAIT)
        frames = [frame for state in states(page, address) for frame in HOLD * [shot(page, state)]]
    write_video(frames, out, FPS)
    print(f"{out}: {len(frames)} frames, {out.stat().st_size / 1000:.0f} kB")
    return 0


def states(page: Any, address: str) -> Iterator[str]:  # noqa: ANN401
    """Work with the page; yield a word for each state that the film shows."""
    tray = page.locator("#morphgen-tray")
    page.goto(f"{address}?gallery=robots/arm3&sort=-reach")
    page.locator("#morphgen-cover").wait_for(state="detached")
    page.wait_for_function("!document.querySelector('.card:not(:has(img))')")
    yield "gallery"
    for i in (0, 9, 15):
        page.locator("input[data-choose]").nth(i).click()
    tray.get_by_text("3 chosen").wait_for()
    yield "three are chosen"
    tray.get_by_text("compare").click()
    page.get_by_text("Similarity").first.wait_for()
    yield "compared"
    page.go_back()
    page.locator("a.card").nth(9).click()
    page.get_by_role("link", name="Edit in Compose").wait_for()
    yield "one of them"
    page.get_by_role("link", name="Edit in Compose").click()
    page.get_by_text("DoF").first.wait_for()
    yield "in Compose"
    slider = page.get_by_role("slider").first
    slider.focus()
    for _ in range(60):
        slider.press("ArrowRight")
    page.get_by_text(re.compile("changed: ")).first.wait_for()
    yield "edited"
    page.get_by_role("tab", name="Get").click()
    page.get_by_role("button", name="Write to robots/").click()
    page.get_by_text("Written", exact=True).wait_for()
    yield "written to a folder"
    page.locator("#morphgen-bar").get_by_role("link", name="Gallery", exact=True).click()
    page.get_by_role("link", name="robots", exact=True).click()
    page.locator(".card img").first.wait_for()
    page.locator("input[data-choose]").first.click()
    tray.get_by_text("4 chosen").wait_for()
    yield "chosen as well"
    tray.get_by_text("split").click()
    page.get_by_text("test (1)").wait_for()
    name = page.get_by_text("split name", exact=True)
    name.locator("xpath=ancestor::*[.//input][1]//input").last.fill("mine/longer")
    yield "three to train on, one to test on"
    page.get_by_role("button", name="Save").click()
    page.get_by_text("morphgen split audit splits/mine/longer.yaml").wait_for()
    yield "a split"


def shot(page: Any, state: str) -> Frame:  # noqa: ANN401
    """Return a picture of the page, shape (height, width, 3)."""
    page.wait_for_timeout(SETTLE)
    hide_notice(page)
    image = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    print(state, flush=True)
    return np.asarray(image.resize(FILM_SIZE, Image.Resampling.LANCZOS))


if __name__ == "__main__":
    sys.exit(main())
