"""Licences of a split's parts, and which of them a release needs permission for."""

import pytest

from helpers.splits import combined
from morphgen.benchmark.licences import (
    LICENCES,
    NO_DERIVATIVES,
    NON_COMMERCIAL,
    UNKNOWN,
    find_licence,
    licence_ids,
    licenced_parts,
    require_allowed,
    restricted,
)
from morphgen.benchmark.split_file import read_split, split_names
from morphgen.errors import BenchmarkError
from morphgen.grammar.library import default_library

LIBRARY = default_library()
RESTRICTED = {
    f"{name}/{task}"
    for name in ("composition/ee-arm", "extrapolation/arms")
    for task in ("reach", "push")
}


def test_every_licence_of_the_library_is_known():
    used = {LIBRARY.manifest(name).licence for name in LIBRARY.names()}
    assert used - set(LICENCES) == set()
    for name in used:
        licence = find_licence(name)
        assert ("NC" in name.split("-")) == (NON_COMMERCIAL in licence.restrictions)
        assert ("ND" in name.split("-")) == (NO_DERIVATIVES in licence.restrictions)
        assert licence.is_spdx == (not name.startswith("LicenseRef-"))


def test_an_unlisted_licence_counts_as_unknown():
    licence = find_licence("Proprietary")
    assert (licence.restrictions, licence.url, licence.hub_id) == ((UNKNOWN,), "", "unknown")


def test_four_scenarios_have_a_restricted_part():
    found = {}
    for name in split_names():
        for part in restricted(licenced_parts(read_split(name), LIBRARY)):
            found[name] = (part.part, part.licence.id, part.robots)
    assert set(found) == RESTRICTED
    assert set(found.values()) == {("sake_ez", "CC-BY-NC-ND-4.0", (("train", "ur5-ez"),))}


def test_parts_name_every_robot_of_both_sides():
    parts = {part.part: part for part in licenced_parts(combined(), LIBRARY)}
    assert set(parts) == {"gantry", "planar", "plane", "cube", "cylinder"}
    assert parts["plane"].as_dict() == {
        "part": "plane",
        "licence": "MIT",
        "restrictions": [],
        "source": LIBRARY.manifest("plane").citation,
        "robots": {"train": ["gantry-plane"], "test": ["planar-plane"]},
    }


def test_a_restricted_licence_must_be_allowed():
    split = read_split("composition/ee-arm/reach")
    parts = licenced_parts(split, LIBRARY)
    assert licence_ids(parts) == ("BSD-3-Clause", "CC-BY-NC-ND-4.0", "MIT")
    with pytest.raises(BenchmarkError) as caught:
        require_allowed(split, parts, ())
    assert str(caught.value) == (
        "composition/ee-arm/reach: sake_ez (CC-BY-NC-ND-4.0: non-commercial, no derivatives) in "
        "robots ur5-ez; release a split without these parts, or allow the licence with "
        "--licence-allow CC-BY-NC-ND-4.0"
    )
    require_allowed(split, parts, ("CC-BY-NC-ND-4.0",))
    with pytest.raises(BenchmarkError, match=r"no part of .* has this licence; did you mean 'CC-"):
        require_allowed(split, parts, ("CC-BY-NC-ND-3.0",))
