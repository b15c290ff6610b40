"""The population page: its pointer, its addresses, and its actions."""

import re

import numpy as np
import pytest

from helpers.pages import field, nodes, pointer, press
from helpers.viser_client import PlainClient
from morphgen.viewer.scene.stage import camera_view, project_points


def wait_until_shown(page):
    page.get_by_text("no robot is selected").or_(
        page.get_by_text(re.compile(r"\d selected"))
    ).wait_for()


def test_a_click_selects_a_robot_and_one_with_shift_adds_another(viewer):
    on = viewer()
    with PlainClient(on.port, "?population=robots/prims&joint1=0.25") as client:
        client.shows("no robot is selected")
        batches = client.until(
            lambda: [m for m in client.messages if m["type"] == "BatchedMeshesMessage"]
        )
        click = pointer("Click", batches[0], instance_index=0)
        for index in (-1, 10**6, None):
            client.send({**click, "instance_index": index})
        client.send(click)
        client.shows("1 selected")
        client.shows("joint1=0.25&select=0")
        last = len(nodes(on)[batches[0]["name"]].batched_positions) - 1
        client.send({**click, "instance_index": last, "modifier": "shift"})
        client.shows("2 selected")
        client.change(client.control("ButtonGroup", "Select"), "invert")
        client.shows("28 selected")
        client.change(client.control("Button", "Choose"))
        client.shows("28 chosen")


@pytest.mark.slow
def test_a_click_of_the_pointer_selects_the_robot_under_it(see, viewer, picture):
    on = viewer()
    page = see("?population=robots/prims", on=on)
    wait_until_shown(page)
    page.wait_for_timeout(3000)
    picture(page, "population")
    (session,) = on.sessions.values()
    position = np.array(nodes(on)["/population/0"].batched_positions[7], dtype=float)
    (x, y), _ = project_points(camera_view(session.client), position)
    box = page.locator("canvas").first.bounding_box()
    page.mouse.click(box["x"] + x * box["height"], box["y"] + y * box["height"])
    page.get_by_text("1 selected").wait_for()
    link = page.get_by_role("link", name=re.compile("^prims-0"))
    name = link.inner_text()
    link.click()
    page.wait_for_url(re.compile(f"robot=robots/prims/{name}"))
    assert page.failures == []


@pytest.mark.slow
def test_a_rectangle_selects_and_the_address_keeps_arrangement_and_selection(see):
    page = see("?population=robots/prims&arrange=reach")
    wait_until_shown(page)
    field(page, "joint 1").last.fill("0.25")
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
    press(page, "invert")
    page.get_by_text("no robot is selected").wait_for()
    page.goto(re.sub("$", "&select=2,4-5", page.url))
    page.get_by_text("3 selected").wait_for()
    assert all(part in page.url for part in ("arrange=reach", "joint1=0.25"))
    press(page, "Home")
    page.wait_for_url(re.compile(r"arrange=reach&select=2,4-5$"))


@pytest.mark.slow
def test_the_page_is_covered_until_its_content_is_there(see):
    page = see("?library=")
    assert page.locator("#morphgen-cover").count() == 1
    page.locator("#morphgen-cover").wait_for(state="detached")
    page.locator(".card").first.wait_for()
