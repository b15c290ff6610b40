"""The population page: its pointer, its addresses, and its actions."""

import pytest

from helpers.pages import nodes, pointer
from helpers.viser_client import PlainClient


def test_clicks_rectangles_and_buttons_select_robots(viewer):
    on = viewer()
    query = "?population=robots/prims&arrange=reach&joint1=0.25&select=2,4-5"
    with PlainClient(on.port, query) as client:
        client.shows("3 selected")
        client.until(lambda: client.addresses[-1] == (0, query))
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
        client.change(client.control("Button", "Home"))
        client.until(lambda: "joint1" not in client.addresses[-1][1])
        whole = {"event_type": "rect-select", "screen_pos": [[-99.0, -99.0], [99.0, 99.0]]}
        rays = {"modifier": "shift", "ray_origin": None, "ray_direction": None}
        client.send({"type": "ScenePointerMessage", **whole, **rays})
        client.shows("30 selected")
        client.change(client.control("ButtonGroup", "Select"), "none")
        client.until(lambda: "select" not in client.addresses[-1][1])
        client.change(client.control("Button", "Choose"))
        client.shows("no robot is selected: drag a rectangle")


@pytest.mark.slow
def test_the_page_is_covered_until_its_content_is_there(see, picture):
    page = see("?population=robots/prims")
    assert page.locator("#morphgen-cover").count() == 1
    page.locator("#morphgen-cover").wait_for(state="detached")
    page.get_by_text("no robot is selected").wait_for()
    picture(page, "population")
    assert page.failures == []
