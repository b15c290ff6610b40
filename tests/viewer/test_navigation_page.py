"""The way through the pages in a browser, without loading viser's client again."""

import re

import pytest

from helpers.pages import field, nodes, press
from morphgen.splits.split_file import read_split

pytestmark = pytest.mark.slow


TRAY = "#morphgen-tray"


def bar(page, label):
    return page.locator("#morphgen-bar").get_by_role("link", name=label, exact=True)


@pytest.fixture
def same(see):
    """Open a page and mark it; the mark is lost if the browser loads the client again."""

    def open_marked(query, **options):
        page = see(query, **options)
        page.locator("#morphgen-cover").wait_for(state="detached")
        page.evaluate("window.mark = true")
        return page

    return open_marked


def test_robots_are_chosen_compared_played_and_split(same, folder, picture):
    page = same("?gallery=robots/prims")
    page.locator(".card img").nth(5).wait_for()
    boxes = page.locator("input[data-choose]")
    for i in (0, 3, 5):
        boxes.nth(i).click()
    page.locator(TRAY).get_by_text("3 chosen").wait_for()
    page.wait_for_url(re.compile("gallery=robots/prims&(chosen=[^&]*&){2}chosen=[^&]*000005$"))
    picture(page, "gallery-chosen")
    page.locator("a.card").nth(3).click()
    page.get_by_text("no self-collision").or_(page.get_by_text("collide")).first.wait_for()
    page.locator("input[data-choose]:checked").wait_for(state="attached")
    page.go_back()
    page.get_by_text("30 robots · page 1 of 2").wait_for()
    page.wait_for_function("document.querySelectorAll('input[data-choose]:checked').length == 3")
    page.locator(TRAY).get_by_text("compare").click()
    page.get_by_text(re.compile("prims-000000 and prims-000003")).wait_for()
    page.locator("tr", has_text="prims-000003").get_by_role("link", name="remove").click()
    page.wait_for_url(re.compile(r"\?compare=[^&]*000000&compare=[^&]*000005&"))
    page.locator(TRAY).get_by_text("split").click()
    page.get_by_text("test (1)").wait_for()
    picture(page, "chosen")
    field(page, "split name").last.fill("from/tray")
    press(page, "Save")
    page.get_by_text("morphgen split audit splits/from/tray.yaml").wait_for()
    split = read_split(folder / "splits" / "from" / "tray.yaml")
    assert [member.name for member in split.test] == ["prims-000005"]
    with page.expect_download() as download:
        page.locator(TRAY).get_by_text("download").click()
    assert download.value.suggested_filename == "robots.zip"
    page.locator(TRAY).get_by_text("clear").click()
    page.locator(TRAY).wait_for(state="hidden")
    assert page.evaluate("window.mark") is True
    assert page.failures == []


def test_the_bar_leads_everywhere_and_back_returns(same):
    page = same("?library=")
    page.locator(".card").first.wait_for()
    for label, text in (
        ("Gallery", "Open the gallery of which robots?"),
        ("Population", "Show which robots on one ground?"),
        ("Splits", "Open which split?"),
        ("Compare", "Compare two to four robots"),
        ("Compose", "DoF"),
    ):
        bar(page, label).click()
        page.get_by_text(text).first.wait_for()
        assert bar(page, label).get_attribute("class") == "current"
    for text in ("Compare two to four robots", "Open which split?"):
        page.go_back()
        page.get_by_text(text).wait_for()
    page.go_forward()
    page.get_by_text("Compare two to four robots").wait_for()
    assert page.evaluate("window.mark") is True
    assert page.failures == []


def test_leaving_a_page_leaves_nothing_of_it(same, viewer):
    on = viewer()
    page = same("?robot=words:arm=ur5 ee=plane&show=visual,frames,workspace", on=on)
    page.get_by_text("no self-collision").wait_for()
    bar(page, "Splits").click()
    page.get_by_text("Open which split?").wait_for()
    page.wait_for_timeout(3000)
    assert set(nodes(on)) <= {"/light"}
    assert page.get_by_role("tab").count() == 0


def test_the_theme_changes_without_a_new_page(same):
    page = same("?compare=robots/some-arm&joint1=0.5")
    page.get_by_text("Add a second robot").wait_for()
    bar(page, "dark").click()
    page.locator('html[data-mantine-color-scheme="dark"]').wait_for(state="attached")
    page.wait_for_url(re.compile(r"compare=robots/some-arm&joint1=0\.5$"))
    assert page.evaluate("window.mark") is True
    page.reload()  # the browser remembers it
    page.locator('html[data-mantine-color-scheme="dark"]').wait_for(state="attached")


def test_the_open_tab_is_in_the_address_and_back_returns_to_it(same):
    page = same("?robot=robots/prims/prims-000001")
    page.get_by_role("tab", name="Links").click()
    page.wait_for_url(re.compile(r"&tab=Links$"))
    page.get_by_role("link", name="robots/prims").click()
    page.locator(".card").first.wait_for()
    page.go_back()
    page.locator('[role=tab][aria-selected=true][title="Links"]').wait_for()
    page.get_by_role("tab", name="Move").click()
    page.wait_for_url(re.compile(r"prims-000001$"))
    assert page.failures == []
