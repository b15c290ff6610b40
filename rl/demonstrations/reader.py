"""Read demonstrations: steps as tensors, robots, and what a policy observes in each step."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from morphgen.encoding.robot_hash import HASH_LENGTH
from morphgen.encoding.tokens import default_max_links
from morphgen.errors import MAX_WHOLE, FormatError, TaskError, one_line
from morphgen.formats.data_files import read_bytes, read_json
from morphgen.model.robot import Robot
from morphgen.rl.demonstrations.lerobot import (
    BODIES,
    FORMAT,
    INDEX,
    INFO,
    RECORDING,
    read_columns,
    read_episodes,
    read_index,
    require_pyarrow,
)
from morphgen.tasks.actions import ActionKind, encode_actions
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.goal_sets import goals_from_npz
from morphgen.tasks.observation import Observation, ObservationConfig
from morphgen.tasks.registry import TASKS
from morphgen.tasks.scenes.env_specs import ground_under, load_robot, task_configs
from morphgen.tasks.scenes.robot_tables import RobotTables, build_robot_tables
from morphgen.tasks.sim.base import Scene, Simulation
from morphgen.tasks.task import EnvSpec, TaskConfig


@dataclass(frozen=True)
class RecordedEpisode:
    """An episode of a data set."""

    index: int
    robot_index: int
    robot_hash: str
    task: str
    policy: str
    seed: int  # seed of the environment whose first episode it is; see `TaskBatch.reset`
    success: bool
    score: float
    distance: float
    first: int  # index of its first step
    length: int  # number of its steps

    @property
    def frames(self) -> range:
        """Indices of its steps."""
        return range(self.first, self.first + self.length)


class Demonstrations(Dataset[dict[str, torch.Tensor]]):
    """The steps of a data set, each a dictionary of tensors by feature.

    Attributes:
        folder: The data set.
        settings: Content of ``recording.json``.
        episodes: The episodes, in order.
        columns: All steps by feature.
        robot_hashes: Hashes of the robots, which ``robot_index`` refers to.
        robot_names: Their names.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        """Read all steps into memory.

        Raises:
            FormatError: If the folder is no complete data set of ``morphgen record``.
        """
        require_pyarrow()
        self.folder = Path(path)
        if not self.folder.is_dir():
            raise FormatError(f"{self.folder}: no such folder")
        if not (self.folder / INFO).is_file():
            begun = (self.folder / RECORDING).is_file()
            why = "not finished: run morphgen record again" if begun else f"it has no {INFO}"
            raise FormatError(f"{self.folder} is no data set: {why}")
        try:
            self.settings: dict[str, Any] = read_json(self.folder / RECORDING)
            if self.settings["format"] != FORMAT:
                raise ValueError(f"format {self.settings['format']!r}; this version reads {FORMAT}")
            bodies = read_index(self.folder)
            self.robot_hashes = tuple(body["robot_hash"] for body in bodies)
            if not all(map(_HASH.fullmatch, self.robot_hashes)):  # they name folders
                raise ValueError(f"{INDEX}: expected hashes of {HASH_LENGTH} hexadecimal digits")
            if len(set(self.robot_hashes)) < len(self.robot_hashes):
                raise ValueError(f"{INDEX}: names a robot twice")
            self.robot_names = tuple(str(body["name"]) for body in bodies)
            self.columns = {
                name: torch.from_numpy(np.array(values))
                for name, values in read_columns(self.folder).items()
            }
            self.episodes = tuple(self._read_episodes())
            self._require_columns()
            if not isinstance(self.settings["sim"], str):
                raise ValueError("sim: expected the name of a simulator")
            for episode in self.episodes:
                self.settings["constants"][episode.task]  # a KeyError if it is missing
        except (OSError, *_FAULTS) as error:
            why = one_line(str(error))
            raise FormatError(f"{self.folder} is no sound data set: {why}") from error
        self._robots: dict[int, Robot] = {}
        self._tables: dict[int, RobotTables] = {}

    def _read_episodes(self) -> Iterator[RecordedEpisode]:
        """Yield the episodes, and require that each begins where the one before it ends."""
        end = 0
        for index, row in enumerate(read_episodes(self.folder)):
            values = {name: row[name] for name in _OF_ROW}
            episode = RecordedEpisode(index, first=end, **values)
            place = row["episode_index"], row["dataset_from_index"]
            if place != (index, end) or episode.length < 1:
                raise ValueError(f"episode {index} does not begin where the one before it ends")
            if episode.robot_index < 0 or not 0 <= episode.seed <= MAX_WHOLE:
                raise ValueError(f"episode {index} has a negative robot_index or seed")
            if self.robot_hashes[episode.robot_index] != episode.robot_hash:
                raise ValueError(f"episode {index} has another robot than its robot_index")
            end += episode.length
            if end > len(self):
                break
            yield episode
        if end != len(self) or not end:
            raise ValueError(f"the episodes have {end} steps, and the files {len(self)}")

    def _require_columns(self) -> None:
        """Require that the columns which are read are there, and agree with the episodes."""
        joints = self.columns["observation.state"].shape[1]
        sizes = dict.fromkeys((*_OBSERVED[:3], "normalized_action"), joints)
        sizes |= {"observation.object_pose": 7}
        if "executed_action" in self.columns:
            sizes["executed_action"] = joints
        for name, size in sizes.items():
            values = self.columns[name]
            if values.dtype != torch.float32 or values.shape[1:] != (size,):
                raise ValueError(f"{name}: expected {size} numbers of 32 bits per step")
        if self.columns["next.reward"].numel() != len(self):
            raise ValueError("next.reward: expected a number per step")
        lengths = [episode.length for episode in self.episodes]
        frames = torch.cat([torch.arange(length) for length in lengths])
        index = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
        for name, values in (("frame_index", frames), ("episode_index", index)):
            if not torch.equal(self.columns[name], values):
                raise ValueError(f"{name} disagrees with the lengths of the episodes")

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.columns["index"])

    def __getitem__(self, frame: int) -> dict[str, torch.Tensor]:
        """Return the features of a step."""
        return {name: values[frame] for name, values in self.columns.items()}

    @property
    def robots(self) -> tuple[Robot, ...]:
        """The robots, which ``robot_index`` refers to, with primitives as collision shapes."""
        return tuple(self.robot(index) for index in range(len(self.robot_hashes)))

    def robot(self, robot_index: int) -> Robot:
        """Return one of ``robots``; it is read once."""
        if robot_index not in self._robots:
            robot = load_robot(self.folder / BODIES / self.robot_hashes[robot_index])
            if robot.dof > self.columns["observation.state"].shape[1]:
                raise FormatError(f"{self.folder}: a robot has more joints than the steps")
            self._robots[robot_index] = robot
        return self._robots[robot_index]

    @cached_property
    def configs(self) -> tuple[TaskConfig, ...]:
        """Constants of the tasks."""
        try:
            return task_configs(self.settings["constants"])
        except _FAULTS as error:
            raise FormatError(f"{self.folder / RECORDING}: constants: {error}") from error

    @cached_property
    def specs(self) -> Mapping[tuple[int, str], EnvSpec]:
        """Environments by robot index and task, with the goals of the data set."""
        keys = dict.fromkeys((episode.robot_index, episode.task) for episode in self.episodes)
        return {key: self.spec(*key) for key in keys}

    def spec(self, robot_index: int, task: str) -> EnvSpec:
        """Return one of ``specs``; no other robot is read."""
        robot, kind = self.robot(robot_index), TASKS[task]
        path = self.folder / BODIES / self.robot_hashes[robot_index] / "goals" / f"{task}.npz"
        goals = goals_from_npz(read_bytes(path), task, path)
        if goals.q.shape[1] != robot.dof:
            raise FormatError(f"{path}: goals of {goals.q.shape[1]} joints, not {robot.dof}")
        config = next(each for each in self.configs if each.task == task)
        return EnvSpec(robot, task, kind.scene(robot, goals, ground_under(robot)), goals, config)

    def observe(
        self,
        frames: Sequence[int] | torch.Tensor,
        observe: ObservationConfig | None = None,
        *,
        kind: ActionKind = "continuous",
        max_links: int | None = None,
    ) -> tuple[Observation, torch.Tensor]:
        """Return what a policy observes in n steps, and the actions that it should return.

        Observations are computed from the recorded states by the code that computes them in
        environments, and equal those. A call takes milliseconds besides the time of each step:
        ask for thousands of steps at once.

        Args:
            frames: Indices of the steps.
            observe: Optional entries of observations.
            kind: Kind of the actions.
            max_links: Number of links that observations are padded to; by default 23, or that of
                the largest robot.

        Returns:
            The observations, and the actions of the policy that was recorded, without noise,
            shape (n, L).

        Raises:
            TaskError: If observations have the channel ``ik``, which depends on earlier steps.
        """
        if observe is not None and observe.ik:
            raise TaskError(
                "observation channel 'ik' depends on earlier steps: use observe_episodes"
            )
        batch, action = self.batch(frames, observe, kind=kind, max_links=max_links)
        return batch.observe(), action

    def observe_episodes(
        self,
        episodes: Sequence[int],
        observe: ObservationConfig | None = None,
        *,
        kind: ActionKind = "continuous",
        max_links: int | None = None,
    ) -> Iterator[tuple[torch.Tensor, Observation, torch.Tensor]]:
        """Yield what ``observe`` returns, step by step of whole episodes, with the frames' indices.

        It is for the channel ``ik``, which depends on earlier steps.

        Args:
            episodes: Indices of the episodes, which are observed at once.
            observe: Optional entries of observations.
            kind: Kind of the actions.
            max_links: As of ``observe``.

        Yields:
            Indices of the k steps of the episodes that have not ended, (k,), their observations
            and their actions (k, L).
        """
        chosen = [self.episodes[i] for i in episodes]
        first = torch.tensor([episode.first for episode in chosen])
        length = torch.tensor([episode.length for episode in chosen])
        batch, _ = self.batch(first, observe, kind=kind, max_links=max_links)
        for step in range(int(length.max())):
            rows = first + torch.clamp(length - 1, max=step)
            action = self._put(batch, rows, self._observed(rows))
            runs = step < length
            observation = {name: value[runs] for name, value in batch.observe().items()}
            yield rows[runs], observation, action[runs]

    def batch(
        self,
        frames: Sequence[int] | torch.Tensor,
        observe: ObservationConfig | None = None,
        *,
        kind: ActionKind = "continuous",
        max_links: int | None = None,
    ) -> tuple[TaskBatch, torch.Tensor]:
        """Return environments in the states of n steps, and actions as ``observe`` returns them.

        They cannot be stepped. The arguments are those of ``observe``.
        """
        rows = torch.as_tensor(frames)
        columns = self._observed(rows)
        episodes = [self.episodes[i] for i in columns["episode_index"].tolist()]
        places = {key: i for i, key in enumerate(self.specs)}
        index = [places[episode.robot_index, episode.task] for episode in episodes]
        specs = [*self.specs.values()]
        links = max_links or default_max_links(len(robot.links) for robot in self.robots)
        if links not in self._tables:
            robots = [spec.robot for spec in specs]
            self._tables[links] = build_robot_tables(robots, max_links=links)
        batch = TaskBatch(
            self._tables[links],
            specs,
            index,
            _RecordedStates([specs[i].scene for i in index], columns),
            kind=kind,
            observe=observe,
        )
        batch.reset(seed=[episode.seed for episode in episodes])
        return batch, self._put(batch, rows, columns)

    def _observed(self, rows: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return the features of steps that observations and labels are computed from."""
        return {name: self.columns[name][rows] for name in _OBSERVED}

    def _put(
        self, batch: TaskBatch, rows: torch.Tensor, columns: dict[str, torch.Tensor]
    ) -> torch.Tensor:
        """Put environments in the states of steps of their episodes; return the actions (n, L).

        The steps are one for each environment, (n,); ``columns`` are what ``_observed`` returns.
        """
        simulation = batch.simulation
        simulation.q.copy_(columns["observation.state"])
        simulation.qd.copy_(columns["observation.velocity"])
        simulation.object_pose.copy_(columns["observation.object_pose"])
        batch.targets.copy_(columns["observation.targets"])
        executed = self.columns.get("executed_action", self.columns["normalized_action"])
        before = at_links(batch, executed[(rows - 1).clamp(min=0)])
        starts = (columns["frame_index"] == 0)[:, None]
        batch.previous_action.copy_(before.masked_fill(starts, 0))
        return encode_actions(at_links(batch, columns["normalized_action"]), batch.action_kind)

    def episode_batch(self, index: int) -> TaskBatch:
        """Return environments in the states of an episode's steps; no other robot is read.

        They cannot be stepped.
        """
        episode = self.episodes[index]
        spec, steps = self.spec(episode.robot_index, episode.task), episode.frames
        columns = {name: self.columns[name][steps.start : steps.stop] for name in _OBSERVED}
        for name in _OBSERVED[:2]:  # without the joints of larger robots
            columns[name] = columns[name][:, : spec.robot.dof]
        links = default_max_links([len(spec.robot.links)])
        batch = TaskBatch(
            build_robot_tables([spec.robot], max_links=links),
            [spec],
            [0] * episode.length,
            _RecordedStates([spec.scene] * episode.length, columns),
        )
        batch.reset(seed=[episode.seed] * episode.length)
        return batch


_OBSERVED = (
    *("observation.state", "observation.velocity", "observation.targets"),
    *("observation.object_pose", "normalized_action", "episode_index", "frame_index"),
)
"""Features that observations and labels are computed from."""
_FAULTS = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)
"""Errors that the content of a damaged data set may raise."""
_HASH = re.compile(f"[0-9a-f]{{{HASH_LENGTH}}}")
_OF_ROW = (
    *("robot_index", "robot_hash", "task", "policy", "seed", "success", "score", "distance"),
    "length",
)


def at_links(batch: TaskBatch, action: torch.Tensor) -> torch.Tensor:
    """Return actions of independent joints (n, J) by link, shape (n, L)."""
    return batch.observation.link_joints(action).where(batch.action_mask, 0.0)


class _RecordedStates(Simulation):
    """States that were recorded, in place of a simulation: observations are computed from them."""

    def __init__(self, scenes: Sequence[Scene], columns: dict[str, torch.Tensor]) -> None:
        super().__init__(scenes, torch.device("cpu"))
        self.q, self.qd = columns["observation.state"], columns["observation.velocity"]
        self.object_pose = columns["observation.object_pose"]

    def _reset(self, *_: object) -> None:
        pass  # the states are those that were recorded

    def _step(self, targets: torch.Tensor) -> torch.Tensor:
        raise NotImplementedError("recorded states cannot be stepped")
