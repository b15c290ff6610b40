"""The machine and its packages: Python, processors, GPU, the user's cache, versions."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from packaging.requirements import Requirement
from platformdirs import user_cache_path

import morphgen
from morphgen.doctor import Entry, attempt
from morphgen.processes import usable_cores

NOT_FOR_USERS = frozenset(("all", "bench", "dev", "docs", "test"))
"""Extras that the diagnosis leaves out: a sum of others, and those for work on morphgen itself."""


def machine() -> Iterator[Entry]:
    """Describe the machine."""
    yield attempt("morphgen", _morphgen)
    yield attempt("python", _python)
    yield attempt("cpu", _cpu)
    yield attempt("gpu", _gpu)
    yield attempt("cache", _cache)


def _morphgen() -> Entry:
    folder = str(Path(morphgen.__file__).parent)
    number = importlib.metadata.version("morphgen")
    return Entry("morphgen", "ok", f"{number} in {folder}", {"version": number, "folder": folder})


def _python() -> Entry:
    data = {"version": platform.python_version(), "platform": platform.platform()}
    text = f"{platform.python_implementation()} {data['version']} at {sys.executable}"
    return Entry("python", "ok", f"{text}, {data['platform']}", data)


def _cpu() -> Entry:
    total = os.cpu_count() or 1
    usable = usable_cores()
    text = f"{platform.machine()}, {usable} of {total} logical cores may be used"
    return Entry("cpu", "ok", text, {"machine": platform.machine(), "cores": usable})


def _gpu() -> Entry:
    """Describe the GPUs that torch can compute on."""
    import torch

    if not torch.cuda.is_available():
        build = torch.version.cuda
        why = "torch was built without CUDA" if build is None else f"no device for CUDA {build}"
        return Entry("gpu", "ok", f"none ({why}); everything runs on the CPU", {"devices": []})
    names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    # A device that is listed may lack kernels for its architecture.
    torch.ones(2, device="cuda").sum().item()
    text = f"{', '.join(names)} with CUDA {torch.version.cuda}; --device cuda works"
    return Entry("gpu", "ok", text, {"devices": names, "cuda": torch.version.cuda})


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
    data = {"folder": str(folder), "bytes": sizes}
    if not os.access(existing, os.W_OK):
        text = f"{folder} cannot be written: goal sets and fits are made anew each time"
        return Entry("cache", "warning", text, data)
    listed = ", ".join(f"{name} {size / 1e6:.1f} MB" for name, size in sizes.items())
    return Entry("cache", "ok", f"{folder}: {listed or 'empty'}; delete it to clear it", data)


def packages() -> Iterator[Entry]:
    """Compare the installed packages with the ranges that morphgen declares."""
    distribution = importlib.metadata.distribution("morphgen")
    declared = [Requirement(line) for line in distribution.requires or ()]
    yield from _group("core", _requirements("", declared))
    for extra in distribution.metadata.get_all("Provides-Extra") or ():
        if extra not in NOT_FOR_USERS:
            yield from _group(f"extra {extra}", _requirements(extra, declared))


def _requirements(extra: str, declared: Sequence[Requirement]) -> list[Requirement]:
    """Return the requirements of an extra, and of the extras that it includes."""
    chosen: dict[str, Requirement] = {}
    for requirement in declared:
        marker = requirement.marker
        if (marker is None) == bool(extra) or (marker and not marker.evaluate({"extra": extra})):
            continue
        if requirement.name == "morphgen":
            for included in sorted(requirement.extras):
                chosen |= {each.name: each for each in _requirements(included, declared)}
        else:
            chosen[requirement.name] = requirement
    return list(chosen.values())


def _group(name: str, requirements: Sequence[Requirement]) -> Iterator[Entry]:
    """Yield a result for the core or an extra, and one for each package outside its range."""
    versions = {each.name: _version(each.name) for each in requirements}
    missing = [package for package, number in versions.items() if number is None]
    for requirement in requirements:
        number = versions[requirement.name]
        if number and not requirement.specifier.contains(number, prereleases=True):
            text = f"{number} is outside of the range {requirement.specifier} that morphgen needs"
            yield Entry(f"package {requirement.name}", "warning", text)
    kind, _, extra = name.partition(" ")
    if not requirements:
        yield Entry(name, "absent", "not available for this version of Python")
    elif missing and kind == "core":
        text = f"not installed: {', '.join(missing)}; install morphgen again"
        yield Entry(name, "error", text, versions)
    elif missing:
        text = f"not installed: {', '.join(missing)}; pip install 'morphgen[{extra}]'"
        yield Entry(name, "absent", text, versions)
    else:
        text = ", ".join(f"{package} {number}" for package, number in sorted(versions.items()))
        yield Entry(name, "ok", text, versions)


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
