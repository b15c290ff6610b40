"""Pictures of similarity are reproducible and complete."""

import io

import matplotlib
import numpy as np
import pytest
from matplotlib.text import Text
from PIL import Image

from morphgen.benchmark import figures
from morphgen.benchmark.figures import map_png
from morphgen.encoding.similarity import classical_mds


def names(n):
    return [f"arm-{i:06d}" if i % 3 else f"hand_{i}" for i in range(n)]


def matrices(n):
    points = np.random.default_rng(0).random((n, 3))
    return {"tree": np.linalg.norm(points[:, None] - points, axis=-1)}


def groups(n):
    return [f"{i % 3 + 4} DoF" for i in range(n)]


def drawing(n):
    return map_png(names(n), matrices(n), groups(n))


def pixels(png):
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), dtype=int)


@pytest.mark.parametrize("n", [1, 2, 16, 61])
def test_pictures_of_any_number_of_robots_are_reproducible_and_hold_no_version(n):
    png = drawing(n)
    assert drawing(n) == png
    assert pixels(png).std() > 5
    assert max(pixels(png).shape) < 2000
    assert Image.open(io.BytesIO(png)).info.keys() <= {"dpi"}
    assert matplotlib.__version__.encode() not in png


def test_matplotlib_settings_of_the_user_do_not_change_pictures():
    before = drawing(5)
    with matplotlib.rc_context({"font.size": 20, "axes.facecolor": "red", "savefig.dpi": 30}):
        assert drawing(5) == before
        assert matplotlib.rcParams["font.size"] == 20


def test_names_are_not_parsed_as_formulas():
    odd = ["$\\frac$", "a_b", "$", "\\alpha"]  # the first would be refused as one
    assert map_png(odd, matrices(4), odd)


@pytest.fixture
def drawn(monkeypatch):
    """Return a function that draws a map and returns its figure."""

    def draw(n, groups):
        kept = []
        monkeypatch.setattr(figures, "_png", lambda figure: kept.append(figure) or b"")
        map_png(names(n), matrices(n), groups)
        return kept[0]

    return draw


@pytest.mark.parametrize("n", [10, 40])
def test_a_map_has_names_that_cover_neither_each_other_nor_points(n, drawn):
    figure = drawn(n, groups(n))
    (ax,) = figure.axes
    renderer = figure.canvas.get_renderer()
    for text in ax.texts:
        text.update_positions(renderer)
    boxes = [Text.get_window_extent(text, renderer) for text in ax.texts]  # without arrows
    points = ax.transData.transform(np.vstack([each.get_offsets() for each in ax.collections]))
    assert len(boxes) == (10 if n == 10 else 0)
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])
    assert not any(box.contains(*point) for box in boxes for point in points)


def test_a_map_names_its_axes_and_its_groups(drawn):
    figure = drawn(40, ["4 DoF"] * 10 + ["6 DoF"] * 30)
    (ax,) = figure.axes
    first, second = classical_mds(matrices(40)["tree"]).shares
    assert f"{first:.0%}" in ax.get_xlabel()
    assert f"{second:.0%}" in ax.get_ylabel()
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts == ["6 DoF (30)", "4 DoF (10)"]
    colours = {tuple(each.get_facecolor()[0]) for each in ax.collections}
    assert len(colours) == 2
    legend = figure.legends[0].get_window_extent(figure.canvas.get_renderer())
    assert not legend.overlaps(ax.bbox)


def test_of_many_groups_the_largest_have_a_colour(drawn):
    figure = drawn(60, [f"{min(i, 30)} DoF" for i in range(60)])
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts[0] == "13 smaller groups (13)"
    assert texts[1] == "30 DoF (30)"
    styles = {
        (tuple(each.get_facecolor()[0]), each.get_paths()[0].vertices.shape)
        for each in figure.axes[0].collections
    }
    assert len(styles) == len(texts) == 19
