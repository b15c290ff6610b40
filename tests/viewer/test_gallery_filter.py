"""The filter of a gallery: its values in the address, and what the page says about them."""

import pytest

from helpers.viser_client import PlainClient
from morphgen.viewer.app.address import AddressError
from morphgen.viewer.gallery import parse_range


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", (0.5, 1.5)),
        ("0.7..1", (0.7, 1.0)),
        ("0..1", (0.5, 1.0)),
        ("1..inf", (1.0, 1.5)),
        ("1.5..9", (1.5, 1.5)),
    ],
)
def test_a_range_is_clipped_to_the_values_of_the_robots(text, expected):
    assert parse_range("reach", text, (0.5, 1.5)) == expected


@pytest.mark.parametrize(
    ("text", "limits", "message"),
    [
        ("5..9", (0.5, 1.5), r"reach=5\.\.9 excludes every robot.* they have 0\.5 to 1\.5 m"),
        ("0..0.2", (0.5, 0.5), r"they have 0\.5 m"),
        ("9..5", (0.5, 1.5), r"is no range.*expected LOW\.\.HIGH"),
        ("nan..1", (0.5, 1.5), "is no range"),
        ("much", (0.5, 1.5), "is no range"),
        ("0..1", None, "no robot here has a known reach"),
    ],
)
def test_a_range_that_cannot_be_used_is_refused(text, limits, message):
    with pytest.raises(AddressError, match=message):
        parse_range("reach", text, limits)


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("reach=50..90", "reach=50..90 excludes every robot, so it was left out"),
        ("sort=colour", "sort=colour was left out; expected order, -order, name"),
        ("findings=some", "findings=some was left out; expected all, with, without"),
        ("size=25", "size=25 was left out; expected 24, 48, 96"),
        ("role=train", "role=train was left out; expected all"),
    ],
)
def test_a_page_says_which_value_of_its_address_it_leaves_out(viewer, query, message):
    with PlainClient(viewer().port, f"?gallery=robots/prims&{query}") as client:
        client.shows(message)
        client.shows("30 robots · page 1 of 2")


def test_an_empty_gallery_names_the_condition_that_excludes_all(viewer):
    query = "?gallery=robots/prims&search=lost&findings=without"
    with PlainClient(viewer().port, query) as client:
        client.shows("No robot passes the filter")
        client.shows("<td >search: lost</td><td >no robot of 30</td>")


@pytest.mark.slow
def test_conditions_are_cleared_from_an_empty_gallery(see, picture):
    page = see("?gallery=robots/prims&search=lost&dof=1..2")
    page.get_by_text("No robot passes the filter").wait_for()
    picture(page, "gallery-empty")
    page.locator("tr", has_text="search: lost").get_by_text("clear").click()
    page.locator(".card").first.wait_for()
    page.wait_for_function("!location.search.includes('search')")
    assert page.failures == []
