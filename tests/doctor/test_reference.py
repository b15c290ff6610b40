"""Values that are the same in all versions 0.3.x; ``docs/versions.md`` promises them."""

import pytest

from morphgen.doctor import reference

CHANGED = "numbers of this version do not compare with earlier ones: see docs/versions.md"


def test_every_group_is_recorded():
    assert reference.recorded().keys() == reference.GROUPS.keys()


@pytest.mark.parametrize("group", sorted(reference.GROUPS.keys() - {"score"}))
def test_values_are_the_recorded_ones(group):
    assert reference.GROUPS[group]() == reference.recorded()[group], CHANGED


def test_the_score_of_a_baseline_is_the_recorded_one():
    expected = pytest.approx(reference.recorded()["score"], abs=reference.SCORE_TOLERANCE)
    assert reference.score() == expected, CHANGED


def test_values_are_written_as_they_are_read(tmp_path, monkeypatch):
    file = tmp_path / "reference.json"
    monkeypatch.setattr(reference, "FILE", file)
    groups = {"token_layout": reference.token_layout, "constants": reference.constants}
    monkeypatch.setattr(reference, "GROUPS", groups)
    reference.main()
    assert reference.recorded() == {name: compute() for name, compute in groups.items()}
