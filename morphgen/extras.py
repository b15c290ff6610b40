"""Optional packages, and the error that names the extra of morphgen that installs a missing one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from morphgen.errors import MissingDependencyError

EXTRAS = {
    "coacd": ("convex",),
    "embreex": ("fit",),
    "fast_simplification": ("fit",),
    "gymnasium": ("tasks", "rl"),
    "imageio": ("tasks", "rl"),
    "pyarrow": ("demos",),
    "tensorboard": ("rl",),
    "torch": ("tasks", "rl"),
    "urdf_usd_converter": ("usd",),
    "viser": ("viewer",),
    "websockets": ("viewer",),
}
"""Optional packages by import name, and the extras of morphgen that install each, the smallest
first."""


def missing_extra(error: Exception, wanted: str = "") -> str | None:
    """Return how to install the optional package that an import lacks; None for other errors."""
    if not (isinstance(error, ModuleNotFoundError) and error.name in EXTRAS):
        return None
    extras = EXTRAS[error.name]
    hint = f"pip install 'morphgen[{wanted if wanted in extras else extras[0]}]'"
    if error.name == "torch":
        hint += "; a small build without CUDA: https://pytorch.org/get-started/locally"
    return f"the package {error.name} is not installed: {hint}"


@contextmanager
def explain_missing_extras(wanted: str = "") -> Iterator[None]:
    """Convert the failed import of an optional package to an error with the wanted extra."""
    try:
        yield
    except ModuleNotFoundError as error:
        text = missing_extra(error, wanted)
        if text is None:
            raise
        raise MissingDependencyError(text) from error
