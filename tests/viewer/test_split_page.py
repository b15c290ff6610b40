"""The split page in a browser."""

import re

import pytest

from helpers.pages import field, press
from morphgen.errors import BenchmarkError
from morphgen.splits.split_file import find_split, read_split
from morphgen.viewer.app.address import parse_address
from morphgen.viewer.pages.gallery import choose_sides
from morphgen.viewer.robot_rows import Row
from morphgen.viewer.splits import make_member, save_split

SPLIT = "extrapolation/primitives/reach"


@pytest.mark.slow
def test_split_page_shows_both_sides_the_map_and_the_audit(see, picture):
    page = see(f"?split={SPLIT}")
    page.get_by_text("train (10)").wait_for()
    page.get_by_text("test (2)").wait_for()
    page.wait_for_selector(".card:has-text('chain-000001') img")
    picture(page, "split")
    at_work = page.get_by_role("link", name="see robots to test on at work").get_attribute("href")
    assert parse_address(at_work).subjects == ("reach",)
    assert [robot.rpartition("/")[2] for robot in parse_address(at_work).robots] == [
        member.name for member in read_split(find_split(SPLIT)).test
    ]
    page.get_by_role("tab", name="Statistics").click()
    page.get_by_text("Cosine of test to train").wait_for()
    page.get_by_role("tab", name="Audit").click()
    page.get_by_text("Nearest train robots").wait_for()
    page.get_by_role("tab", name="Similarity").click()
    page.locator("svg rect:has(> title)").first.wait_for()
    assert page.locator("svg rect:has(> title)").count() == 144
    page.get_by_role("tab", name="Map").click()
    point = page.locator("svg a", has=page.locator("title", has_text="chain-000001"))
    point.first.wait_for()
    page.locator("svg image").nth(11).wait_for()
    picture(page, "split-map")
    point.first.locator("image").click()
    page.wait_for_url(re.compile(r"robot=split:.*chain-000001"))
    page.get_by_text("chain-000001").first.wait_for()
    assert page.failures == []


@pytest.mark.slow
def test_new_split_is_saved_from_the_shown_robots(see, folder):
    page = see(f"?split={SPLIT}&search=0000")
    page.get_by_text("train (10)").wait_for()
    field(page, "Search").fill("000001")
    page.get_by_text(re.compile("of 12 robots")).wait_for()
    page.get_by_text("New split of what is shown").click()
    field(page, "split name").fill("mine/ones")
    press(page, "Save")
    page.get_by_text("morphgen split audit splits/mine/ones.yaml").wait_for()
    split = read_split(folder / "splits" / "mine" / "ones.yaml")
    assert {member.name[-6:] for member in (*split.train, *split.test)} == {"000001"}
    press(page, "Save")
    page.get_by_text(re.compile("exists; choose another name")).first.wait_for()


def test_robots_of_a_set_become_members(folder, files, monkeypatch):
    monkeypatch.chdir(folder)
    members = [
        make_member(f"robots/prims/prims-{i:06d}", "prims", "push", False, files) for i in range(4)
    ]
    path = save_split("mine/prims", "interpolation", members[:3], members[3:], files)
    split = read_split(path)
    assert split.train == tuple(members[:3])
    assert {member.task for member in split.train} == {"push"}


def test_filter_separates_train_and_test_robots():
    rows = [Row(name, name) for name in "abcdef"]
    train, test = choose_sides(rows, rows[2:5], 2, 3)
    assert [row.name for row in train] == ["c", "d"]
    assert [row.name for row in test] == ["a", "b", "f"]
    with pytest.raises(BenchmarkError, match="3 robots pass the filter and 3 do not: too few"):
        choose_sides(rows, rows[2:5], 4, 1)


def test_empty_sides_and_invalid_names_are_rejected(files):
    with pytest.raises(BenchmarkError, match="0 train and 0 test"):
        save_split("mine", "interpolation", [], [], files)
    with pytest.raises(BenchmarkError, match="use letters"):
        save_split("../mine", "interpolation", [], [], files)
