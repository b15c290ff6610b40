"""Plots beside numbers that move: curves of an episode, histograms of a gallery."""

import re

import numpy as np
import pytest

from helpers.robots import arm
from helpers.viser_client import PlainClient
from morphgen.tasks.registry import TASKS
from morphgen.viewer.episode import Episode, Track, score_until
from morphgen.viewer.figures import histogram_svg
from morphgen.viewer.pages.play import curves


def track(num_steps):
    """A robot whose distance falls from 1 m."""
    values = [1 - 0.1 * i for i in range(num_steps)]
    q = [np.zeros(4)] * (num_steps + 1)
    return Track(arm(), "x", None, q=q, score=values, distance=values, success=[False] * num_steps)


def episode(*num_steps):
    return Episode("reach", "zero", 0, False, "mujoco", 0.02, [track(n) for n in num_steps])


def test_curves_have_distance_score_and_a_line_at_the_step():
    scores = [[], []]
    distances, totals = curves(episode(5, 3), 2, scores)
    assert distances[0] == pytest.approx(0.02 * np.arange(1, 6))
    assert distances[1] == pytest.approx([1, 0.9, 0.8, 0.7, 0.6])
    assert distances[2] == pytest.approx([1, 0.9, 0.8, 0.8, 0.8])  # it ended after three steps
    assert distances[3] == pytest.approx([0.6, 1, 0.6, 0.6, 0.6])
    expected = [score_until(track(5), "reach", i) for i in range(1, 6)]
    assert totals[1] == pytest.approx(expected)
    assert len(totals) == 4


def test_curves_continue_the_scores_that_are_known():
    scores = [[7.0]]
    _, totals = curves(episode(3), 1, scores)
    assert totals[1][0] == 7.0
    assert len(scores[0]) == 3


def test_curves_are_finite_before_the_first_step():
    for data in curves(episode(0, 0), 0, [[], []]):
        assert all(np.isfinite(line).all() for line in data)
        assert {len(line) for line in data} == {1}


def test_a_histogram_counts_all_values_and_greys_those_outside_the_range():
    svg = histogram_svg([0.0, 0.1, 0.1, 1.0], (0.0, 1.0), (0.0, 0.5))
    counts = [int(text) for text in re.findall(r"<title>(\d+) robots", svg)]
    assert sum(counts) == 4
    assert max(counts) == 2
    colours = [text.split('"')[0] for text in svg.split('fill="')[1:]]
    assert len(set(colours[:20])) == 1
    assert set(colours[21:]) == {"#adb5bd88"}
    assert colours[0] != colours[-1]


def test_a_gallery_shows_the_distributions_of_its_facts(viewer):
    with PlainClient(viewer().port, "?gallery=robots/prims") as client:
        client.control("MultiSlider", "Reach (m)")
        client.shows("robots from")


@pytest.mark.slow
def test_an_episode_has_curves_under_the_time_slider(see, picture):
    page = see("?play=reach&robot=robots/some-arm&policy=jacobian")
    page.get_by_text(f"m from {TASKS['reach'].target}").first.wait_for()
    page.locator(".uplot canvas").nth(1).wait_for()
    page.wait_for_function(
        "Object.values(window.__viserTestpoints?.uplots ?? {}).some("
        "(plot) => plot.chart.data[0].length > 50)"
    )
    picture(page, "curves")
    assert page.failures == []
