"""``morphgen demo`` and ``doctor``: the first commands, and a diagnosis of the installation."""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import shlex
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from packaging.requirements import Requirement
from platformdirs import user_cache_path

from morphgen.cli import build_parser
from morphgen.cli.command import parse
from morphgen.errors import missing_extra, one_line
from morphgen.processes import usable_cores

NOT_FOR_USERS = frozenset(("all", "bench", "dev", "docs", "test"))
"""Extras that the diagnosis leaves out: a sum of others, and those for work on morphgen itself."""
Status = Literal["ok", "absent", "warning", "error"]


@dataclass(frozen=True)
class Entry:
    """One result."""

    name: str  # name of what was examined, such as `library`
    status: Status
    """``absent`` for an optional package, ``error`` if morphgen does not work as documented."""
    text: str  # result, and what to do about it if it is not `ok`; one line


def diagnose() -> Iterator[tuple[str, Entry]]:
    """Examine the installation; yield each result with its section as soon as it is known."""
    for name, examine in (
        ("morphgen", _morphgen),
        ("python", _python),
        ("gpu", _gpu),
        ("cache", _cache),
    ):
        yield "system", attempt(name, examine)
    for entry in packages():
        yield "packages", entry


def attempt(name: str, examine: Callable[[], Entry]) -> Entry:
    """Return the result of a function; whatever it raises, the result says why."""
    try:
        return examine()
    except Exception as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, KeyboardInterrupt):
                raise cause from None
            cause = cause.__cause__ or cause.__context__
        text = missing_extra(error)
        if text is not None:
            return Entry(name, "absent", text)
        if isinstance(error, ModuleNotFoundError):
            text = f"the package {error.name} is not installed; install morphgen again"
        else:
            text = f"{type(error).__name__}: {error}"
        return Entry(name, "error", one_line(text))


def _morphgen() -> Entry:
    folder = Path(__file__).parents[1]
    number = importlib.metadata.version("morphgen")
    return Entry("morphgen", "ok", f"{number} in {folder}")


def _python() -> Entry:
    name = f"{platform.python_implementation()} {platform.python_version()}"
    cores = f"{usable_cores()} of {os.cpu_count()} logical cores may be used"
    return Entry("python", "ok", f"{name} at {sys.executable}, {platform.platform()}; {cores}")


def _gpu() -> Entry:
    """Describe the GPUs that torch can compute on."""
    import torch

    if not torch.cuda.is_available():
        build = torch.version.cuda
        why = "torch was built without CUDA" if build is None else f"no device for CUDA {build}"
        return Entry("gpu", "ok", f"none ({why}); everything runs on the CPU")
    names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    # A device that is listed may lack kernels for its architecture.
    torch.ones(2, device="cuda").sum().item()
    text = f"{', '.join(names)} with CUDA {torch.version.cuda}; --device cuda works"
    return Entry("gpu", "ok", text)


def _cache() -> Entry:
    """Describe the folder of goal sets, fits and thumbnails that need not be made again."""
    folder = user_cache_path("morphgen")
    # The cache is created at its first use.
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    sizes = {
        entry.name: sum(path.stat().st_size for path in entry.rglob("*") if path.is_file())
        for entry in sorted(folder.iterdir() if folder.is_dir() else ())
        if entry.is_dir()
    }
    if not os.access(existing, os.W_OK):
        text = f"{folder} cannot be written: goal sets and fits are made anew each time"
        return Entry("cache", "warning", text)
    listed = ", ".join(f"{name} {size / 1e6:.1f} MB" for name, size in sizes.items())
    return Entry("cache", "ok", f"{folder}: {listed or 'empty'}; delete it to clear it")


def packages() -> Iterator[Entry]:
    """Compare the installed packages with the ranges that morphgen declares."""
    distribution = importlib.metadata.distribution("morphgen")
    extras = distribution.metadata.get_all("Provides-Extra") or ()
    requirements: dict[str, tuple[str, Requirement]] = {}
    for extra in ("", *(each for each in extras if each not in NOT_FOR_USERS)):
        for requirement in map(Requirement, distribution.requires or ()):
            marker = requirement.marker
            if marker.evaluate({"extra": extra}) if marker else not extra:
                requirements.setdefault(requirement.name, (extra, requirement))
    requirements.pop("morphgen", None)  # extras that include others
    installed = {}
    for name, (extra, requirement) in requirements.items():
        try:
            installed[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            how = f"pip install 'morphgen[{extra}]'" if extra else "install morphgen again"
            yield Entry(name, "absent" if extra else "error", f"not installed: {how}")
            continue
        if not requirement.specifier.contains(installed[name], prereleases=True):
            needed = f"the range {requirement.specifier} that morphgen needs"
            yield Entry(name, "warning", f"{installed[name]} is outside of {needed}")
    listed = ", ".join(f"{name} {number}" for name, number in sorted(installed.items()))
    yield Entry("installed", "ok", listed)


def demo(args: argparse.Namespace) -> int:
    """Run the commands until one fails; return its exit code."""
    from morphgen.formats.bundle import PICTURE  # which a broken installation may lack

    bundle, parser = args.out / "ur5-plane", build_parser()
    for words in (
        ["compose", "arm=ur5", "ee=plane", "--out", str(args.out)],
        ["check", str(bundle), "--strict"],
        ["conform", str(bundle)],
    ):
        print(f"$ morphgen {shlex.join(words)}", flush=True)
        parsed = parse(parser, words)
        if code := int(parsed.run(parsed) or 0):
            return code
    print(f"The robot is in {bundle}; its picture is {bundle / PICTURE}")
    return 0


STATUS_WIDTH = 8  # width of the first column [characters]


def doctor(args: argparse.Namespace) -> int:
    """Print the results as they become known; return 1 if there is an error."""
    start, last = time.monotonic(), ""
    results: list[tuple[str, Entry]] = []
    for section, entry in diagnose():
        results.append((section, entry))
        if not args.json:
            if section != last:
                print(section)
            print(f"  {entry.status:<{STATUS_WIDTH}}{entry.name}: {entry.text}", flush=True)
        last = section
    counts = Counter(entry.status for _, entry in results)
    passed = not counts["error"]
    seconds = time.monotonic() - start
    if args.json:
        data = [{"section": section, **asdict(entry)} for section, entry in results]
        print(json.dumps({"passed": passed, "seconds": round(seconds, 1), "results": data}))
    else:
        listed = ", ".join(f"{n} {status}" for status, n in counts.items())
        print(f"{'sound' if passed else 'NOT SOUND'}: {listed}, in {seconds:.1f} s")
    return int(not passed)
