"""Diagnose the installation, section by section."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module

from morphgen.doctor.entry import Entry, failure

SECTIONS: Mapping[str, str] = {
    "system": "morphgen.doctor.system",
    "packages": "morphgen.doctor.packages",
    "files": "morphgen.doctor.files",
    "self-test": "morphgen.doctor.self_test",
}
"""Module of each section; its function ``entries`` yields the results."""


def diagnose() -> Iterator[tuple[str, Entry]]:
    """Examine the installation; yield each result with its section as soon as it is known.

    Nothing is written but temporary files and, if goal sets or fits are missing, the user's cache.
    An error of a broken package is a result, too.
    """
    for section, module in SECTIONS.items():
        try:
            for entry in import_module(module).entries():
                yield section, entry
        except Exception as error:  # whatever a broken package raises
            yield section, failure(section, error)
