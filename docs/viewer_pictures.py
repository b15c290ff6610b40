"""Take pictures of the viewer's pages: python docs/viewer_pictures.py [PAGE ...] [--out FOLDER].

Serves a set of 200 arm3, and opens each page in headless chromium in two sizes, light and dark. The
pictures go to FOLDER as PAGE-WIDTH-THEME.png, and the light ones of 1440 x 900 pixels, with 256
colours, to docs/images/viewer. Needs `pip install morphgen[test]` and chromium.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import chdir, contextmanager
from pathlib import Path
from typing import Any

from PIL import Image

from morphgen.viewer.app.app import serve

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
from viewer_speed import started_browser

PAGES = {
    "library": ("?library=", ".card img"),
    "gallery": ("?gallery=robots/arm3&sort=-reach", ".card img"),
    "population": ("?population=robots/arm3&arrange=reach&select=0-40", "text=41 selected"),
    "robot": (
        "?robot=words:arm=panda ee=panda_hand&show=x-ray,frames,joint axes,names&tab=Show",
        "text=joint axes",
    ),
    "compose": (
        "?compose=base=pedestal left.arm=ur5 left.ee=robotiq_2f85 right.arm=xarm7 "
        "right.ee=panda_hand",
        "text=open its page",
    ),
    "compare": (
        "?compare=words:arm=panda ee=panda_hand&compare=words:arm=ur5 ee=robotiq_2f85"
        "&compare=words:arm=xarm7 ee=stick",
        "text=Similarity",
    ),
    "split": ("?split=extrapolation/arms/reach&tab=Map", "svg image"),
    "play": (
        "?play=push&robot=words:arm=ur5 ee=plane&robot=words:arm=panda ee=plane"
        "&robot=words:arm=xarm7 ee=plane&robot=words:arm=lwr ee=plane&policy=scripted&seed=1",
        "text=/simulated: [1-9]/",
    ),
}
"""Address of each page, and what it shows when it is complete."""
SIZES = ((1440, 900), (1024, 700))
"""Sizes of the browser's window [pixels]."""
THEMES = ("light", "dark")
ROBOTS = 200
SETTLE = 8000
"""Time until pictures are drawn and the light has faded in [ms]."""
WAIT = 240_000
"""Longest time to wait for a page [ms]."""
IMAGES = Path(__file__).parent / "images" / "viewer"


def main() -> int:
    """Take the pictures of the named pages, or all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pages", nargs="*", metavar="PAGE", help=", ".join(PAGES))
    parser.add_argument("--out", type=Path, default=Path("build/viewer"), help="folder")
    args = parser.parse_args()
    names = args.pages or list(PAGES)
    if unknown := sorted(set(names) - PAGES.keys()):
        parser.error(f"unknown page: {', '.join(unknown)}; expected {', '.join(PAGES)}")
    args.out.mkdir(parents=True, exist_ok=True)
    out = args.out.resolve()
    with served(ROBOTS) as address, started_browser() as browser:
        for name in names:
            for size in SIZES:
                for theme in THEMES:
                    path = out / f"{name}-{size[0]}-{theme}.png"
                    take(browser, address, name, size, theme, path)
            shrink(out / f"{name}-{SIZES[0][0]}-{THEMES[0]}.png", IMAGES / f"{name}.png")
    return 0


@contextmanager
def served(robots: int) -> Iterator[str]:
    """Serve a temporary folder with a set of robots; return the address."""
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        words = ("sample", "arm3", "-n", str(robots), "--no-picture", "--out", "robots/arm3")
        subprocess.run([sys.executable, "-m", "morphgen", *words], check=True)
        viewer = serve(port=0)
        yield f"http://127.0.0.1:{viewer.port}/"
        viewer.stop()


def take(
    browser: Any,  # noqa: ANN401
    address: str,
    name: str,
    size: tuple[int, int],
    theme: str,
    path: Path,
) -> None:
    """Write a picture of a page."""
    query, content = PAGES[name]
    width, height = size
    context = browser.new_context(viewport={"width": width, "height": height})
    context.set_default_timeout(WAIT)
    page = context.new_page()
    page.goto(f"{address}{query}&theme={theme}")
    page.locator("#morphgen-cover").wait_for(state="detached")
    page.locator(content).first.wait_for()
    page.wait_for_function("!document.querySelector('.card:not(:has(img))')")
    page.wait_for_timeout(SETTLE)
    hide_notice(page)
    page.screenshot(path=path)
    context.close()
    print(path, flush=True)


def hide_notice(page: Any) -> None:  # noqa: ANN401
    """Remove viser's notice that there is no GPU."""
    page.evaluate("""for (const note of document.querySelectorAll(".mantine-Notification-root"))
        if (note.textContent.includes("Software WebGL")) note.remove();""")


def shrink(source: Path, target: Path) -> None:
    """Write a picture with 256 colours."""
    image = Image.open(source).convert("RGB")
    few = image.quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=3, dither=Image.Dither.NONE)
    few.save(target, optimize=True)
    print(f"{target}: {target.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    sys.exit(main())
