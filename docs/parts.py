"""Write ``parts.md``, the catalogue of arms, end-effectors and objects, and draw their pictures.

    python docs/parts.py [PART ...]

With names of parts, only their pictures are drawn, and those of parts that have none.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

from PIL import Image
from tqdm import tqdm

import morphgen
from morphgen.grammar.catalogue import catalogue
from morphgen.grammar.library import default_library

PAGE = Path(__file__).with_name("parts.md")
PICTURES = Path(__file__).parent / "images" / "parts"
MARK = "<!-- The rest of this page is written by docs/parts.py. -->\n"
KINDS = {"arm": "Arms", "ee": "End-effectors", "object": "Objects"}
"""Kinds of parts that the page shows, and the titles of their sections."""
SIZE = (200, 150)
"""Width and height of a picture [px]."""
PALETTE = 64
"""Number of colours of a picture."""


def page() -> str:
    """Return the page: its own text up to the mark, then a table for each kind."""
    text, mark, _ = PAGE.read_text(encoding="utf-8").partition(MARK)
    return text + mark + "\n".join(tables()) + "\n"


def tables() -> Iterator[str]:
    """Yield the lines of the sections."""
    for kind, title in KINDS.items():
        yield f"\n## {title}\n"
        yield "| part | joints | reach [m] | licence |"
        yield "|---|---|---|---|"
        for row in shown_parts(kind):
            name = row["name"]
            summary = re.sub(r", \d+ DoF", "", str(row["summary"]))
            template = ", template" if row["source"] == "template" else ""
            yield (
                f"| ![{name}](images/parts/{name}.png)<br>`{name}`<br>{summary} | {row['dof']} "
                f"| {row['reach']:.2f} | {row['licence']}{template} |"
            )


def shown_parts(kind: str) -> list[dict[str, object]]:
    """Return the catalogue's rows of a kind of parts, without the part that is nothing."""
    rows = catalogue(default_library(), kind)
    return [row for row in rows if row["name"] != "none"]


def draw(kind: str, name: str) -> None:
    """Draw a part alone, at its home configuration."""
    with tempfile.TemporaryDirectory() as folder:
        bundle = morphgen.write(morphgen.compose(f"{kind}={name}"), folder)
        picture = Image.open(bundle / "preview.png").convert("RGB")
    picture = picture.resize(SIZE, Image.Resampling.LANCZOS).quantize(PALETTE)
    PICTURES.mkdir(exist_ok=True)
    picture.save(PICTURES / f"{name}.png", optimize=True)


def main() -> None:
    """Draw the pictures that are named or missing, and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", metavar="PART")
    names = parser.parse_args().parts
    parts = {str(row["name"]): kind for kind in KINDS for row in shown_parts(kind)}
    if unknown := set(names) - set(parts):
        parser.error(f"unknown parts: {', '.join(sorted(unknown))}; see morphgen list")
    missing = [name for name in parts if not (PICTURES / f"{name}.png").is_file()]
    for name in tqdm(sorted({*names, *missing}), "drawing"):
        draw(parts[name], name)
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
