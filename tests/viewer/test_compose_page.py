"""The compose page in a browser: parts, grammars, and the ghost."""

import re

import pytest

from helpers.pages import choose, field, nodes, press
from morphgen.formats.bundle import read_bundle

pytestmark = pytest.mark.slow


def test_parts_that_do_not_fit_show_an_error_and_keep_the_robot(see):
    page = see("?compose=base=gantry ee=stick")
    page.get_by_text("DoF").first.wait_for()
    choose(page, "ee", "(none)", nth=1)
    page.get_by_text(re.compile("nothing to compose")).wait_for()
    assert page.get_by_text("gantry-stick").is_visible()


def test_robot_is_written_to_a_bundle(see, folder):
    page = see("?compose=base=planar ee=cube")
    page.get_by_text("DoF").first.wait_for()
    page.get_by_role("tab", name="Get").click()
    field(page, "name").fill("by-hand")
    press(page, "Write to robots/")
    page.get_by_text("Written", exact=True).wait_for()
    assert read_bundle(folder / "robots" / "by-hand").name == "by-hand"
    assert (folder / "robots" / "by-hand" / "preview.png").is_file()


def test_grammar_is_edited_sampled_and_stepped_through(see, picture):
    page = see("?compose=planar_arm")
    page.get_by_text("Derivation").first.wait_for()
    press(page, "next")
    page.wait_for_url(re.compile(r"seed=0&number=1"))
    page.get_by_text("planar_arm-000001").wait_for()
    picture(page)
    text = page.locator("textarea").first
    whole = text.input_value()
    text.fill(whole.replace("->", "-> nosuchpart |", 1))
    page.get_by_text(re.compile(r"planar_arm:\d+:\d+")).first.wait_for()
    text.fill(whole)
    page.get_by_text(re.compile(r"planar_arm:\d+:\d+")).first.wait_for(state="detached")
    field(page, "parts shown").last.fill("1")
    page.locator("pre .dim").first.wait_for()
    assert page.failures == []


def test_edited_grammar_is_kept_in_the_url(see):
    page = see("?compose=planar_arm")
    page.get_by_text("Derivation").first.wait_for()
    text = page.locator("textarea").first
    edited = f"# my own\n{text.input_value()}"
    text.fill(edited)
    page.wait_for_url(re.compile(r"compose=planar_arm&text=[\w-]+$"))
    press(page, "next")
    page.wait_for_url(re.compile(r"text=[\w-]+&seed=0&number=1$"))
    page.reload()
    page.get_by_text("planar_arm-000001").wait_for()
    assert page.locator("textarea").first.input_value() == edited
    text.fill(edited + "".join(f"# {i**9:x}\n" for i in range(1000)))
    page.get_by_text(re.compile("too long for the page's address")).wait_for()
    page.wait_for_url(re.compile(r"compose=planar_arm$"))


def camera_distance(viewer):
    (session,) = viewer.sessions.values()
    camera = session.client.camera
    return float(sum((camera.position - camera.look_at) ** 2) ** 0.5)


def test_the_camera_follows_a_robot_that_outgrows_the_view(see, viewer, picture):
    on = viewer()
    page = see("?compose=arm=arm3 ee=plane arm.length=0.1", on=on)
    page.get_by_text("DoF").first.wait_for()
    page.wait_for_timeout(1000)
    before = camera_distance(on)
    field(page, "length (m)").last.fill("0.5")
    page.get_by_text(re.compile(r"changed: reach 0\.\d\d to 1\.\d\d m, mass \+")).wait_for()
    page.wait_for_function("true")
    page.wait_for_timeout(1000)
    assert camera_distance(on) > 1.5 * before
    robots = [name for name in nodes(on) if re.fullmatch(r"/robot\d", name)]
    assert len(robots) == 2  # the robot and the ghost of the one before
    picture(page, "compose-ghost")
    field(page, "length (m)").last.fill("0.25")
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
    assert text.evaluate("each => each.scrollWidth <= each.clientWidth")  # long rules wrap
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
