"""Put frames of a film side by side, one row per part of it.

    python docs/film_strip.py push.mp4 strip.png [--frames 6] [--rows 0:96,96:288]

Rows are ranges of frames; by default there is one row with the whole film.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from PIL import Image

WIDTH = 1280
"""Width of the picture [pixels]."""


def main() -> None:
    """Read the film and write the picture."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("film", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--frames", type=int, default=6)
    parser.add_argument("--rows", default="")
    args = parser.parse_args()
    film = iio.imread(args.film)
    ranges = [tuple(map(int, part.split(":"))) for part in args.rows.split(",") if part]
    rows = []
    for first, last in ranges or [(0, len(film))]:
        chosen = np.linspace(first, last - 1, args.frames).round().astype(int)
        rows.append(np.concatenate([film[i] for i in chosen], axis=1))
    sheet = Image.fromarray(np.concatenate(rows))
    height = round(sheet.height * WIDTH / sheet.width)
    sheet.resize((WIDTH, height), Image.Resampling.LANCZOS).quantize(128).save(args.picture)
    print(args.picture)


if __name__ == "__main__":
    main()
