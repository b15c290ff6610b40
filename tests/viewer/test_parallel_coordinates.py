"""Parallel coordinates of a gallery: lines of robots, and ranges chosen along an axis."""

import re

import pytest

from morphgen.viewer.app.address import AddressError
from morphgen.viewer.parallel_coordinates import Axis, parallel_svg, parse_brush
from morphgen.viewer.robot_rows import Row

AXES = {"dof": Axis("DoF", (2, 6), True), "reach": Axis("Reach (m)", (0.5, 1.5))}


def row(name, dof, reach, role=""):
    return Row(name, f"robots/{name}", role=role, dof=dof, reach=reach)


def test_robots_that_pass_have_a_line_with_a_link_and_the_others_a_grey_one():
    rows = [row("<a>", 2, 0.5), row("b", 6, 1.5), row("c", 4, None)]
    svg = parallel_svg(rows, AXES, {"robots/<a>", "robots/c"}, 500)
    assert re.findall(r"<title>(.*?)</title>", svg) == ["&lt;a&gt;: 2 DoF · 0.50 m"]
    assert re.findall(r'd="(M60.*?)"', svg)[:2] == ["M60 36.0L440 36.0", "M60 436.0L440 436.0"]


def test_an_axis_shows_its_chosen_range():
    axes = {**AXES, "reach": Axis("Reach (m)", (0.5, 1.5), chosen=(0.75, 1.25))}
    svg = parallel_svg([row("a", 2, 1.0)], axes, set(), 500)
    bar = re.search(r'y="([\d.]+)" width="26" height="([\d.]+)" class="chosen"', svg)
    assert [float(text) for text in bar.groups()] == [36 + 100 - 2, 200 + 4]
    assert ">0.75</text>" in svg
    assert re.findall(r'class="tick">(\d+)</text>', svg)[:5] == ["2", "3", "4", "5", "6"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("dof:0.25:0.75", ("dof", (3, 5))),
        ("reach:0:1", ("reach", (0.5, 1.5))),
        ("reach:", ("reach", (0.5, 1.5))),
    ],
)
def test_a_range_of_the_pointer_is_a_share_of_the_axis(text, expected):
    assert parse_brush(text, AXES) == expected


@pytest.mark.parametrize("text", ["", "mass:0:1", "dof:0.8:0.2", "dof:-1:1", "dof:0", "dof:nan:1"])
def test_other_messages_are_refused(text):
    with pytest.raises(AddressError, match="no range of an axis"):
        parse_brush(text, AXES)


@pytest.mark.slow
def test_a_drag_along_an_axis_filters_the_gallery(see, picture):
    page = see("?gallery=robots/prims")
    page.locator(".card").first.wait_for()
    page.get_by_role("tab", name="Parallel coordinates").click()
    axis = page.locator("[data-brush=reach]").bounding_box()
    x, top = axis["x"] + axis["width"] / 2, axis["y"]
    page.mouse.move(x, top + 0.5 * axis["height"])
    page.mouse.down()
    page.mouse.move(x, top + 0.8 * axis["height"])
    page.mouse.move(x, top + axis["height"] + 9)
    page.mouse.up()
    page.wait_for_url(re.compile(r"reach=1\.27.*\.\.1\.5"))
    page.locator("rect.chosen").wait_for()
    picture(page, "parallel-coordinates")
    shown = int(page.get_by_text("robots pass the filter").inner_text().split()[0])
    assert 0 < shown < 30
    assert page.locator(".parallel .lines a").count() == shown
    page.mouse.click(x, top + 0.2 * axis["height"])
    page.get_by_text("30 of 30 robots pass the filter").wait_for()
    page.wait_for_function("!location.search.includes('reach')")
    page.locator(".parallel .lines a").first.dispatch_event("click")
    page.wait_for_url(re.compile(r"\?robot=robots/prims/prims-0000"))
    assert page.failures == []
