"""Draw the README's picture: python docs/pictures.py."""

from __future__ import annotations

import tempfile
from pathlib import Path

from PIL import Image

import morphgen

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


def main() -> None:
    """Compose every request and paste the previews into one picture."""
    rows = -(-len(REQUESTS) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * TILE[0], rows * TILE[1]), "white")
    with tempfile.TemporaryDirectory() as scratch:
        for i, request in enumerate(REQUESTS):
            folder = morphgen.write(morphgen.compose(request), scratch)
            tile = Image.open(folder / "preview.png").resize(TILE, Image.Resampling.LANCZOS)
            sheet.paste(tile, (i % COLUMNS * TILE[0], i // COLUMNS * TILE[1]))
    target = Path(__file__).parent / "images" / "robots.png"
    sheet.quantize(256).save(target, optimize=True)
    print(target)


if __name__ == "__main__":
    main()
