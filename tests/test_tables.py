"""Tables are whole in files, and fit a terminal."""

import pytest

from morphgen.tables import fitted, table

HEADERS = ("name", "dof", "source", "summary")
ROWS = [("ur5", 6, "rtb-data", "a long arm of six joints"), ("z1", 6, "other", "short")]


@pytest.mark.parametrize("formats", [None, "g"])
def test_a_narrow_table_leaves_columns_out_and_names_them(formats):
    whole = table(ROWS, HEADERS, formats=formats)
    with fitted(1000):
        assert table(ROWS, HEADERS, formats=formats) == whole
    with fitted(30):
        *lines, last = table(ROWS, HEADERS, formats=formats).splitlines()
    for line, narrow in zip(whole.splitlines(), lines, strict=True):
        assert line.startswith(narrow.rstrip())
    assert lines[0].split() == ["name", "dof", "source"]
    assert last == "(--wide shows summary)"
    assert table(ROWS, HEADERS, formats=formats) == whole


def test_a_text_is_shortened_where_that_keeps_its_column():
    with fitted(41):
        lines = table(ROWS, HEADERS).splitlines()
    assert lines[2].split("  ")[-1] == "a long arm of..."
    assert lines[3].split("  ")[-1].strip() == "short"
    assert max(map(len, lines)) <= 41
    assert "--wide" not in lines[-1]


def test_less_important_columns_go_first():
    with fitted(30):
        lines = table(ROWS, HEADERS, last=["dof", "source"]).splitlines()
    assert lines[0].split() == ["name", "summary"]
    assert lines[-1] == "(--wide shows dof, source)"


def test_one_column_remains_and_markdown_is_whole():
    with fitted(12):
        assert len(table(ROWS, HEADERS[::-1])) > 0
        lines = table([row[::-1] for row in ROWS], HEADERS[::-1]).splitlines()
        assert lines[2] == "a l..."
        assert table(ROWS, HEADERS, style="github").count("|") == 4 * 5


def test_long_texts_do_not_take_the_place_of_all_other_columns():
    rows = [("a" * 100, "b" * 100, 1.0, 2.0)]
    with fitted(80):
        lines = table(rows, ("method", "words", "score", "success")).splitlines()
    assert lines[2].split() == ["a" * 37 + "...", "b" * 35 + "..."]
    assert lines[3] == "(--wide shows score, success)"
    with fitted(80):
        lines = table(rows, ("method", "words", "score", "success"), last=["words"]).splitlines()
    assert lines[2].split() == ["a" * 37 + "...", "b" * 15 + "...", "1.0", "2.0"]


def test_titles_of_plain_tables_are_a_row():
    lines = table(ROWS, HEADERS, style="plain").splitlines()
    assert [line.split()[:2] for line in lines] == [["name", "dof"], ["ur5", "6"], ["z1", "6"]]
