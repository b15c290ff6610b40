"""Upper bound of one-primitive fits: compare our fit with brute force from random starts.

    python benchmarks/fit_ceiling.py [--only ur5,panda] [--starts 300] [--jobs 2] [--json rows.json]
    python benchmarks/fit_ceiling.py --points links.npz --draw          # writes the point clouds
    python benchmarks/fit_ceiling.py --points links.npz --device cuda   # needs only NumPy and torch

For each distinct link of the arms, the script draws boxes, cylinders and spheres of random
position, rotation and size. Gradient ascent raises their intersection over union (IoU) with the
link's solid in three rounds; later rounds keep the best candidates and use more points. The script
shares no initial guesses and no optimisation code with the fitter. The best candidate and our fit
are then measured on the same new points, so their difference is more precise than the two values.

Columns: IoU and kind of our fit; IoU and kind of the best candidate; the difference; the number of
candidates of the last round within 0.002 of the best (a large number means that more starts would
not help); the best IoU of each kind.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, fields
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from tabulate import tabulate
from torch import Tensor
from tqdm import tqdm

if TYPE_CHECKING:
    from morphgen.model.geometry import Shape

KINDS = ("box", "cylinder", "sphere")
FRESH_SEEDS = (101, 102, 103, 104)
"""Seeds of the points that measure a fit; each draws as many points as a search uses."""
NEAR_BEST = 0.002
HEADERS = ("link", "ours", "kind", "best", "kind", "more", "ends there", *KINDS)


@dataclass(frozen=True)
class Round:
    """Settings of one round of gradient ascent."""

    candidates: int | None
    """Number of candidates to optimise, the best ones of the previous round; None for all."""
    points: int
    steps: int
    softness: tuple[float, float]
    """Width of a primitive's soft surface at the first and last step [sizes of the solid]."""
    rate: tuple[float, float]
    """Learning rate at the first and last step [sizes of the solid]."""


ROUNDS = (
    Round(None, 1024, 80, (0.06, 0.015), (0.03, 0.008)),
    Round(60, 4096, 100, (0.015, 0.004), (0.008, 0.002)),
    Round(6, 2**20, 120, (0.004, 0.001), (0.003, 0.0002)),
)


@dataclass(frozen=True, eq=False)
class Target:
    """A link's solid as points, in its own frame and in units of its size, and our fit."""

    names: NDArray[np.str_]
    """``arm/link`` of all links with these meshes."""
    points: NDArray[np.float32]
    """Points for the optimisation, in random order, shape (n, 3)."""
    inside: NDArray[np.bool_]
    weights: NDArray[np.float32]
    fresh_points: NDArray[np.float32]
    """Points for the final measurement, shape (m, 3)."""
    fresh_inside: NDArray[np.bool_]
    fresh_weights: NDArray[np.float32]
    kind: NDArray[np.int64]
    """Kind of our fit as an index into ``KINDS``, shape ()."""
    placed: NDArray[np.float32]
    """Our fit as centre, quaternion and half extents, shape (1, 10)."""


@dataclass(frozen=True)
class Cloud:
    """A target's points on a device."""

    points: Tensor
    inside: Tensor
    weights: Tensor

    def first(self, n: int) -> Cloud:
        """Return the first points."""
        return Cloud(self.points[:n], self.inside[:n], self.weights[:n])


@dataclass(frozen=True)
class Ceiling:
    """Result of brute force for one link."""

    names: tuple[str, ...]
    kind: str
    ours: float
    best_kind: str
    best: float
    near_best: int
    of_kind: tuple[float, ...]

    def row(self) -> list[object]:
        """Return the row of the table."""
        more = self.best - self.ours
        ends = f"{self.near_best} of {ROUNDS[-1].candidates}"
        found = [self.ours, self.kind, self.best, self.best_kind, more, ends, *self.of_kind]
        return [" ".join(self.names), *found]


def main() -> int:
    """Search all links and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="", help="parts of arm/link, separated by commas")
    parser.add_argument("--starts", type=int, default=300, help="of each kind")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--points", type=Path, help="file of the links' points, see --draw")
    parser.add_argument("--draw", action="store_true", help="only write the file of points")
    parser.add_argument("--json", type=Path, help="also write a row a link here")
    args = parser.parse_args()
    if args.draw and not args.points:
        parser.error("--draw needs --points: the file to write")
    words = [word for word in args.only.split(",") if word]
    if args.points and not args.draw:
        targets = _read(args.points, words)
    else:
        targets = _drawn(words, args.jobs)
    if not targets:
        parser.error(f"no link's arm/link contains any of: {', '.join(words)}")
    if args.draw:
        _write(args.points, targets)
        return 0
    climb = partial(ceiling, starts=args.starts, seed=args.seed, device=args.device)
    with ProcessPoolExecutor(args.jobs, get_context("spawn"), _one_thread) as pool:
        done = list(tqdm(pool.map(climb, targets), total=len(targets), unit="link"))
    if args.json:
        rows = [asdict(each) for each in done]
        args.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    print(tabulate([each.row() for each in done], HEADERS, floatfmt=".3f"))
    by_arm: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for each in done:
        for name in each.names:
            by_arm[name.split("/")[0]].append((each.ours, each.best))
    means = [(arm, *np.mean(pairs, axis=0).tolist()) for arm, pairs in by_arm.items()]
    means.append(("mean of these arms", *np.mean([row[1:] for row in means], axis=0).tolist()))
    table = [(*row, row[2] - row[1]) for row in means]
    print(tabulate(table, ("arm", "ours", "best", "more"), floatfmt=".3f"))
    return 0


def ceiling(target: Target, *, starts: int, seed: int, device: str) -> Ceiling:
    """Search one link by brute force.

    Args:
        target: Points of the link's solid, and our fit.
        starts: Number of random candidates of each kind.
        seed: Seed of the candidates.
        device: Name of the torch device.
    """
    cloud = _cloud(target.points, target.inside, target.weights, device)
    fresh = _cloud(target.fresh_points, target.fresh_inside, target.fresh_weights, device)
    rng = np.random.default_rng(seed)
    ends: list[tuple[float, float, int]] = []
    for kind in range(len(KINDS)):
        placed = _climbed(kind, _random(cloud, starts, rng), cloud)
        seen, worth = (_counted(kind, placed, each).tolist() for each in (cloud, fresh))
        ends += zip(seen, worth, [kind] * len(seen), strict=True)
    # The choice is made on the points of the climb, so that it cannot flatter the fresh count.
    _, best, best_kind = max(ends)
    at = torch.from_numpy(target.placed).to(device)
    return Ceiling(
        tuple(target.names.tolist()),
        KINDS[int(target.kind)],
        float(_counted(int(target.kind), at, fresh)[0]),
        KINDS[best_kind],
        best,
        sum(worth > best - NEAR_BEST for _, worth, kind in ends if kind == best_kind),
        tuple(max(end for end in ends if end[2] == kind)[1] for kind in range(len(KINDS))),
    )


def _random(cloud: Cloud, n: int, rng: np.random.Generator) -> Tensor:
    """Draw centres in the bounding box, uniform rotations and log-uniform half extents: (n, 10)."""
    body = cloud.points[cloud.inside]
    low, high = body.amin(dim=0), body.amax(dim=0)
    centres = low + (high - low) * torch.from_numpy(rng.random((n, 3))).to(low)
    quaternions = torch.from_numpy(rng.normal(size=(n, 4))).to(low)
    halves = torch.from_numpy(np.exp(rng.uniform(np.log(0.05), np.log(0.5), (n, 3)))).to(low)
    return torch.cat([centres, quaternions, halves], dim=1)


def _climbed(kind: int, placed: Tensor, cloud: Cloud) -> Tensor:
    for each in ROUNDS:
        if each.candidates is not None:
            score = _counted(kind, placed, cloud)
            placed = placed[torch.argsort(score, descending=True, stable=True)[: each.candidates]]
        placed = _ascended(kind, placed, cloud.first(each.points), each)
    return placed


def _ascended(kind: int, placed: Tensor, cloud: Cloud, how: Round) -> Tensor:
    """Return the candidates, shape (n, 10), after the gradient steps of a round."""
    centres, quaternions, halves = (part.clone() for part in _parts(placed))
    quaternions /= quaternions.norm(dim=1, keepdim=True)
    logs = halves.log()
    moved = [part.requires_grad_() for part in (centres, quaternions, logs)]
    # A turn by an angle, and a change of a logarithm, move a surface by about a quarter of a size.
    optimiser = torch.optim.Adam([{"params": [part]} for part in moved], betas=(0.8, 0.98))
    wanted = cloud.inside.to(cloud.weights) * cloud.weights
    for step in range(how.steps):
        part = step / max(how.steps - 1, 1)
        softness, rate = (a * (b / a) ** part for a, b in (how.softness, how.rate))
        for group, unit in zip(optimiser.param_groups, (1.0, 2.0, 4.0), strict=True):
            group["lr"] = unit * rate
        optimiser.zero_grad()
        member = torch.sigmoid(
            -_distance(kind, centres, quaternions, logs.exp(), cloud.points) / softness
        )
        both, own = member @ wanted, member @ cloud.weights
        torch.autograd.backward(-(both / (own + wanted.sum() - both)).sum())
        optimiser.step()
    with torch.no_grad():
        return torch.cat([centres, quaternions, logs.exp()], dim=1)


@torch.no_grad()
def _counted(kind: int, placed: Tensor, cloud: Cloud) -> Tensor:
    """Return the intersection over union of candidates (n, 10), shape (n,)."""
    found = []
    for start in range(0, len(placed), 16):
        member = _distance(kind, *_parts(placed[start : start + 16]), cloud.points) <= 0
        both, either = (
            (each.double() @ cloud.weights.double())
            for each in (member & cloud.inside, member | cloud.inside)
        )
        found.append(both / either)
    return torch.cat(found)


def _parts(placed: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Split candidates into centres, quaternions and half extents."""
    return placed[:, :3], placed[:, 3:7], placed[:, 7:]


def _distance(
    kind: int, centres: Tensor, quaternions: Tensor, halves: Tensor, points: Tensor
) -> Tensor:
    """Return the signed distances of points (m, 3) to n primitives of a kind, shape (n, m)."""
    x, y, z = ((points - centres[:, None]) @ _rotations(quaternions)).unbind(dim=2)
    a, b, c = halves[:, :, None].unbind(dim=1)
    match KINDS[kind]:
        case "box":
            beyond = torch.stack([x.abs() - a, y.abs() - b, z.abs() - c])
        case "cylinder":
            beyond = torch.stack([(x * x + y * y + 1e-12).sqrt() - a, z.abs() - c])
        case _:
            return (x * x + y * y + z * z + 1e-12).sqrt() - a
    outside = (beyond.clamp(min=0).square().sum(dim=0) + 1e-16).sqrt()
    return outside + beyond.amax(dim=0).clamp(max=0)


def _rotations(quaternions: Tensor) -> Tensor:
    """Return rotation matrices (n, 3, 3) of quaternions (w, x, y, z) of any norm."""
    unit = quaternions / quaternions.norm(dim=1, keepdim=True)
    w, v = unit[:, :1, None], unit[:, None, 1:]
    eye = torch.eye(3).to(v)
    cross = torch.linalg.cross(eye.expand(len(v), 3, 3), v.expand(len(v), 3, 3), dim=2)
    turned: Tensor = eye + 2 * w * cross + 2 * cross @ cross
    return turned


def _cloud(
    points: NDArray[np.float32],
    inside: NDArray[np.bool_],
    weights: NDArray[np.float32],
    device: str,
) -> Cloud:
    return Cloud(*(torch.from_numpy(array).to(device) for array in (points, inside, weights)))


def _one_thread() -> None:
    torch.set_num_threads(1)


def _drawn(words: Sequence[str], jobs: int) -> list[Target]:
    # Imported here, so that a file of points can be searched where the library is not installed.
    from fit_quality import FOUR, link_tasks
    from morphgen.formats.fits import shapes_key

    names: dict[str, list[str]] = defaultdict(list)
    shapes = {}
    for task in link_tasks(set(FOUR)):
        key = shapes_key(task.shapes)
        names[key].append(f"{task.arm}/{task.link}")
        shapes[key] = task.shapes
    wanted = [key for key in names if _meant(names[key], words)]
    with ProcessPoolExecutor(jobs, get_context("spawn"), _one_thread) as pool:
        drawn = pool.map(_target, [names[key] for key in wanted], [shapes[key] for key in wanted])
        return list(tqdm(drawn, total=len(wanted), unit="link drawn"))


def _target(names: list[str], shapes: tuple[Shape, ...]) -> Target:
    from morphgen.fitting.search import best_single, sample_solid
    from morphgen.fitting.solid import solid_of

    solid = solid_of(shapes)
    seen = sample_solid(solid, 0)
    fit = best_single(seen).candidate
    fresh = [sample_solid(solid, seed) for seed in FRESH_SEEDS]
    return Target(
        np.array(names),
        seen.points.astype(np.float32),
        seen.inside,
        seen.weights.astype(np.float32),
        np.concatenate([each.points for each in fresh], dtype=np.float32),
        np.concatenate([each.inside for each in fresh]),
        np.concatenate([each.weights for each in fresh], dtype=np.float32),
        fit.kinds[0, 0],
        np.concatenate([fit.centres[0], fit.quaternions[0], fit.halves[0]], 1, dtype=np.float32),
    )


def _meant(names: Sequence[str], words: Sequence[str]) -> bool:
    return not words or any(word in name for word in words for name in names)


def _write(path: Path, targets: Sequence[Target]) -> None:
    arrays = {
        f"{i}/{field.name}": getattr(target, field.name)
        for i, target in enumerate(targets)
        for field in fields(Target)
    }
    np.savez_compressed(path, **arrays)


def _read(path: Path, words: Sequence[str]) -> list[Target]:
    with np.load(path) as arrays:
        count = len({name.split("/")[0] for name in arrays})
        found = [
            Target(*(arrays[f"{i}/{field.name}"] for field in fields(Target))) for i in range(count)
        ]
    return [target for target in found if _meant(target.names.tolist(), words)]


if __name__ == "__main__":
    sys.exit(main())
