"""Contact sheets, and galleries at one scale."""

import base64
import io
import math
import re
import shutil

import pytest
from PIL import Image

from morphgen.grammar.grammar_file import find_grammar, grammar_text, load_grammar
from morphgen.grammar.library import default_library
from morphgen.grammar.robot_set import SetConfig, make_serially, make_set
from morphgen.viewer.gallery import Cell, card, contact_sheet
from morphgen.viewer.robot_rows import Row


def picture(colour):
    content = io.BytesIO()
    Image.new("RGB", (240, 180), colour).save(content, "PNG")
    return "data:image/png;base64," + base64.b64encode(content.getvalue()).decode()


def sheet(cells, height=1.0, suffix="png"):
    return contact_sheet("a $set", cells, height, suffix)


def red_pixels(content):
    image = Image.open(io.BytesIO(content)).convert("RGB")
    return sum(n for n, colour in image.getcolors(2**24) if colour == (255, 0, 0))


def test_a_smaller_robot_has_a_smaller_picture():
    whole = red_pixels(sheet([Cell(picture("red"), "big", "")]))
    half = red_pixels(sheet([Cell(picture("red"), "small", "", 0.5)]))
    assert half / whole == pytest.approx(0.25, abs=0.01)


def test_sheets_are_png_or_pdf_and_the_same_each_time():
    cells = [Cell(picture("red"), f"robot <{i}> $x", "1 kg") for i in range(7)]
    cells.append(Cell("", "without picture", ""))
    assert sheet(cells)[:8] == b"\x89PNG\r\n\x1a\n"
    assert sheet(cells, math.nan, "pdf")[:5] == b"%PDF-"
    assert sheet(cells) == sheet(cells)
    assert sheet(cells, suffix="pdf") == sheet(cells, suffix="pdf")


def test_cards_shrink_their_pictures():
    row = Row("a", "robots/a")
    assert "transform" not in card(row, "data:,", "")
    assert "transform:scale(0.500)" in card(row, "data:,", "", 0.5)


@pytest.fixture
def arms(folder):
    """A set of arms of different sizes."""
    library = default_library()
    grammar = load_grammar(find_grammar("arm3", library.folders), library.folders)
    path, text = folder / "robots" / "arms", grammar_text(grammar)
    make_set(SetConfig(path, "arm3", text, 0, (), True, False, ()), 6, make_serially)
    yield path
    shutil.rmtree(path)


@pytest.mark.slow
def test_a_set_is_shown_at_one_scale_and_downloaded_as_a_sheet(see, arms):
    page = see("?gallery=robots/arms")
    page.get_by_text(re.compile("a card is .* m high")).wait_for()
    page.wait_for_function("""() => {
        const pictures = [...document.querySelectorAll(".card img")];
        return new Set(pictures.map((each) => each.style.transform)).size == 6;
    }""")
    page.get_by_text("Contact sheet").click()
    with page.expect_download() as download:
        page.get_by_role("button", name="Download as PNG").click()
    assert Image.open(download.value.path()).width > 800
    assert download.value.suggested_filename == "robots-arms.png"
    page.goto(f"{page.url}&scale=own")
    page.locator(".card img").first.wait_for()
    assert page.get_by_text(re.compile("a card is")).count() == 0
