"""Fits of collision meshes in the user's cache, so that a robot is fitted once."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from platformdirs import user_cache_path

from morphgen.errors import FitError, FormatError
from morphgen.formats.fits import fits_text, keep_fit, read_fits, shapes_key, shapes_scale
from morphgen.model.geometry import StoredFit, StoredFits
from morphgen.model.robot import Link, Robot
from morphgen.processes import Progress, no_progress

if TYPE_CHECKING:
    from morphgen.fitting.link_fit import FitOptions

_LOGGER = logging.getLogger(__name__)


def cached_fits(links: Iterable[Link], kind: str) -> dict[str, StoredFit]:
    """Return the fits of links that are in the cache, by link name.

    Args:
        links: Links with collision shapes.
        kind: Folder of the cache, which stands for all options of a fit.

    Raises:
        FormatError: If a file of the cache is malformed, or a mesh cannot be read.
    """
    fits = {}
    for link in links:
        key = shapes_key(link.collisions)
        path = _path(kind, key)
        if not path.is_file():
            continue
        try:
            fit = read_fits(path).get(key)
        except FormatError as error:
            raise FormatError(f"{error}; delete the file") from error
        if fit is not None:
            fits[link.name] = replace(fit.scaled(shapes_scale(link.collisions)), link=link.name)
    return fits


def fit_and_keep(
    robot: Robot,
    links: Sequence[Link],
    options: FitOptions,
    kind: str,
    stored: StoredFits,
    *,
    jobs: int = 1,
    progress: Progress = no_progress,
) -> dict[str, StoredFit]:
    """Fit primitives to links, say so, and keep the fits in the cache.

    Args:
        robot: The robot.
        links: Its links with collision shapes to fit.
        options: Options of the fits.
        kind: As for ``cached_fits``.
        stored: Stored fits, whose token primitives are kept.
        jobs: Number of processes; the result does not depend on it.
        progress: Receives the number of links that are fitted, and of all.

    Returns:
        Fits by link name.

    Raises:
        FitError: If a link has no volume to fit a primitive to.
        MeshError: If a mesh cannot be read.
    """
    # These import torch, which takes seconds to load.
    from morphgen.fitting.part_fits import fits_of
    from morphgen.fitting.robot_fit import fit_links

    _LOGGER.warning(
        "fitting primitives to %d links of robot %r, seconds for each; the fits are kept",
        len(links),
        robot.name,
    )
    names = [link.name for link in links]
    report = fit_links(robot, options, only=names, jobs=jobs, progress=progress)
    for finding in report.findings:
        if finding.severity != "info":
            raise FitError(f"{finding.where}: {finding.why}")
    fits = fits_of(robot, report, stored)
    for name, fit in fits.items():
        shapes = robot.link(name).collisions
        key = shapes_key(shapes)
        keep_fit(_path(kind, key), fits_text({key: fit.scaled(1 / shapes_scale(shapes))}))
    return fits


def _path(kind: str, key: str) -> Path:
    return user_cache_path("morphgen") / kind / f"{key}.json"
