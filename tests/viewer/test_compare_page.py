"""The compare page in a browser."""

import re

import pytest

pytestmark = pytest.mark.slow


def node(viewer, name):
    (session,) = viewer.sessions.values()
    return session.client.scene._handle_from_node_name[name]


def test_robots_are_compared(see, viewer, picture):
    on = viewer()
    page = see("?compare=words:base=gantry ee=plane&compare=robots/some-arm", on=on)
    page.get_by_text("Similarity").wait_for()
    page.get_by_text(re.compile("gantry-plane and arm")).wait_for()
    picture(page, "compare")
    page.get_by_role("tab", name="Move").click()
    before = [node(on, f"/robot{i}/2").position.copy() for i in range(2)]
    row = page.get_by_text("joint 1", exact=True).locator("xpath=ancestor::*[.//input][1]")
    row.locator("input").last.fill("0.9")
    page.wait_for_timeout(1500)
    after = [node(on, f"/robot{i}/2").position for i in range(2)]
    assert all(abs(a - b).max() > 0.01 for a, b in zip(after, before, strict=True))
    assert page.failures == []


def test_primitives_are_coloured_by_their_iou(see, viewer, picture):
    on = viewer()
    page = see("?compare=words:arm=ur5 ee=plane", on=on)
    page.get_by_role("tab", name="Primitives").click()
    page.get_by_role("checkbox").first.click()
    page.get_by_text("IoU", exact=True).wait_for()
    page.get_by_role("cell", name="arm_forearm_link").wait_for()
    picture(page)
    assert not node(on, "/robot0/3/visual0").visible
