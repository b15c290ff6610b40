"""The machine: Python, processors, GPU and the user's cache."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

from platformdirs import user_cache_path

import morphgen
from morphgen.doctor.entry import Entry, attempt


def entries() -> Iterator[Entry]:
    """Describe the machine."""
    yield attempt("morphgen", _morphgen)
    yield attempt("python", _python)
    yield attempt("cpu", _cpu)
    yield attempt("gpu", _gpu)
    yield attempt("cache", _cache)


def _morphgen() -> Entry:
    folder = str(Path(morphgen.__file__).parent)
    number = version("morphgen")
    return Entry("morphgen", "ok", f"{number} in {folder}", {"version": number, "folder": folder})


def _python() -> Entry:
    data = {"version": platform.python_version(), "platform": platform.platform()}
    text = f"{platform.python_implementation()} {data['version']} at {sys.executable}"
    return Entry("python", "ok", f"{text}, {data['platform']}", data)


def _cpu() -> Entry:
    total = os.cpu_count() or 1
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else total
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
    torch.ones(2, device="cuda").sum().item()
    text = f"{', '.join(names)} with CUDA {torch.version.cuda}; --device cuda works"
    return Entry("gpu", "ok", text, {"devices": names, "cuda": torch.version.cuda})


def _cache() -> Entry:
    """Describe the folder of goal sets, fits and thumbnails that need not be made again."""
    folder = user_cache_path("morphgen")
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
