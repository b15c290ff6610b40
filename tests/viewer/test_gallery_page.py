"""The gallery pages: cards, the filter and its values in the address, histograms, new splits."""

import os
import re
import signal

import pytest

from helpers.pages import field, press
from helpers.viser_client import PlainClient
from morphgen.splits.split_file import read_split
from morphgen.viewer.app.address import AddressError
from morphgen.viewer.figures import histogram_svg
from morphgen.viewer.gallery import parse_range


def test_cards_of_a_gallery_lead_to_their_robots(shared_viewer):
    with PlainClient(shared_viewer.port, "?gallery=robots/prims") as client:
        client.shows("30 robots · page 1 of 2")
        client.until(lambda: 'href="?robot=' in client.text)
        hrefs = re.findall(r'class="card" href="([^"]*)"', client.text)[:24]
        assert hrefs == [f"?robot=robots/prims/prims-{i:06d}" for i in range(24)]


def test_the_library_counts_parts(shared_viewer):
    with PlainClient(shared_viewer.port, "?library=") as client:
        client.shows(" parts · page 1 of")
        client.control("Dropdown", "Kind of part")
        (orders,) = [
            message["props"]["options"]
            for message in client.messages
            if message["type"] == "GuiDropdownMessage" and message["props"]["label"] == "Sort by"
        ]
        assert {"name, Z to A", "reach, largest first", "kind of part, Z to A"} <= {*orders}


def card_names(client):
    """Return the names on the cards that are shown last."""
    grids = re.findall(r'<div class="columns">.*', client.text)
    return re.findall(r'class="name">([^<]*)', grids[-1]) if grids else []


def test_search_order_and_page_of_a_gallery_are_in_the_address(shared_viewer):
    with PlainClient(shared_viewer.port, "?gallery=robots/prims&sort=-name") as client:
        client.until(lambda: card_names(client)[:1] == ["prims-000029"])
        client.change(client.control("ButtonGroup", "Page"), "next")
        client.shows("page 2 of 2")
        client.until(lambda: card_names(client) == [f"prims-{i:06d}" for i in range(5, -1, -1)])
        assert client.addresses[-1] == (0, "?gallery=robots/prims&sort=-name&n=2")
        client.change(client.control("Text", "Search"), "00000")
        client.shows("10 of 30 robots · page 1 of 1")
        client.until(lambda: client.addresses[-1][1].endswith("&sort=-name&search=00000"))


@pytest.mark.slow
def test_thumbnails_are_rendered_by_workers_and_broken_robots_show_an_error(see):
    page = see("?gallery=robots")
    page.locator(".card").first.wait_for()
    page.wait_for_selector(".card:has-text('some-arm') img")
    page.wait_for_selector(".card:has-text('broken') .tag.error")
    title = page.locator(".card", has_text="broken").first.get_attribute("title")
    assert "no link 'lost'" in title or "lost" in title


@pytest.mark.slow
def test_controls_have_names_and_the_space_bar_ticks_a_card(see):
    page = see("?gallery=robots/prims")
    card = page.locator("a.card").nth(1)
    card.wait_for()
    page.get_by_role("textbox", name="Search", exact=True).wait_for()
    page.get_by_role("heading", level=1, name="robots/prims").wait_for(state="attached")
    card.focus()
    page.keyboard.press("Space")
    box = page.get_by_role("checkbox", name="choose robots/prims/prims-000001")
    page.wait_for_url(re.compile("chosen=robots/prims/prims-000001"))
    assert box.is_checked()
    page.keyboard.press("Tab")  # to the next card, not to the box
    assert page.evaluate("document.activeElement.className") == "card"
    assert page.failures == []


@pytest.mark.slow
def test_dead_worker_is_reported_once_and_thumbnails_are_still_rendered(see, viewer):
    on = viewer()
    page = see("?gallery=robots/prims&search=00000", on=on)
    page.wait_for_function("document.querySelectorAll('.card img').length == 10")
    processes = list(on.workers._pool._processes.values())
    for process in processes:  # stopped, so that they cannot draw all before they are killed
        os.kill(process.pid, signal.SIGSTOP)
    page.goto(f"http://127.0.0.1:{on.port}/?gallery=robots/prims")
    page.locator(".card .empty").first.wait_for()
    for process in processes:
        process.kill()
    page.get_by_text("A worker died").wait_for()
    page.wait_for_function("document.querySelectorAll('.card img').length == 24")
    assert page.get_by_text("A worker died").count() <= 1
    assert page.locator(".card .empty").count() == 0


@pytest.mark.slow
def test_split_is_created_from_filtered_robots(see, folder):
    page = see("?gallery=robots/prims&search=00000")
    page.get_by_text("10 of 30 robots").wait_for()
    page.get_by_text("New split").click()
    for label, value in (("split name", "from/gallery"), ("to train on", "3"), ("to test on", "2")):
        field(page, label).last.fill(value)
    press(page, "Save")
    page.get_by_text("morphgen split audit splits/from/gallery.yaml").wait_for()
    split = read_split(folder / "splits" / "from" / "gallery.yaml")
    assert [member.name for member in split.train] == [f"prims-{i:06d}" for i in range(3)]
    assert [member.name for member in split.test] == ["prims-000010", "prims-000011"]


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
def test_a_page_says_which_value_of_its_address_it_leaves_out(shared_viewer, query, message):
    with PlainClient(shared_viewer.port, f"?gallery=robots/prims&{query}") as client:
        client.shows(message)
        client.shows("30 robots · page 1 of 2")


def test_an_empty_gallery_names_the_condition_that_excludes_all(shared_viewer):
    query = "?gallery=robots/prims&search=lost&findings=without"
    with PlainClient(shared_viewer.port, query) as client:
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


def test_a_histogram_counts_all_values_and_greys_those_outside_the_range():
    svg = histogram_svg([0.0, 0.1, 0.1, 1.0], (0.0, 1.0), (0.0, 0.5))
    counts = [int(text) for text in re.findall(r"<title>(\d+) robots", svg)]
    assert sum(counts) == 4
    assert max(counts) == 2
    colours = [text.split('"')[0] for text in svg.split('fill="')[1:]]
    assert len(set(colours[:20])) == 1
    assert set(colours[21:]) == {"#adb5bd88"}
    assert colours[0] != colours[-1]


def test_a_gallery_shows_the_distributions_of_its_facts(shared_viewer):
    with PlainClient(shared_viewer.port, "?gallery=robots/prims") as client:
        client.control("MultiSlider", "Reach (m)")
        client.shows("robots from")
