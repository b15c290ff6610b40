"""Draw every real arm next to the same arm with its fitted primitives.

    python docs/fit_pictures.py [--only panda,ur5] [--out docs/images/fit]
    python docs/fit_pictures.py --only panda,ur5 --spheres 8 --cover 0.995 --out docs/images/spheres

Left: the visuals. Right: up to four primitives per link in place of its collision meshes, one
colour per link. Both robots are at home, under the same camera. The mean intersection over union is
over links with collision meshes; links whose source has primitives keep them. Stored fits are used;
links without a stored fit are fitted now. With `--spheres`, the right side has that number of
spheres for each link.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont
from tqdm import tqdm

import morphgen
from morphgen.fitting.link_fit import FitOptions
from morphgen.fitting.replace_collision import as_primitives, with_primitives
from morphgen.fitting.robot_fit import fit_links
from morphgen.formats.bundle import MJCF, split_colours, write_bundle
from morphgen.formats.fits import are_primitives, shapes_key
from morphgen.formats.picture import render
from morphgen.grammar.library import Library, default_library
from morphgen.model.geometry import Rgba, Shape
from morphgen.model.robot import Robot

SIZE = (900, 450)
TITLE = 40
"""Height of the title [px]."""
PALETTE = 128
"""Number of colours of a picture."""
COLOURS: tuple[Rgba, ...] = (
    (0.12, 0.47, 0.71, 1.0),
    (1.00, 0.50, 0.05, 1.0),
    (0.17, 0.63, 0.17, 1.0),
    (0.84, 0.15, 0.16, 1.0),
    (0.58, 0.40, 0.74, 1.0),
    (0.95, 0.80, 0.15, 1.0),
    (0.09, 0.75, 0.81, 1.0),
    (0.89, 0.47, 0.76, 1.0),
)


def main() -> int:
    """Draw the pictures and print their paths."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", help="names of arms, separated by commas")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "images" / "fit")
    parser.add_argument("--spheres", type=int, help="spheres per link, in place of primitives")
    parser.add_argument("--cover", type=float, help="share of each link that they cover")
    args = parser.parse_args()
    options = None
    if args.spheres is not None:
        options = FitOptions(spheres=args.spheres, cover=args.cover)
    library = default_library()
    names = _names(library, args.only)
    args.out.mkdir(parents=True, exist_ok=True)
    for name in tqdm(names, unit="arm", file=sys.stderr):
        picture = _picture(name, library, options)
        picture.quantize(PALETTE, kmeans=1, dither=Image.Dither.NONE).save(
            args.out / f"{name}.png", optimize=True
        )
        tqdm.write(str(args.out / f"{name}.png"))
    return 0


def _names(library: Library, only: str | None) -> list[str]:
    if only:
        return [library.manifest(name, "arm").name for name in only.split(",")]
    return [m.name for m in library.manifests("arm") if not m.is_template and not m.scaling]


def _picture(name: str, library: Library, options: FitOptions | None) -> Image.Image:
    robot = morphgen.compose(f"arm={name}")
    if options is None:
        primitives, ious = _fitted(robot, library)
    else:
        report = fit_links(robot, options)
        primitives = {row.link: row.fit.primitives for row in report.links}
        ious = [row.fit.quality.iou for row in report.links]
    fitted = _coloured(with_primitives(robot, primitives))
    sheet = Image.new("RGB", SIZE, "white")
    size = (SIZE[0] // 2, SIZE[1] - TITLE)
    for i, half in enumerate(_halves(robot, fitted, size)):
        sheet.paste(half, (i * size[0], TITLE))
    count = sum(len(link.visuals) for link in fitted.links)
    quality = f"mean IoU {sum(ious) / len(ious):.2f}" if ious else "as in its source"
    shapes = "primitives"
    if options is not None:
        shapes = "spheres" if options.cover is None else f"spheres, cover {options.cover:g}"
    draw = ImageDraw.Draw(sheet)
    for i, text in enumerate((name, f"{count} {shapes}, {quality}")):
        draw.text(
            ((i + 0.5) * size[0], TITLE / 2),
            text,
            fill="black",
            anchor="mm",
            font=ImageFont.load_default(20),
        )
    return sheet


def _fitted(robot: Robot, library: Library) -> tuple[dict[str, tuple[Shape, ...]], list[float]]:
    """Return primitives by link, and the IoU of each link that has meshes."""
    fitted = as_primitives(robot, library.folders)
    ious = [
        fitted.fits[shapes_key(new.collisions)].collision_iou
        for old, new in zip(robot.links, fitted.links, strict=True)
        if not are_primitives(old.collisions)
    ]
    return {link.name: link.collisions for link in fitted.links}, ious


def _coloured(robot: Robot) -> Robot:
    """Return the robot with its collision shapes as visuals, one colour per link."""
    links, depths = [], {-1: -1}
    for i, link in enumerate(robot.links):
        depths[i] = depths[robot.parents[i]] + bool(link.collisions)
        rgba = COLOURS[depths[i] % len(COLOURS)]
        shapes = tuple(replace(shape, rgba=rgba) for shape in link.collisions)
        links.append(replace(link, visuals=shapes))
    return robot.with_links(links)


def _halves(left: Robot, right: Robot, size: tuple[int, int]) -> list[Image.Image]:
    """Render both robots with one camera that shows all of either."""
    framed = left.with_links(
        replace(a, visuals=(*a.visuals, *b.visuals))
        for a, b in zip(left.links, right.links, strict=True)
    )
    pictures = []
    with tempfile.TemporaryDirectory() as scratch:
        for i, robot in enumerate((left, right)):
            folder = write_bundle(split_colours(robot), Path(scratch) / str(i), picture=False)
            pictures.append(render(framed, folder / MJCF, size=size))
    return pictures


if __name__ == "__main__":
    sys.exit(main())
