"""The catalogue has one row per part; the stored facts equal those computed from the parts."""

import json

import numpy as np
import pytest

from helpers.parts import write_part
from morphgen.grammar import catalogue as module
from morphgen.grammar.catalogue import FACTS_FILE, catalogue, compute_facts, source_digest
from morphgen.grammar.library import Library, default_library

LIBRARY = default_library()
STORED = json.loads(FACTS_FILE.read_text())


def test_the_catalogue_has_one_row_per_part_with_plausible_values():
    rows = {row["name"]: row for row in catalogue(LIBRARY, "base")}
    assert set(rows) == set(LIBRARY.names("base"))
    assert rows["gantry"]["dof"] == 5
    assert rows["gantry"]["reach"] == pytest.approx(np.hypot(0.8, np.hypot(0.5, 0.5)), abs=0.01)
    assert rows["fixed"]["mass"] == 0
    assert {row["source"] for row in rows.values()} == {"template"}
    assert {row["kind"] for row in rows.values()} == {"base"}


def test_facts_are_stored_for_every_shipped_part():
    assert sorted(STORED) == LIBRARY.names()


@pytest.mark.parametrize("name", LIBRARY.names())
def test_stored_facts_equal_the_computed_ones(name):
    assert STORED[name] == compute_facts(LIBRARY.manifest(name))


def test_every_real_part_has_a_manufacturer():
    real = [manifest for manifest in LIBRARY.manifests() if not manifest.is_template]
    assert [manifest.name for manifest in real if not manifest.manufacturer] == []
    rows = {row["name"]: row["manufacturer"] for row in catalogue(LIBRARY)}
    assert (rows["mico"], rows["lwr"], rows["plane"]) == ("Kinova", "KUKA", "")


def test_the_shipped_catalogue_loads_no_part(monkeypatch):
    monkeypatch.setattr(module, "compute_facts", None)
    assert len(catalogue(LIBRARY)) == len(STORED)


def test_facts_of_new_or_changed_parts_are_computed(tmp_path):
    write_part(tmp_path, name="cube")
    (row,) = catalogue(Library([tmp_path]))
    assert (row["name"], row["dof"]) == ("cube", 2)
    before = source_digest(Library([tmp_path]).manifest("cube"))
    (tmp_path / "pincer.xacro").write_text((tmp_path / "pincer.xacro").read_text() + "\n")
    assert source_digest(Library([tmp_path]).manifest("cube")) != before
