"""The population page in a browser, and its actions."""

import io
import re
import shutil
import zipfile

import pytest

from helpers.viser_client import PlainClient
from morphgen.benchmark.split_file import read_split
from morphgen.grammar.robot_set import read_index

CARD = "#morphgen-hover"


@pytest.fixture
def own_set(folder):
    """A copy of the set that a test may change."""
    copy = folder / "robots" / "own"
    shutil.copytree(folder / "robots" / "prims", copy)
    yield copy
    shutil.rmtree(copy)


def wait_until_shown(page):
    page.get_by_text("no robot is selected").or_(
        page.get_by_text(re.compile(r"\d selected"))
    ).wait_for()
    page.wait_for_function("window.morphgenHover && window.morphgenHover.table")


def robot_points(page):
    """Return a point of the window on each robot: the middle of its first capsule."""
    return page.evaluate("""() => {
        const box = document.querySelector("canvas").getBoundingClientRect(), points = {};
        const t = window.morphgenHover.table, unit = box.height / 8192;
        for (let i = 0; i < t.length; i += 6) points[t[i + 5]] ??= [
            box.left + (t[i] + t[i + 2]) / 2 * unit, box.top + (t[i + 1] + t[i + 3]) / 2 * unit];
        return points;
    }""")


def test_unknown_populations_show_an_error(viewer):
    with PlainClient(viewer().port, "?population=nowhere") as client:
        client.shows("no such file or folder")


@pytest.mark.slow
def test_hover_shows_a_card_and_a_click_opens_the_robot(see, picture):
    page = see("?population=robots/prims")
    wait_until_shown(page)
    picture(page, "population")
    points = robot_points(page)
    assert len(points) == 30
    page.mouse.move(*points["7"])
    page.locator(CARD).wait_for()
    name = page.locator(f"{CARD} b").inner_text()
    assert name.startswith("prims-")
    page.mouse.click(*points["7"])
    page.wait_for_url(re.compile(f"robot=robots/prims/{name}"))
    assert page.failures == []


@pytest.mark.slow
def test_a_rectangle_selects_and_the_address_keeps_arrangement_pose_and_selection(see, control):
    page = see("?population=robots/prims&arrange=reach")
    wait_until_shown(page)
    page.get_by_role("button", name="random free").click()
    page.wait_for_url(re.compile("pose=1"))
    control.input(page, "joint 1").last.fill("0.25")
    page.wait_for_url(re.compile("joint1=0.25"))
    box = page.locator("canvas").first.bounding_box()
    page.keyboard.down("Shift")
    page.mouse.move(box["x"] + 5, box["y"] + 5)
    page.mouse.down()
    page.mouse.move(box["x"] + 200, box["y"] + 200)
    page.mouse.move(box["x"] + box["width"] - 5, box["y"] + box["height"] - 5)
    page.mouse.up()
    page.keyboard.up("Shift")
    page.get_by_text("30 selected").wait_for()
    page.wait_for_url(re.compile("select=0-29"))
    page.get_by_role("button", name="invert").click()
    page.get_by_text("no robot is selected").wait_for()
    page.goto(re.sub("$", "&select=2,4-5", page.url))
    page.get_by_text("3 selected").wait_for()
    assert all(part in page.url for part in ("arrange=reach", "pose=1", "joint1=0.25"))
    page.get_by_role("button", name="Compare").click()
    page.wait_for_url(re.compile("compare=.*prims-000002&compare=.*prims-000004&compare="))


@pytest.mark.slow
def test_selected_robots_are_exported_split_and_deleted(see, control, folder, own_set):
    page = see("?population=robots/own&select=0-1")
    page.get_by_text("2 selected").wait_for()
    with page.expect_download() as download:
        page.get_by_role("button", name="Export bundles").click()
    with zipfile.ZipFile(io.BytesIO(download.value.path().read_bytes())) as archive:
        urdfs = [name for name in archive.namelist() if name.endswith("/robot.urdf")]
    assert [name.split("/")[1] for name in urdfs] == ["0000-prims-000000", "0001-prims-000001"]
    page.get_by_text("New split").click()
    control.input(page, "split name").last.fill("from/population")
    page.get_by_role("button", name="Save").click()
    page.get_by_text("morphgen split audit splits/from/population.yaml").wait_for()
    split = read_split(folder / "splits" / "from" / "population.yaml")
    assert [member.name for member in split.test] == ["prims-000000", "prims-000001"]
    assert len(split.train) == 28
    page.get_by_role("button", name="Delete from the set").click()
    page.get_by_role("button", name="Keep them").click()
    page.get_by_role("button", name="Keep them").wait_for(state="hidden")
    assert len(read_index(own_set)) == 30
    page.get_by_role("button", name="Delete from the set").click()
    page.get_by_role("button", name="Delete 2 robots").click()
    page.get_by_text("28 robots", exact=True).wait_for()
    assert len(read_index(own_set)) == 28
    assert not (own_set / "prims-000000").exists()


@pytest.mark.slow
@pytest.mark.parametrize("query", ["&arrange=scatter&x=dof&y=mass", "&arrange=map", "@test"])
def test_arrangements_of_a_split(see, query, picture):
    page = see(f"?population=extrapolation/primitives/reach{query}")
    wait_until_shown(page)
    # The camera moves at first; the points of all robots follow.
    page.wait_for_function(
        "n => new Set(window.morphgenHover.table.filter((_, i) => i % 6 == 5)).size == n",
        arg=2 if query == "@test" else 12,
    )
    assert page.get_by_role("button", name="Delete from the set").count() == 0
    picture(page, "population-" + query.strip("&@").replace("=", "-").replace("&", "-"))
    assert page.failures == []


@pytest.mark.slow
def test_dark_pages_stay_dark(see):
    page = see("?population=robots/prims&theme=dark")
    wait_until_shown(page)
    assert page.locator("html").get_attribute("data-mantine-color-scheme") == "dark"
    page.goto(page.url.partition("?")[0] + "?library=")
    page.locator(".card").first.wait_for()
    page.locator('html[data-mantine-color-scheme="dark"]').wait_for(state="attached")
    page.get_by_role("link", name="light", exact=True).click()
    page.locator('html[data-mantine-color-scheme="light"]').wait_for(state="attached")


@pytest.mark.slow
def test_the_page_is_covered_until_its_content_is_there(see):
    page = see("?library=")
    assert page.locator("#morphgen-cover").count() == 1
    page.locator("#morphgen-cover").wait_for(state="detached")
    page.locator(".card").first.wait_for()
