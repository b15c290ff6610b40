"""Tables of a study."""

from morphgen.rl.scores.score_tables import Row, table_text


def test_a_table_of_several_splits_has_a_section_for_each():
    rows = [Row(split, "reach", "se", "", (), (0,), {}, ("train",)) for split in ("one", "two")]
    titles = [line for line in table_text(rows).splitlines() if line.startswith("##")]
    assert titles == ["## one", "## two"]
