"""Fits of collision meshes in the user's cache, so that a robot is fitted once."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path

from platformdirs import user_cache_path

from morphgen.errors import FormatError
from morphgen.formats.files import write_cache_file
from morphgen.formats.fits import FITTER_VERSION, fits_text, read_fits
from morphgen.model.geometry import StoredFit


def cached_fits(keys: Iterable[str]) -> dict[str, StoredFit]:
    """Return the fits that are in the cache, at unit scale, by their ``shapes_key``.

    Raises:
        FormatError: If a file of the cache is malformed.
    """
    fits: dict[str, StoredFit] = {}
    for path in filter(Path.is_file, map(_path, keys)):
        try:
            fits |= read_fits(path)
        except FormatError as error:
            raise FormatError(f"{error}; delete the file") from error
    return fits


def keep_fits(fits: Mapping[str, StoredFit]) -> None:
    """Write fits at unit scale, by their ``shapes_key``; warn if the cache cannot be written."""
    for key, fit in fits.items():
        try:
            write_cache_file(_path(key), fits_text({key: fit}))
        except OSError as error:
            warnings.warn(f"cannot keep a fit in {_path(key)}: {error.strerror}", stacklevel=2)


def _path(key: str) -> Path:
    return user_cache_path("morphgen") / f"fits-{FITTER_VERSION}" / f"{key}.json"
