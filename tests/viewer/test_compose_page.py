"""The compose page in a browser."""

import re

import pytest

from morphgen.formats.bundle import read_bundle

pytestmark = pytest.mark.slow


def choose(page, label, option, nth=0):
    field = page.get_by_text(label, exact=True).nth(nth)
    field.locator("xpath=ancestor::*[.//input][1]//input").first.click()
    page.get_by_role("option", name=option, exact=True).click()


def test_chosen_parts_become_compose_arguments(see, picture):
    page = see("?compose=arm=arm3 ee=plane")
    page.get_by_text(re.compile("5 DoF|6 DoF")).first.wait_for()
    slider = page.get_by_text("length (m)", exact=True)
    slider.locator("xpath=ancestor::*[.//input][1]//input").last.fill("0.45")
    page.wait_for_url(re.compile(r"arm\.length=0\.45"))
    page.get_by_role("tab", name="Get").click()
    page.get_by_text("morphgen compose base=fixed arm=arm3 ee=plane arm.length=0.45").wait_for()
    picture(page)
    assert page.failures == []


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
    name = page.get_by_text("name", exact=True)
    name.locator("xpath=ancestor::*[.//input][1]//input").fill("by-hand")
    page.get_by_role("button", name="Write to robots/").click()
    page.get_by_text("Written", exact=True).wait_for()
    assert read_bundle(folder / "robots" / "by-hand").name == "by-hand"
    assert (folder / "robots" / "by-hand" / "preview.png").is_file()


def test_grammar_is_edited_sampled_and_stepped_through(see, picture):
    page = see("?compose=planar_arm")
    page.get_by_text("Derivation").first.wait_for()
    page.get_by_role("button", name="next").click()
    page.wait_for_url(re.compile(r"seed=0&number=1"))
    page.get_by_text("planar_arm-000001").wait_for()
    picture(page)
    text = page.locator("textarea").first
    whole = text.input_value()
    text.fill(whole.replace("->", "-> nosuchpart |", 1))
    page.get_by_text(re.compile(r"planar_arm:\d+:\d+")).first.wait_for()
    text.fill(whole)
    page.get_by_text(re.compile(r"planar_arm:\d+:\d+")).first.wait_for(state="detached")
    steps = page.get_by_text("parts shown", exact=True)
    steps.locator("xpath=ancestor::*[.//input][1]//input").last.fill("1")
    page.locator("pre .dim").first.wait_for()
    assert page.failures == []


def test_edited_grammar_is_kept_in_the_url(see):
    page = see("?compose=planar_arm")
    page.get_by_text("Derivation").first.wait_for()
    text = page.locator("textarea").first
    edited = f"# my own\n{text.input_value()}"
    text.fill(edited)
    page.wait_for_url(re.compile(r"compose=planar_arm&text=[\w-]+$"))
    page.get_by_role("button", name="next").click()
    page.wait_for_url(re.compile(r"seed=0&number=1&text="))
    page.reload()
    page.get_by_text("planar_arm-000001").wait_for()
    assert page.locator("textarea").first.input_value() == edited
    text.fill(edited + "".join(f"# {i**9:x}\n" for i in range(1000)))
    page.get_by_text(re.compile("too long for the page's address")).wait_for()
    page.wait_for_url(re.compile(r"compose=planar_arm$"))
