"""Layouts of obstacles in the running episodes of a batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from morphgen.tasks.observation import ObservationConfig, obstacle_tokens
from morphgen.tasks.obstacles import LayoutSide, layouts_of, place_boxes
from morphgen.tasks.sim.base import Block, Scene
from morphgen.tasks.task import EnvSpec


class EpisodeLayouts:
    """Draws the layout of every episode, and holds the current poses of all obstacles.

    Attributes:
        poses: Current poses of the obstacles in the world, shape (n, O, 7); zeros where an
            environment has fewer than O. Updated in place.
        entries: Observation of the obstacles, ``obstacles`` and ``obstacle_mask``; all padding if
            the state is not observed. Updated in place.
        current: Layout of each environment, an index of ``GoalSet.layouts``; None without
            obstacles.
    """

    def __init__(
        self,
        specs: Sequence[EnvSpec],
        env_robot_index: torch.Tensor,
        side: LayoutSide,
        observe: ObservationConfig,
    ) -> None:
        """Begin with the first layout of every environment.

        Args:
            specs: Specifications of environments.
            env_robot_index: Index of each environment's specification, shape (n,), int64.
            side: Layouts to draw from.
            observe: Whether obstacles are observed, and the minimum number of their rows.

        Raises:
            TaskError: If the side is unknown.
        """
        self._specs = [specs[i] for i in env_robot_index.tolist()]
        self._choices = [layouts_of(spec.config, side) for spec in self._specs]
        self.current: list[int | None] = [None] * len(self._specs)
        scenes = [spec.scene for spec in self._specs]
        self.entries = obstacle_tokens(scenes, observe.obstacles, env_robot_index.device)
        self._is_observed = observe.state
        if not observe.state:
            self.entries = {name: torch.zeros_like(v) for name, v in self.entries.items()}
        num_rows = max(len(scene.obstacles) for scene in scenes)
        self.poses = torch.zeros(len(self._specs), num_rows, 7, device=env_robot_index.device)
        for env, (spec, choices) in enumerate(zip(self._specs, self._choices, strict=True)):
            if spec.scene.obstacles:
                self._set(env, choices[0])

    @property
    def any(self) -> bool:
        """Whether an environment has obstacles."""
        return self.poses.shape[1] > 0

    def draw(self, envs: Sequence[int], random: Sequence[np.random.Generator]) -> None:
        """Draw the layouts of new episodes; environments without obstacles draw nothing.

        Args:
            envs: Environments whose episodes begin.
            random: Random number generator of every environment.
        """
        for env in envs if self.any else ():
            if self.current[env] is not None:
                choices = self._choices[env]
                self._set(env, choices[int(random[env].integers(len(choices)))])

    def obstacles(self, env: int) -> tuple[Block, ...]:
        """Return the obstacles of an environment at their current poses."""
        spec, layout = self._specs[env], self.current[env]
        if layout is None:
            return ()
        return place_boxes(spec.scene.obstacles, spec.goals.layouts[layout])

    def scene(self, env: int) -> Scene:
        """Return the scene of an environment with its obstacles at their current poses."""
        scene: Scene = self._specs[env].scene
        return replace(scene, obstacles=self.obstacles(env))

    def _set(self, env: int, layout: int) -> None:
        self.current[env] = layout
        poses = torch.from_numpy(self._specs[env].goals.layouts[layout])
        self.poses[env, : len(poses)] = poses.to(self.poses)
        if self._is_observed:
            self.entries["obstacles"][env, : len(poses), :7] = self.poses[env, : len(poses)]
