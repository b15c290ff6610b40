"""Layouts of obstacles over episodes: which are drawn, and that everything follows them."""

import numpy as np
import pytest
import torch

from helpers.goal_sets import draw_spec
from helpers.resets import reset_envs
from helpers.scenes import robot
from morphgen.errors import TaskError
from morphgen.model.geometry import Pose
from morphgen.rl.baselines.ik import InverseKinematics
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.observation import NOISE, ObservationConfig
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.render.renderer import render_state
from morphgen.tasks.scenes.make import batch_from_specs
from morphgen.tasks.sim.base import Block, Scene
from morphgen.tasks.sim.mujoco_sim import MujocoSimulation

REACH = ReachConfig(num_goals=20, train_layouts=4, eval_layouts=2)
PUSH = PushConfig(num_goals=20, train_layouts=4, eval_layouts=2)


def in_pybullet(scenes):
    """Create a PyBullet simulation; skip the test where PyBullet is missing."""
    pytest.importorskip("pybullet", reason="PyBullet has no wheel for this Python")
    from morphgen.tasks.sim.bullet import BulletSimulation

    return BulletSimulation(scenes)


SIMULATIONS = {
    "mujoco": lambda scenes: MujocoSimulation(scenes),
    "pybullet": in_pybullet,
}


@pytest.fixture(scope="module")
def specs(cache):
    arm, gantry = robot("arm3"), robot("prims")
    return {
        "reach": draw_spec(arm, REACH, obstacles=True, cache=cache),
        "push": draw_spec(gantry, PUSH, obstacles=True, cache=cache),
        "free": draw_spec(arm, REACH, cache=cache),
    }


@pytest.fixture
def build_batch(specs, opened):
    def make(*names, **options):
        chosen = [specs[name] for name in names]
        return opened(batch_from_specs(chosen, len(names), **{"sim": "mujoco", **options}))

    return make


@pytest.mark.parametrize(("side", "expected"), [("train", {0, 1, 2, 3}), ("eval", {4, 5})])
def test_episodes_draw_the_layouts_of_their_side(build_batch, side, expected):
    batch = build_batch("reach", "push", "free", layouts=side)
    drawn = []
    for _ in range(25):
        batch.reset()
        drawn.append(batch.layouts.current.tolist())
    reach, push, free = zip(*drawn, strict=True)
    assert set(reach) == set(push) == expected
    assert set(free) == {-1}
    assert reach != push


def test_unknown_layouts_are_rejected(build_batch):
    with pytest.raises(TaskError, match="unknown layouts 'test'; valid: train, eval"):
        build_batch("reach", layouts="test")


def test_starts_and_goals_are_free_in_their_layout(build_batch, specs):
    batch = build_batch("reach", "push")
    for _ in range(10):
        batch.reset()
        reach, push = (FreeSpace(batch.layouts.scene(env)) for env in (0, 1))
        goal = batch.groups["reach"].goal_configuration[0, : specs["reach"].robot.dof]
        start = batch.q[0, : specs["reach"].robot.dof]
        assert reach.free(torch.stack([goal, start]).double().numpy()).all()
        block = batch.simulation.block_pose[1:].double().numpy()
        assert push.free(batch.q[1:, : specs["push"].robot.dof].double().numpy(), block).all()
        assert push.block_is_clear(block).all()


def test_observations_and_pictures_follow_the_layout(build_batch):
    batch = build_batch("reach", "push", "free", observe=ObservationConfig(points=40))
    tokens = []
    for _ in range(6):
        seen = batch.reset()
        for env in (0, 1):
            layout = batch.specs[env].goals.layouts[batch.layouts.current[env]]
            poses = torch.from_numpy(layout).float()
            assert torch.equal(seen["obstacles"][env, :, :7], poses)
            assert torch.equal(batch.layouts.poses[env], poses)
            assert (render_state(batch, env).obstacles == poses.numpy()).all()
            boxes = batch.layouts.obstacles(env)
            assert [box.pose.position for box in boxes] == [
                tuple(row[:3]) for row in layout.tolist()
            ]
        distance = np.min(
            [_distance(seen["points"][0].double().numpy(), b) for b in batch.layouts.obstacles(0)],
            axis=0,
        )
        assert distance.max() < 6 * NOISE
        assert not seen["obstacles"][2].any()
        assert not seen["obstacle_mask"][2].any()
        tokens.append(seen["obstacles"].clone())
    assert not all(torch.equal(tokens[0], other) for other in tokens)
    sizes = {tuple(token[0, :, 10:].flatten().tolist()) for token in tokens}
    assert len(sizes) == 1


def _distance(points, box):
    """Return the distances of points from the surface of a box."""
    T = box.pose.inverse().matrix
    local = np.abs(points @ T[:3, :3].T + T[:3, 3]) - np.array(box.size) / 2
    return np.abs(local.max(axis=1))


@pytest.mark.parametrize("name", SIMULATIONS)
def test_a_simulated_robot_meets_obstacles_where_they_were_moved(name):
    """A cube with edges of 0.11 m on slides moves towards a wall."""
    wall = Block((0.1, 1.0, 1.0), Pose((5.0, 0.0, 0.5)))
    scene = Scene(robot("cubes"), obstacles=(wall,))
    simulation = SIMULATIONS[name]([scene] * 2)
    zeros, q = torch.zeros(2, 7), torch.zeros(2, 2)
    near, far = (torch.tensor([[[x, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0]]]) for x in (0.4, 5.0))

    def positions():
        for _ in range(60):
            simulation.step(torch.tensor([[0.9, 0.0]] * 2))
        return simulation.q[:, 0].tolist()

    both = [0, 1]
    reset_envs(simulation, both, q, zeros, torch.cat([near, far]))
    assert positions() == pytest.approx([0.295, 0.9], abs=0.01)
    reset_envs(simulation, both, q, zeros)  # obstacles stay
    assert positions() == pytest.approx([0.295, 0.9], abs=0.01)
    reset_envs(simulation, [1], q[1:], zeros[1:], near)
    reset_envs(simulation, [0], q[:1], zeros[:1], far)
    assert positions() == pytest.approx([0.9, 0.295], abs=0.01)
    with pytest.raises(ValueError, match="obstacles"):
        simulation.reset(torch.ones(2, dtype=torch.bool), q, zeros, near)
    with pytest.raises(ValueError, match="obstacles"):
        reset_envs(simulation, both, q, zeros, torch.full((2, 1, 7), np.nan))
    simulation.close()


@pytest.mark.parametrize("name", SIMULATIONS)
def test_a_moved_obstacle_gives_the_bits_of_a_loaded_one(name):
    """A cube on slides pushes a block against a turned wall."""
    pose = Pose.from_xyz_rpy((0.5, 0.25, 0.125), (0.0, 0.0, 0.5))
    here, there = (Block((0.125, 0.5, 0.25), p) for p in (pose, Pose((0.5, 4.0, 0.125))))
    block = Block((0.125, 0.125, 0.125), Pose((0.25, 0.25, 0.0625)), mass=0.1)
    scenes = [Scene(robot("cubes"), block=block, obstacles=(box,)) for box in (here, there)]
    loaded, moved = (SIMULATIONS[name]([scene]) for scene in scenes)
    row = np.array([*pose.position, *pose.quaternion], np.float32)
    poses, start = torch.from_numpy(row)[None, None], torch.tensor([[0.0, 0.25]])
    block_pose = torch.tensor([[0.25, 0.25, 0.0625, 1.0, 0.0, 0.0, 0.0]])
    for simulation in (loaded, moved):
        reset_envs(simulation, [0], start, block_pose, poses)
    for step in range(50):
        for simulation in (loaded, moved):
            simulation.step(torch.tensor([[0.02 * step, 0.25]]))
    assert torch.equal(loaded.q, moved.q)
    assert torch.equal(loaded.block_pose, moved.block_pose)
    assert loaded.block_pose[0, 0] > 0.3
    for simulation in (loaded, moved):
        simulation.close()


def test_baselines_plan_around_the_current_obstacles(build_batch, monkeypatch):
    batch = build_batch("reach", "reach", layouts="eval")
    controller, scenes = InverseKinematics(0), []
    new_planner = InverseKinematics._new_planner

    def recorded(self, task, robot_index, scene):
        scenes.append(scene.obstacles)
        return new_planner(self, task, robot_index, scene)

    monkeypatch.setattr(InverseKinematics, "_new_planner", recorded)
    for _ in range(6):
        batch.reset()
        controller.act(batch)
    first = {tuple(batch.specs[0].goals.layouts[k, 0, :3].tolist()) for k in (4, 5)}
    assert {boxes[0].pose.position for boxes in scenes} == first
    assert len(scenes) == 4  # two robots of the batch, two layouts each
