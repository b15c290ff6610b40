"""Merging rigidly connected links keeps motion and contacts."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.robots import arm
from helpers.scenes import robot
from morphgen.checks.self_collision import untested_pairs
from morphgen.model.dynamics import mass_matrix
from morphgen.model.geometry import Pose
from morphgen.model.robot import Inertial, Joint, Link
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.registry import SIMULATORS
from morphgen.tasks.scenes.env_specs import load_robot
from morphgen.tasks.sim.base import Scene
from morphgen.tasks.sim.rigid_bodies import merge_rigid_links


@pytest.mark.parametrize("request_", ["arm=ur5 ee=plane", "arm=panda ee=panda_hand", "chain"])
def test_merged_links_move_like_separate_ones(request_):
    body = robot(request_)
    merged = merge_rigid_links(body)
    rng = np.random.default_rng(0)
    for q in rng.normal(size=(3, body.dof)):
        np.testing.assert_allclose(mass_matrix(merged, q), mass_matrix(body, q), atol=1e-9)
    shapes = sum(len(link.collisions) for link in body.links)
    assert sum(len(link.collisions) for link in merged.links) == shapes
    assert len(merged.links) <= len(body.links)
    assert merged.home == body.home


@pytest.mark.parametrize("simulator", ["pybullet", "mujoco"])
@pytest.mark.parametrize("mass", [0.0, 5.0])
@pytest.mark.parametrize("shifted", [False, True])
def test_a_massive_link_may_be_welded_to_a_root_named_world(simulator, mass, shifted):
    if simulator == "pybullet":
        pytest.importorskip("pybullet", reason="PyBullet is not installed")
    body = arm()
    world = Link("world", Inertial(mass) if mass else None)
    weld = Joint("weld", "fixed", "world", body.root.name, Pose((0, 0, 0.5 * shifted)))
    body = replace(body, links=(world, *body.links), joints=(weld, *body.joints))
    simulation = SIMULATORS[simulator].load([Scene(body)], None, 1, torch.device("cpu"))
    assert not simulation.step(simulation.q.clone()).any()
    simulation.close()


def test_links_with_different_ignored_pairs_are_not_merged():
    """A fixed finger with other ignored pairs than its palm stays a separate body."""
    body = arm()
    fixed = replace(body.joints[3], kind="fixed", limits=None)
    moving = replace(body.joints[4], mimic=None)
    joints = (*body.joints[:3], fixed, moving)
    body = replace(body, joints=joints, ignore_pairs=(("base", "left"),))
    assert {"left", "slider"} <= {link.name for link in merge_rigid_links(body).links}
    joined = merge_rigid_links(replace(body, ignore_pairs=()))
    assert "left" not in {link.name for link in joined.links}
    assert joined.mass == pytest.approx(body.mass)


def test_adjacent_links_are_ignored_without_ignore_pairs():
    made = load_robot("arm3-stick")
    bare = replace(made, ignore_pairs=())
    assert set(untested_pairs(bare)) <= set(untested_pairs(made)) == set(made.ignore_pairs)
    _, tried = FreeSpace(Scene(bare, ground=-1.0)).sample(20, np.random.default_rng(0))
    assert tried < 200
