"""Layouts of the obstacles of a goal set."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.goal_sets import CONFIG, LIFTED, sample_goals
from morphgen.errors import BenchmarkError
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.scenes import obstacles
from morphgen.tasks.scenes.obstacles import (
    draw_boxes,
    draw_layouts,
    layouts_of,
    place_boxes,
)
from morphgen.tasks.sim.base import Scene


def layouts_in(body, count=8, size=(0.5, 0.7), usable=lambda space: np.ones(1, bool)):
    boxes = draw_boxes(body, count, size, np.random.default_rng(0))
    space = FreeSpace(Scene(body, obstacles=boxes, ground=LIFTED))
    return draw_layouts(space, (1, 1), np.random.SeedSequence(0), usable)


def test_obstacles_that_block_too_much_space_are_redrawn(body, monkeypatch):
    boxes = draw_boxes(body, 8, (0.5, 0.7), np.random.default_rng(0))

    def left(share):
        monkeypatch.setattr(obstacles, "KEPT", share)
        layouts, _ = layouts_in(body)
        q, _ = FreeSpace(Scene(body, ground=LIFTED)).sample(200, np.random.default_rng(1))
        placed = place_boxes(boxes, layouts[0])
        return FreeSpace(Scene(body, obstacles=placed, ground=LIFTED)).free(q).mean()

    assert left(0.0) < 0.6
    assert left(0.7) > 0.6


def test_layouts_do_not_depend_on_the_numbers_of_goals_and_layouts(body, cache):
    config = replace(CONFIG, num_goals=30)
    more = replace(config, num_goals=60, train_layouts=5, eval_layouts=4)
    small, large = (sample_goals(body, cache, obstacles=True, config=one) for one in (config, more))
    assert small.obstacles == large.obstacles
    for side in ("train", "eval"):
        few, many = layouts_of(config, side), layouts_of(more, side)
        np.testing.assert_array_equal(
            small.layouts[few], large.layouts[many][: len(few)], err_msg=side
        )
        np.testing.assert_array_equal(small.usable[few], large.usable[many][: len(few), :30])
    assert len(np.unique(large.layouts[:, 0], axis=0)) == 9
    assert (large.layouts == large.layouts.astype(np.float32)).all()


def test_a_layout_without_goals_is_an_error(body):
    def usable(space):
        return np.arange(40) >= 16  # 4 of the first 20, of which 5 are needed

    with pytest.raises(BenchmarkError, match=r"of its first 20 goals only 4 or fewer"):
        layouts_in(body, 1, (0.05, 0.1), usable=usable)
