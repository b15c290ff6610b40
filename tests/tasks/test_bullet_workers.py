"""PyBullet in several processes: identical results and cleanup after every kind of exit."""

import gc
import os
import re
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
from contextlib import closing
from pathlib import Path

import pytest
import torch

from helpers.commands import heed_ctrl_c
from helpers.resets import reset_envs
from helpers.scenes import mixed_scenes, push_scene
from morphgen.errors import SimulationError
from morphgen.tasks.sim.base import Block, Scene

pytest.importorskip("pybullet", reason="PyBullet has no wheel for this Python")
from helpers.pybullet_states import state
from morphgen.tasks.sim import bullet
from morphgen.tasks.sim.bullet import BulletSimulation, divide

TESTS = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def workers():
    simulation = BulletSimulation([*mixed_scenes(), *mixed_scenes()[:2]], processes=3)
    yield simulation
    simulation.close()


def starts(simulation):
    q = torch.zeros_like(simulation.q)
    pose = torch.zeros_like(simulation.block_pose)
    for env, scene in enumerate(simulation.scenes):
        q[env, : scene.robot.dof] = torch.tensor(scene.robot.home)
        pose[env] = torch.tensor([0.0, 0.0, 0.3, 1.0, 0.0, 0.0, 0.0])
    return torch.arange(len(q)), q, pose


def keep_stepping(simulation, q):
    while True:
        simulation.step(q)


def is_running(pid):
    """Return whether a process runs and is not a zombie."""
    try:
        status = Path(f"/proc/{pid}/stat").read_text()
    except FileNotFoundError:
        return False
    return status.rpartition(")")[2].split()[0] != "Z"


def eventually(condition, seconds=5.0):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.02)
    return False


def pids(simulation):
    return [worker.process.pid for worker in simulation._workers]


@pytest.fixture
def scratch(tmp_path, monkeypatch):
    """Folder for temporary files of this test and its processes."""
    folder = tmp_path / "scratch"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.setenv("TMPDIR", str(folder))
    return folder


def leftovers(scratch, pid):
    """Return temporary folders and shared memory left behind by a simulation."""
    return [*scratch.glob("morphgen-*"), *Path("/dev/shm").glob(f"*{pid}*")]


def test_workers_are_bit_identical_to_one_process(workers):
    alone = BulletSimulation(workers.scenes)
    generator = torch.Generator().manual_seed(0)
    envs, q, pose = starts(alone)
    for simulation in (alone, workers):
        reset_envs(simulation, envs, q, pose)
    assert torch.equal(state(workers), state(alone))
    for step in range(40):
        q = q + 0.03 * torch.randn(q.shape, generator=generator)
        for simulation in (alone, workers):
            simulation.step(q)
            if step == 20:
                reset_envs(simulation, envs[1:4], q[1:4], pose[1:4])
        assert torch.equal(state(workers), state(alone)), step
    alone.close()


def test_invalid_arguments_do_not_stop_the_workers(workers):
    envs, q, pose = starts(workers)
    reset_envs(workers, envs, q, pose)
    with pytest.raises(ValueError, match=r"environment 0 .*targets"):
        workers.step(q * torch.nan)
    with pytest.raises(ValueError, match="shape"):
        workers.step(q[:1])
    workers.step(q)
    assert workers.q[0, : workers.scenes[0].robot.dof].any()


@pytest.mark.parametrize("heavy", [{0}, {1}, {0, 1}], ids=["here", "in a worker", "both"])
def test_diverged_environments_are_reported_and_the_others_step(heavy):
    """The block's weight is not finite."""
    scenes = [push_scene() for _ in range(4)]
    for env in heavy:
        scenes[env] = Scene(push_scene().robot, block=Block((0.1, 0.1, 0.1), mass=1e308))
    with closing(BulletSimulation(scenes, processes=2)) as simulation:
        assert [worker.envs.tolist() for worker in simulation._workers] == [[1, 3]]
        envs, q, pose = starts(simulation)
        reset_envs(simulation, envs, q, pose)
        others = sorted({0, 1, 2, 3} - heavy)
        before = state(simulation)[others]
        message = rf"environment {min(heavy)} \('prims'\) diverged"
        assert simulation.step(q).tolist() == [env in heavy for env in range(4)]
        assert simulation.faults().keys() == heavy
        assert re.match(message, simulation.faults()[min(heavy)])
        assert (state(simulation)[others] != before).any(dim=1).all()
        reset_envs(simulation, envs, q, pose)
        assert torch.isfinite(state(simulation)).all()


def test_robot_that_cannot_be_loaded_is_named_in_the_parent(monkeypatch, scratch):
    original = bullet.export_robots

    def lost(scenes, folder):
        return [(path.with_name("none.urdf"), body) for path, body in original(scenes, folder)]

    monkeypatch.setattr(bullet, "export_robots", lost)
    with pytest.raises(SimulationError, match="robot 'prims': PyBullet cannot load it"):
        BulletSimulation([push_scene()])
    assert leftovers(scratch, os.getpid()) == []


def test_killed_worker_is_reported_and_everything_is_freed(scratch):
    simulation = BulletSimulation([push_scene(), push_scene()], processes=2)
    envs, q, pose = starts(simulation)
    reset_envs(simulation, envs, q, pose)
    simulation.step(q)
    running = pids(simulation)
    os.kill(running[0], signal.SIGKILL)
    with pytest.raises(SimulationError, match=r"worker 1 .* died \(exit code -9\)"):
        keep_stepping(simulation, q)
    assert not any(map(is_running, running))
    assert leftovers(scratch, os.getpid()) == []
    with pytest.raises(SimulationError, match="closed"):
        simulation.step(q)
    simulation.close()


@pytest.mark.parametrize("closes", [True, False], ids=["closed", "garbage-collected"])
def test_nothing_is_left_of_a_simulation(scratch, closes):
    simulation = BulletSimulation([push_scene(), push_scene()], processes=2)
    running, kept = pids(simulation), simulation.q
    if closes:
        simulation.close()
        simulation.close()
        with pytest.raises(SimulationError, match="closed"):
            reset_envs(simulation, *starts(simulation))
    del simulation
    gc.collect()
    assert not any(map(is_running, running))
    assert leftovers(scratch, os.getpid()) == []
    assert not kept.any()  # tensors outlive the processes


SCRIPT = """
import sys

def main():
    sys.path[:0] = [sys.argv[1], sys.argv[1] + "/tasks"]
    from helpers.resets import reset_envs
    from helpers.scenes import push_scene
    from test_bullet_workers import pids, starts
    from morphgen.tasks.sim.bullet import BulletSimulation

    simulation = BulletSimulation([push_scene(), push_scene(), push_scene()], processes=3)
    envs, q, pose = starts(simulation)
    reset_envs(simulation, envs, q, pose)
    print(*pids(simulation), flush=True)
"""
MAIN = """
if __name__ == "__main__":
    main()
"""


def script(tmp_path, ending):
    """Start a process that simulates with two workers and writes their process ids."""
    path = tmp_path / "script.py"
    path.write_text(SCRIPT + textwrap.indent(textwrap.dedent(ending), " " * 4) + MAIN)
    process = subprocess.Popen(
        [sys.executable, str(path), str(TESTS)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=heed_ctrl_c,
    )
    return process, [int(word) for word in process.stdout.readline().split()]


FOREVER = """
while True:
    simulation.step(q)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ending", "stop", "says"),
    [
        ("raise RuntimeError('on purpose')", None, "on purpose"),
        (FOREVER, lambda pid: os.killpg(pid, signal.SIGINT), "KeyboardInterrupt"),  # as a terminal
        (FOREVER.replace("simulation.step(q)", "pass"), lambda pid: os.killpg(pid, 2), "Keyboard"),
        (FOREVER, lambda pid: os.kill(pid, signal.SIGKILL), ""),
    ],
    ids=["exception", "Ctrl-C", "Ctrl-C while idle", "killed"],
)
def test_workers_end_with_the_parent(tmp_path, scratch, ending, stop, says):
    process, running = script(tmp_path, ending)
    if stop is not None:
        time.sleep(0.3)
        stop(process.pid)
    _, errors = process.communicate(timeout=20)
    assert says in errors
    assert errors.count("Traceback") == bool(says)
    assert len(running) == 2
    assert eventually(lambda: not any(map(is_running, running)))
    assert not says or leftovers(scratch, process.pid) == []  # a killed process leaves its files
    assert list(Path("/dev/shm").glob(f"*{process.pid}*")) == []


def test_environments_are_distributed_evenly():
    scenes = [scene for scene in mixed_scenes() for _ in range(10)]
    shares = divide(scenes, 3)
    assert sorted(env for share in shares for env in share) == list(range(30))
    loads = [sum(5 + len(scenes[env].robot.movable_joints) for env in share) for share in shares]
    assert max(loads) - min(loads) <= 14
    assert divide(scenes[:2], 5) == [[0], [1]]


@pytest.mark.parametrize(("scenes", "processes"), [([], 2), ([1], 0)])
def test_zero_scenes_or_processes_are_rejected(scenes, processes):
    with pytest.raises(ValueError, match="both must be at least 1"):
        BulletSimulation(scenes, processes=processes)
