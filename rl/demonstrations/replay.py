"""Verify demonstrations: simulate episodes again from their robots, goals, seeds and actions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
import torch

from morphgen.processes import one_torch_thread
from morphgen.rl.demonstrations.reader import Demonstrations, RecordedEpisode, at_links
from morphgen.rl.demonstrations.recording import step_state
from morphgen.tasks.goals.split_goals import certify_goal_set
from morphgen.tasks.registry import SIMULATORS
from morphgen.tasks.scenes.make import batch_from_specs

TOLERANCE = 1e-3
"""Largest deviation of a joint or of the object [rad or m]: another processor rounds differently,
and a contact makes a difference grow."""


@dataclass(frozen=True)
class Replay:
    """A recorded episode beside the same one in the simulator."""

    episode: RecordedEpisode
    robot: str
    """Name of the robot."""
    joint_error: float
    """Largest difference of a joint's position in any step [rad or m]."""
    object_error: float
    """Largest difference of the object's position in any step [m]."""
    reward_error: float
    """Largest difference of a reward."""
    success: bool
    """Whether the simulated episode ended in success."""
    faults: tuple[str, ...]
    """Faults of the certificates of its goals."""

    @property
    def agrees(self) -> bool:
        """Whether the episode is as it was recorded."""
        errors = self.joint_error, self.object_error
        is_near = all(error <= TOLERANCE for error in errors)  # unlike of max, NaN is never near
        return is_near and self.success == self.episode.success and not self.faults


def choose_episodes(demos: Demonstrations, count: int, seed: int) -> list[int]:
    """Return the indices of random episodes, ascending: all of them if there are no more."""
    total = len(demos.episodes)
    rng = np.random.default_rng(seed)
    return sorted(rng.choice(total, size=min(count, total), replace=False).tolist())


def replay(demos: Demonstrations, episodes: Sequence[int]) -> Iterator[Replay]:
    """Simulate episodes again, and yield how far they are from the recorded ones."""
    return (_replay(demos, demos.episodes[index]) for index in episodes)


@one_torch_thread()
def _replay(demos: Demonstrations, episode: RecordedEpisode) -> Replay:
    columns = {name: demos.columns[name][episode.first :][: episode.length] for name in _COMPARED}
    executed = demos.columns.get("executed_action", demos.columns["normalized_action"])
    spec = demos.spec(episode.robot_index, episode.task)
    dof, sim = spec.robot.dof, demos.settings["sim"]
    device = SIMULATORS[sim].devices[0]
    batch = batch_from_specs([spec], 1, sim=sim, device=device, workers=1)
    errors = torch.zeros(3)
    with closing(batch):
        batch.reset(seed=[episode.seed])
        for t in range(episode.length):
            state = {name: values.cpu() for name, values in step_state(batch).items()}
            action = executed[episode.first + t, None, :dof].to(batch.device)
            step = batch.step(at_links(batch, action))
            pairs = (
                (state["q"], columns["observation.state"][t, :dof]),
                (state["object_pose"][:, :3], columns["observation.object_pose"][t, :3]),
                (step.reward.cpu(), columns["next.reward"][t]),
            )
            differences = [(mine - recorded).abs().max() for mine, recorded in pairs]
            errors = torch.maximum(errors, torch.stack(differences))
            success = bool(step.success)
    faults = certify_goal_set(spec.goals, spec)
    joints, thing, reward = errors.tolist()
    return Replay(episode, spec.robot.name, joints, thing, reward, success, faults)


_COMPARED = ("observation.state", "observation.object_pose", "next.reward")
