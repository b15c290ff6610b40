"""Straight paths of the joints are tested in the current scene of each environment."""

from dataclasses import replace

import numpy as np
import torch

from helpers.scenes import ball
from morphgen.model.geometry import Pose
from morphgen.tasks.batch_observation import SAME, StraightPaths
from morphgen.tasks.sim.base import Block, Scene

START, BEHIND, BESIDE = np.array([-0.5, 0.0]), np.array([0.5, 0.0]), np.array([-0.5, 0.5])


class Layouts:
    """Two environments of a ball on slides along x and y; in the first there is a wall."""

    wall = Block((0.2, 0.4, 0.4), Pose((0.0, 0.0, 0.2)))

    def obstacles(self, env):
        return (self.wall,) if env == 0 else ()

    def scene(self, env):
        return Scene(ball(0.2), obstacles=self.obstacles(env))


def test_the_first_end_with_a_free_path_is_found():
    first_free = StraightPaths(Layouts(), torch.tensor([0, 1]))
    assert first_free(0, START, np.array([BEHIND, BESIDE])) == 1
    assert first_free(0, START, np.array([BEHIND, BEHIND + SAME / 2, BESIDE])) == 2
    assert first_free(0, START, BEHIND[None]) is None
    assert first_free(0, START, np.zeros((0, 2))) is None
    assert first_free(1, START, np.array([BEHIND, BESIDE])) == 0


def test_obstacles_count_where_they_are_now():
    layouts = Layouts()
    first_free = StraightPaths(layouts, torch.tensor([0]))
    assert first_free(0, START, BEHIND[None]) is None
    layouts.wall = replace(layouts.wall, pose=Pose((0.0, 2.0, 0.2)))
    assert first_free(0, START, BEHIND[None]) == 0


def test_padding_of_configurations_is_ignored():
    first_free = StraightPaths(Layouts(), torch.tensor([0]))
    padded = np.array([[*BEHIND, 0.0], [*BESIDE, 0.0]])
    assert first_free(0, np.array([*START, 9.0]), padded) == 1
