"""The gallery pages in a browser."""

import re

import pytest

from helpers.viser_client import PlainClient
from morphgen.benchmark.split_file import read_split


def names(page):
    return page.locator(".card .name").all_inner_texts()


def wait_for_names(page, wanted):
    for name in wanted:
        page.locator(".card .name", has_text=name).wait_for()


def test_cards_of_a_gallery_lead_to_their_robots(shared_viewer):
    with PlainClient(shared_viewer.port, "?gallery=robots/prims") as client:
        client.shows("30 robots · page 1 of 2")
        client.until(lambda: 'href="?robot=' in client.text)
        hrefs = re.findall(r'class="card" href="([^"]*)"', client.text)[:24]
        assert hrefs == [f"?robot=robots/prims/prims-{i:06d}" for i in range(24)]


def test_the_library_counts_parts(shared_viewer):
    with PlainClient(shared_viewer.port, "?library=") as client:
        client.shows(" parts · page 1 of")


@pytest.mark.slow
def test_search_filters_rows_and_updates_the_url(see, control):
    page = see("?gallery=robots/prims")
    page.locator(".card").first.wait_for()
    control.input(page, "Search").fill("00000")
    page.get_by_text("10 of 30 robots").wait_for()
    assert names(page) == [f"prims-{i:06d}" for i in range(10)]
    page.wait_for_url(re.compile(r"search=00000"))
    page.reload()
    page.get_by_text("10 of 30 robots").wait_for()


@pytest.mark.slow
def test_gallery_pages_can_be_changed(see):
    page = see("?gallery=robots/prims&sort=-name")
    page.locator(".card").first.wait_for()
    assert names(page)[0] == "prims-000029"
    page.get_by_role("button", name="next").click()
    page.get_by_text("page 2 of 2").wait_for()
    assert names(page) == [f"prims-{i:06d}" for i in range(5, -1, -1)]
    page.wait_for_url(re.compile(r"sort=-name&n=2"))


@pytest.mark.slow
def test_thumbnails_are_rendered_by_workers_and_broken_robots_show_an_error(see):
    page = see("?gallery=robots")
    page.locator(".card").first.wait_for()
    page.wait_for_selector(".card:has-text('some-arm') img")
    page.wait_for_selector(".card:has-text('broken') .tag.error")
    title = page.locator(".card", has_text="broken").first.get_attribute("title")
    assert "no link 'lost'" in title or "lost" in title


@pytest.mark.slow
def test_dead_worker_is_reported_once_and_thumbnails_are_still_rendered(see, viewer):
    on = viewer()
    page = see("?gallery=robots/prims", on=on)
    page.locator(".card img").first.wait_for()
    for process in list(on.workers._pool._processes.values()):
        process.kill()
    page.get_by_text("A worker died").wait_for()
    page.wait_for_function("document.querySelectorAll('.card img').length == 24")
    assert page.get_by_text("A worker died").count() <= 1
    assert page.locator(".card .empty").count() == 0


@pytest.mark.slow
def test_the_library_links_to_everything(see):
    page = see()
    page.locator(".card").first.wait_for()
    for text in ("robots/prims", "extrapolation/arms/reach", "planar_arm", "Compose a robot"):
        assert page.get_by_role("link", name=text, exact=True).is_visible()
    page.get_by_role("link", name="robots/prims", exact=True).click()
    page.get_by_text("30 robots · page 1 of 2").wait_for()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("?gallery=nowhere", "no such file"),
        ("?gallery=../..", "outside of the folders"),
        ("?galery=robots", "did you mean 'gallery'"),
        ("?split=extrapolation/arm/reach", "no such file"),
    ],
)
def test_unknown_url_shows_an_error(see, query, message):
    page = see(query)
    page.get_by_text(re.compile(re.escape(message))).first.wait_for()
    page.get_by_role("link", name="Library").first.click()
    page.get_by_text("Grammars").wait_for()


@pytest.mark.slow
def test_split_is_created_from_filtered_robots(see, control, folder):
    page = see("?gallery=robots/prims&search=00000")
    page.get_by_text("10 of 30 robots").wait_for()
    page.get_by_text("New split").click()
    for label, value in (("split name", "from/gallery"), ("to train on", "3"), ("to test on", "2")):
        control.input(page, label).last.fill(value)
    page.get_by_role("button", name="Save").click()
    page.get_by_text("morphgen split audit splits/from/gallery.yaml").wait_for()
    split = read_split(folder / "splits" / "from" / "gallery.yaml")
    assert [member.name for member in split.train] == [f"prims-{i:06d}" for i in range(3)]
    assert [member.name for member in split.test] == ["prims-000010", "prims-000011"]
