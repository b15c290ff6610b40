"""Bodies to choose from on the page of playback, by where they come from."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from morphgen.benchmark.split_file import split_names
from morphgen.viewer.robot_rows import folder_entries, split_entries
from morphgen.viewer.robot_uri import MEMBER, WORDS, FileAccess, is_set, resolve_split

PARTS = "arms with a plate"
BODIES = 500
"""The most that are offered; others can be named."""

Bodies = list[tuple[str, str]]
"""Names and places."""


def sources(place: str, trained: Bodies, places: FileAccess) -> dict[str, Callable[[], Bodies]]:
    """Where bodies can be chosen from: what they are, and how to list them.

    Args:
        place: Of the first body that plays; its set or split comes first.
        trained: Bodies that the policy was trained on.
        places: What may be looked at.
    """
    found: dict[str, Callable[[], Bodies]] = {}
    if trained:
        found["trained on"] = lambda: trained
    if place.startswith(MEMBER):
        name = place.removeprefix(MEMBER).rpartition("@")[0]
        found[name] = lambda: split_bodies(name, places)
    folder = "" if ":" in place else place.rstrip("/").rpartition("/")[0]
    if folder and is_set(places.path(folder)):
        found[folder] = lambda: set_bodies(folder, places)
    found[PARTS] = lambda: part_bodies(places)
    for split in split_names():
        found.setdefault(split, _lister(split, places))
    return found


def split_bodies(name: str, places: FileAccess) -> Bodies:
    """The members of a split, those to train on first."""
    rows = split_entries(name, resolve_split(name, places))
    return [(f"{row.role}: {row.name}", row.place) for row in rows[:BODIES]]


def set_bodies(folder: str, places: FileAccess) -> Bodies:
    """The robots of a set."""
    return [(row.name, row.place) for row in folder_entries(folder, places)[:BODIES]]


def part_bodies(places: FileAccess) -> Bodies:
    """Every arm with a plate at its end, and the plate that slides."""
    arms = [(arm, f"{WORDS}arm={arm} ee=plane") for arm in places.library.names("arm")]
    return [*arms, ("planar-cube", f"{WORDS}base=planar ee=cube")]


def labels(bodies: Bodies, chosen: Sequence[str]) -> dict[str, str]:
    """FileAccess by labels that are all different, in the order of the bodies.

    Args:
        bodies: Names and places.
        chosen: FileAccess that play; what is not among the bodies comes first, by its place.
    """
    found: dict[str, str] = {}
    known = {place for _, place in bodies}
    for name, place in [*((place, place) for place in chosen if place not in known), *bodies]:
        label = name
        while label in found:
            label += "'"
        found[label] = place
    return found


def _lister(split: str, places: FileAccess) -> Callable[[], Bodies]:
    return lambda: split_bodies(split, places)
