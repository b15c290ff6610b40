"""Draw the pictures of robots for the docs: python docs/pictures.py [robots|panda_variations]."""

from __future__ import annotations

import math
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from PIL import Image

import morphgen
from morphgen.grammar.library import default_library
from morphgen.model.robot import Robot
from morphgen.splits.split import compose_member, read_split

REQUESTS = (
    "arm=ur5 ee=plane",
    "arm=panda ee=robotiq_2f85 ee.mount_yaw=45deg",
    "base=pedestal left.arm=ur5 left.ee=stick right.arm=xarm7 right.ee=panda_hand",
    "arm=yumi left.ee=yumi_gripper right.ee=yumi_gripper",
    "arm=kinova_gen3 ee=allegro",
    "base=gantry ee=plane ee.size=0.3",
)
COLUMNS = 3
TILE = (480, 360)


def robots() -> list[Robot]:
    """Return the robots of the README."""
    return [morphgen.compose(request) for request in REQUESTS]


def panda_variations() -> list[Robot]:
    """Return six of the train robots of interpolation/panda."""
    library = default_library()
    members = read_split("interpolation/panda/reach").train[:6]
    return [compose_member(member, library) for member in members]


SHEETS: tuple[Callable[[], list[Robot]], ...] = (robots, panda_variations)


def main() -> None:
    """Draw the named pictures, or all."""
    names = sys.argv[1:]
    for sheet in SHEETS:
        if not names or sheet.__name__ in names:
            draw(sheet(), Path(__file__).parent / "images" / f"{sheet.__name__}.png")


def draw(robots: list[Robot], target: Path) -> None:
    """Paste the previews of robots into one picture, in rows of ``COLUMNS``."""
    rows = math.ceil(len(robots) / COLUMNS)
    picture = Image.new("RGB", (COLUMNS * TILE[0], rows * TILE[1]), "white")
    with tempfile.TemporaryDirectory() as scratch:
        for i, robot in enumerate(robots):
            folder = morphgen.write(robot, scratch)
            tile = Image.open(folder / "preview.png").resize(TILE, Image.Resampling.LANCZOS)
            picture.paste(tile, (i % COLUMNS * TILE[0], i // COLUMNS * TILE[1]))
    picture.quantize(256).save(target, optimize=True)
    print(target)


if __name__ == "__main__":
    main()
