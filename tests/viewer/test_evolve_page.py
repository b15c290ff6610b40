"""Authoring in a browser: the ghost, the editor of grammars, and evolution."""

import re

import numpy as np
import pytest

from morphgen.formats.bundle import read_bundle
from morphgen.viewer.scene.stage import camera_view, project_points

pytestmark = pytest.mark.slow


def camera_distance(viewer):
    (session,) = viewer.sessions.values()
    camera = session.client.camera
    return float(sum((camera.position - camera.look_at) ** 2) ** 0.5)


def test_the_camera_follows_a_robot_that_outgrows_the_view(see, viewer, control, picture):
    on = viewer()
    page = see("?compose=arm=arm3 ee=plane arm.length=0.1", on=on)
    page.get_by_text("DoF").first.wait_for()
    page.wait_for_timeout(1000)
    before = camera_distance(on)
    control.input(page, "length (m)").last.fill("0.5")
    page.get_by_text(re.compile(r"changed: reach 0\.\d\d to 1\.\d\d m, mass \+")).wait_for()
    page.wait_for_function("true")
    page.wait_for_timeout(1000)
    assert camera_distance(on) > 1.5 * before
    (session,) = on.sessions.values()
    robots = [
        n for n in session.client.scene._handle_from_node_name if re.fullmatch(r"/robot\d", n)
    ]
    assert len(robots) == 2  # the robot and the ghost of the one before
    picture(page, "compose-ghost")
    control.input(page, "length (m)").last.fill("0.25")
    page.wait_for_url(re.compile(r"arm\.length=0\.25$"))
    assert page.failures == []


def test_the_grammar_is_redrawn_while_typing_and_marks_errors_in_place(see, picture):
    page = see("?compose=planar_arm")
    page.get_by_text("DoF").first.wait_for()
    text = page.locator("textarea").first
    assert "monospace" in text.evaluate("each => getComputedStyle(each).fontFamily")
    whole = text.input_value()
    text.fill(whole.replace("uniform(0.1, 0.5)", "uniform(0.4, 0.5)"))
    page.get_by_text(re.compile(r"changed: ")).wait_for()
    wrong = whole.replace("->", "-> nosuchpart |", 1)
    text.fill(wrong)
    mark = page.locator("#morphgen-mark")
    mark.wait_for(state="attached")
    line = wrong[: wrong.index("nosuchpart")].count("\n")
    place = text.evaluate(
        """(each, line) => {
            const mark = document.getElementById("morphgen-mark").style, is = parseFloat;
            const style = getComputedStyle(each), height = is(style.lineHeight);
            const rows = (is(mark.top) - each.offsetTop - is(style.paddingTop) + each.scrollTop);
            return [rows / height, is(mark.width)];
        }""",
        line,
    )
    assert place[0] == pytest.approx(line, abs=0.05)
    assert place[1] > 10
    picture(page, "compose-grammar-error")
    text.fill(whole)
    mark.wait_for(state="detached")


def test_robots_are_mutated_and_adopted(see, viewer, folder, picture):
    on = viewer()
    page = see("?compose=planar_arm&seed=0&number=1", on=on)
    page.get_by_text("planar_arm-000001").first.wait_for()
    page.get_by_role("tab", name="Evolve").click()
    page.get_by_role("button", name="mutants").click()
    adopt = page.locator("[data-do=adopt]")
    adopt.nth(8).wait_for()
    page.wait_for_url(re.compile(r"compose=planar_arm&choices=[\w-]+&evolve=1&tab=Evolve$"))
    picture(page, "evolve")
    adopt.nth(3).click()
    page.wait_for_url(re.compile(r"evolve=2&tab=Evolve$"))
    adopted = page.locator("h3").first.inner_text()
    assert re.fullmatch(r"planar_arm-[0-9a-f]{8}", adopted)
    page.reload()
    adopt.nth(8).wait_for(state="attached")
    (session,) = on.sessions.values()
    assert "/offspring8" in session.client.scene._handle_from_node_name
    page.get_by_role("heading", name=adopted).wait_for()
    page.get_by_role("tab", name="Get").click()
    page.get_by_role("button", name="Write to robots/").click()
    page.get_by_text("Written", exact=True).wait_for()
    assert read_bundle(folder / "robots" / adopted).name == adopted
    assert page.failures == []


def test_a_click_in_the_scene_adopts_a_robot(see, viewer):
    on = viewer()
    page = see("?compose=prims&seed=0&number=2", on=on)
    page.get_by_text("prims-000002").first.wait_for()
    page.get_by_role("tab", name="Evolve").click()
    page.get_by_role("button", name="mutants").click()
    page.locator("[data-do=adopt]").nth(8).wait_for()
    page.wait_for_url(re.compile(r"evolve=1&tab=Evolve$"))
    page.wait_for_timeout(1500)
    (session,) = on.sessions.values()
    node = session.client.scene._handle_from_node_name["/offspring4"]
    view = camera_view(session.client)
    (x, y), _ = project_points(view, node.position + np.array([0.0, 0.0, 0.5]))
    box = page.locator("canvas").last.bounding_box()
    page.mouse.click(box["x"] + x * box["height"], box["y"] + y * box["height"])
    page.wait_for_url(re.compile(r"evolve=2&tab=Evolve$"))


def test_a_robot_from_words_evolves(see, picture):
    page = see("?compose=base=gantry ee=cube")
    page.get_by_role("tab", name="Evolve").click()
    page.get_by_text("This robot has no grammar").wait_for()
    page.get_by_role("button", name="mutants").click()
    adopt = page.locator("[data-do=adopt]")
    adopt.nth(8).wait_for()
    picture(page, "evolve-words")
    page.wait_for_url(re.compile(r"compose=base=gantry%20ee=cube&choices=[\w-]+&evolve=1"))
    page.reload()
    adopt.nth(8).wait_for(state="attached")
    page.locator('[role=tab][aria-selected=true][title="Evolve"]').wait_for()
    adopt.nth(0).click()
    page.get_by_role("heading", name=re.compile(r"cube-[0-9a-f]{8}")).wait_for()
    assert page.failures == []
