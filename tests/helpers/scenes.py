"""Small scenes of simulators with articulated objects, their resets, and paths of joint targets."""

from dataclasses import replace
from functools import cache
from importlib.util import find_spec

import numpy as np
import pytest
import torch

import morphgen
from morphgen.model.geometry import IDENTITY, Box, Cylinder, Pose, Shape, Sphere
from morphgen.model.kinematics import joint_limits
from morphgen.model.robot import TOOL, Frame, Inertial, Joint, Link, Robot
from morphgen.tasks.scenes.robot_tables import STEP_SLIDE, STEP_TURN
from morphgen.tasks.sim.articulated import ArticulatedObject
from morphgen.tasks.sim.base import CONTROL_PERIOD, Block, Scene

PAPER_ROBOTS = (
    "arm=ur5 ee=stick",
    "arm=ur5 ee=sake_ez",
    "arm=ur5 ee=rethink",
    "arm=kinova_gen3 ee=robotiq_2f85",
    "arm=jaco2 ee=jaco_fingers",
    "arm=xarm7 ee=robotiq_2f85",
    "arm=lwr ee=panda_hand",
    "arm=yumi_right ee=yumi_gripper",
    "arm=widowx ee=widowx_gripper",
    "arm5",
    "stick",
    "nlink",
    "cubes",
    "prims prim=cylinder",
    "prims prim=sphere",
    "chain beads=3",
)
"""Robots of the paper besides those of fast tests."""


@cache
def robot(request):
    """A robot with primitive collision shapes; the same request gives the same object."""
    return morphgen.compose(request, geometry="primitive")


def reach_scene():
    """An arm of primitives with a claw, whose fingers mimic each other, above the ground."""
    return Scene(robot("arm=arm3 ee=claw"))


def real_arm_scene():
    """A UR5 with a plane for a hand, on a plinth."""
    return Scene(robot("arm=ur5 ee=plane"), Pose((0.0, 0.0, 0.3)))


def push_scene(mass=0.1, friction=1.0):
    """A gantry with a vertical plane, a block in front of it, and two obstacles out of its way."""
    edge = 0.15
    return Scene(
        robot("prims"),
        object=Block((edge, edge, edge), Pose((0.0, 0.0, edge / 2)), mass, friction),
        obstacles=(
            Block((0.1, 0.1, 0.1), Pose((0.5, 0.2, 0.05))),
            Block((0.1, 0.1, 0.2), Pose.from_xyz_rpy((-0.5, 0.2, 0.1), (0.0, 0.0, 0.5))),
        ),
    )


def mixed_scenes():
    """Return three scenes with different robots, with and without a block."""
    return [reach_scene(), push_scene(), real_arm_scene()]


def ball(height):
    """A ball of 0.1 m on slides along x and y."""
    base, cart, last = Link("base"), Link("cart"), Link("ball", collisions=(Shape(Sphere(0.1)),))
    joints = (
        Joint("x", "prismatic", "base", "cart", Pose((0, 0, height)), (1, 0, 0), (-2.0, 2.0)),
        Joint("y", "prismatic", "cart", "ball", Pose(), (0, 1, 0), (-2.0, 2.0)),
    )
    return Robot("ball", (base, cart, last), joints, (Frame("tool", "ball"),), (0.0, 0.0))


needs_pybullet = pytest.mark.skipif(
    find_spec("pybullet") is None, reason="PyBullet has no wheel for this Python"
)
PYBULLET = pytest.param("pybullet", marks=needs_pybullet)


def reset_envs(simulation, envs, q, object_pose=None, obstacle_poses=None):
    """Reset environments with these indices; the other arguments have a row for each of them."""
    n = len(simulation.scenes)
    rows = torch.as_tensor(envs).to(simulation.device)
    mask = torch.zeros(n, dtype=torch.bool, device=simulation.device)
    mask[rows] = True

    def of_all(values):
        filled = torch.full((n, *values.shape[1:]), torch.nan, device=simulation.device)
        filled[rows] = torch.as_tensor(values, dtype=torch.float32).to(simulation.device)
        return filled

    object_pose = torch.zeros(len(rows), 7) if object_pose is None else object_pose
    obstacles = () if obstacle_poses is None else (of_all(obstacle_poses),)
    simulation.reset(mask, of_all(q), of_all(object_pose), *obstacles)


def homes(simulation):
    """Return the joint positions at home and the poses of the blocks, (n, J) and (n, 7)."""
    q, poses = torch.zeros_like(simulation.q), torch.zeros_like(simulation.object_pose)
    for env, scene in enumerate(simulation.scenes):
        q[env, : scene.robot.dof] = torch.tensor(scene.robot.home)
        if scene.block is not None:
            poses[env] = torch.tensor((*scene.block.pose.position, *scene.block.pose.quaternion))
    return q, poses


def put_home(simulation, envs=None):
    """Reset all environments, or some of them, to their homes."""
    envs = list(range(len(simulation.scenes)) if envs is None else envs)
    q, poses = homes(simulation)
    reset_envs(simulation, envs, q[envs], poses[envs])


def state(simulation):
    """Return copies of all reported state, a row for each environment."""
    parts = (simulation.q, simulation.qd, simulation.object_pose, simulation.object_velocity)
    return torch.cat(parts, dim=1).clone()


SECOND = round(1 / CONTROL_PERIOD)
"""A second [control steps]."""


def largest_steps(body):
    """Return the largest target change per step in the benchmark, shape (dof,)."""
    joints = [body.joints[k] for k in body.independent_joints]
    most = [STEP_SLIDE if joint.kind == "prismatic" else STEP_TURN for joint in joints]
    fast = [(joint.velocity or np.inf) * CONTROL_PERIOD for joint in joints]
    return np.minimum(most, fast)


def smooth_walk(body, seed, steps=SECOND):
    """Targets that start at home and drift, slowly turning, as fast as the benchmark lets them."""
    rng = np.random.default_rng(seed)
    action, actions = np.zeros(body.dof), []
    for _ in range(steps):
        action = 0.9 * action + 0.3 * rng.normal(size=body.dof)
        actions.append(action)
    return _integrated(body, actions)


def random_walk(body, seed, steps=SECOND):
    """Targets of independent random actions, as those of a policy that has learned nothing."""
    rng = np.random.default_rng(seed)
    return _integrated(body, rng.uniform(-1, 1, (steps, body.dof)))


def full_speed(body, seed, steps=SECOND):
    """Targets that move from home in one direction as fast as the benchmark lets them."""
    rng = np.random.default_rng(seed)
    return _integrated(body, [rng.choice([-1.0, 1.0], size=body.dof)] * steps)


def _integrated(body, actions):
    """Targets within the joint limits after each action, shape (steps, dof)."""
    target, path = np.array(body.home), []
    for action in actions:
        moved = target + largest_steps(body) * np.clip(action, -1, 1)
        target = np.clip(moved, *joint_limits(body).T)
        path.append(target)
    return np.array(path)


def held(sim, steps):
    q = sim.q.clone()
    for _ in range(steps):
        sim.step(q)
    return sim


def drive(sim, steps=25, seed=0):
    """Step with random targets that do not depend on an environment's index."""
    start = sim.q.clone()
    for k in range(steps):
        change = np.random.default_rng([seed, k]).uniform(-0.3, 0.3, 32)
        sim.step(start + torch.from_numpy(change).float()[: start.shape[1]])


SOLID = (0.01, 0.0, 0.0, 0.01, 0.0, 0.01)
AT = Pose((0.0, 0.0, 0.2))
EDGE = Pose((0.24, 0.01, 0.05))
HINGED = Pose((-0.2, 0.0, 0.0))
POST = Shape(Box((0.05, 0.05, 0.4)), Pose((0.4, 0.0, 0.2)))
"""A part of each object that stands still."""


def drawer(pose=IDENTITY):
    """A front on a slide along y, which moves by up to 40 cm."""
    front = (Shape(Box((0.2, 0.02, 0.1))),)
    joint = Joint("slide", "prismatic", "case", "front", AT, (0.0, 1.0, 0.0), (0.0, 0.4))
    return _object("drawer", replace(joint, damping=1.0, friction=1.0), front, IDENTITY, pose)


def door(pose=HINGED):
    """A panel, which turns about z to either side, pushed near its free edge."""
    middle = Pose((0.15, 0.0, 0.0))
    panel = (Shape(Box((0.3, 0.02, 0.2)), middle),)
    joint = Joint("hinge", "revolute", "case", "panel", AT, (0.0, 0.0, 1.0), (-1.5, 1.5))
    edge = Frame(TOOL, "panel", EDGE)
    return _object("door", replace(joint, damping=0.1, friction=0.1), panel, middle, pose, edge)


def rod():
    """A rod upright on a slide along y."""
    base, shape = Link("base", Inertial(1.0, inertia=SOLID)), Shape(Cylinder(0.02, 0.3))
    tip = Link("tip", Inertial(0.5, inertia=SOLID), collisions=(shape,))
    limits = {"limits": (-0.5, 0.5), "effort": 100.0, "velocity": 2.0}
    slide = Joint("slide", "prismatic", "base", "tip", AT, (0.0, 1.0, 0.0), **limits)
    return Robot("rod", (base, tip), (slide,), home=(-0.2,))


def _object(name, joint, shapes, centre, pose, *frames):
    links = (
        Link("case", Inertial(1.0, inertia=SOLID), collisions=(POST,)),
        Link(joint.child, Inertial(0.5, centre.position, SOLID), collisions=shapes),
    )
    return ArticulatedObject(Robot(name, links, (joint,), frames, home=(0.0,)), pose)
