"""Make the goal sets that come with the package: those of the splits that are shipped with it.

    python benchmarks/package_goal_sets.py           # sample all sets, replace the files
    python benchmarks/package_goal_sets.py --sizes   # how large the files are

Run it after a change of robots, fits, tasks or their constants. Sets that are still the same keep
their files. Splits that have a robot at a task in common share the set.
"""

import argparse
import hashlib
import io
import json
import lzma
import sys
from functools import partial
from pathlib import Path

import numpy as np

from morphgen.errors import BenchmarkError
from morphgen.files import write_atomic
from morphgen.grammar.library import Library, default_library
from morphgen.processes import parallel_map
from morphgen.progress import show_progress
from morphgen.splits.split import Member, read_split, sided_members, split_names
from morphgen.tasks.goal_sets import FOLDER, INDEX, packaged_index, set_npz
from morphgen.tasks.scenes.env_specs import GoalConfig, env_spec, member_with_primitives
from morphgen.tasks.split_goals import certify_goal_set

Identity = tuple[str, str, bool]
"""Hash of a robot in splits, its task, and whether there are obstacles."""

_CERTIFICATES = ("behind", "across", "distance", "path")  # of starts, found by inverse kinematics
_ROUNDING = {4: 1e-6, 8: 1e-12}
"""Largest difference of certificates on two processors by bytes of a number [m or rad]."""


def identity(member: Member) -> Identity:
    """Return what distinguishes the goal set of a member from those of other members."""
    return member.robot_hash, member.task, member.obstacles


def shipped_members() -> dict[Identity, Member]:
    """Return the distinct members of all shipped splits."""
    return {identity(member): member for name in split_names() for member in _members(name)}


def _members(name: str) -> list[Member]:
    return [member for _, member in sided_members(read_split(name))]


def write_sets(folder: Path = FOLDER, jobs: int = 1) -> None:
    """Sample and certify the sets of all shipped splits, and write them with their index."""
    members = list(shipped_members().values())
    sample = partial(_sample, default_library(()))
    records: dict[str, dict[str, object]] = {}
    for member, (key, content) in zip(
        members, parallel_map(sample, members, jobs, chunk=1), strict=True
    ):
        file = f"{key[:16]}.npz.xz"
        compressed = lzma.compress(content, preset=9)
        if not _has(folder / file, content):
            folder.mkdir(parents=True, exist_ok=True)
            (folder / file).write_bytes(compressed)
        stored = (folder / file).read_bytes()
        records[key] = {
            "file": file,
            "sha256": hashlib.sha256(stored).hexdigest(),
            "bytes": len(stored),
            "robot": member.robot_hash,
            "task": member.task,
            "obstacles": member.obstacles,
        }
    for path in folder.glob("*.npz.xz"):
        if path.name not in {record["file"] for record in records.values()}:
            path.unlink()
    lines = ",\n".join(f'"{key}": {json.dumps(records[key])}' for key in sorted(records))
    write_atomic(folder / INDEX, f"{{\n{lines}\n}}\n")


def _has(path: Path, content: bytes) -> bool:
    """Return whether a file has this set, whatever version of xz compressed it."""
    return path.is_file() and not set_differences(lzma.decompress(path.read_bytes()), content)


def set_differences(npz: bytes, other: bytes) -> list[str]:
    """Return the arrays in which two sets differ, certificates by more than rounding.

    Processors round the products of inverse kinematics, which found the certificates, apart.
    """
    a, b = (np.load(io.BytesIO(content)) for content in (npz, other))
    if a.files != b.files:
        return sorted({*a.files} ^ {*b.files}) or a.files
    return [
        name
        for name in a.files
        if a[name].tobytes() != b[name].tobytes()
        and not (
            name in _CERTIFICATES
            and a[name].dtype == b[name].dtype
            and a[name].dtype.kind == "f"
            and a[name].shape == b[name].shape
            and np.allclose(a[name], b[name], rtol=0, atol=_ROUNDING[a[name].dtype.itemsize])
        )
    ]


def _sample(library: Library, member: Member) -> tuple[str, bytes]:
    """Return the key and the content of a member's set, in a worker process."""
    robot = member_with_primitives(member, library)
    spec = env_spec(robot, member.task, GoalConfig(), obstacles=member.obstacles, anew=True)
    faults = certify_goal_set(spec.goals, spec)
    if faults:
        raise BenchmarkError(f"robot {member.name!r} at {member.task}: {faults[0]}")
    return spec.goals.key, set_npz(spec.goals)


def sizes_text() -> str:
    """Return a table of the sizes of the packaged sets by split."""
    sizes = {
        (record["robot"], record["task"], record["obstacles"]): int(record["bytes"])
        for record in packaged_index().values()
    }
    lines = [f"{'split':<36} {'sets':>4} {'size':>10}"]
    for name in split_names():
        used = [sizes[one] for one in {identity(member) for member in _members(name)}]
        lines.append(f"{name:<36} {len(used):>4} {sum(used) / 1000:>7.0f} kB")
    lines.append(f"{'all distinct':<36} {len(sizes):>4} {sum(sizes.values()) / 1000:>7.0f} kB")
    return "\n".join(lines)


def main() -> None:
    """Write the sets and print their sizes, or print the sizes alone."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", action="store_true", help="print the sizes of the sets only")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes")
    args = parser.parse_args()
    if not args.sizes:
        with show_progress(_show):
            write_sets(jobs=args.jobs)
        packaged_index.cache_clear()
    print(sizes_text())


def _show(done: float, total: int | None) -> None:
    if sys.stderr.isatty() or done == total:
        end = "\n" if done == total else "\r"
        print(f"{done} of {total} goal sets", end=end, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
