"""Layouts of obstacles in the running episodes of a batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from morphgen.tasks.observation import ObservationConfig, obstacle_tokens
from morphgen.tasks.random_numbers import EpisodeRandom, Stream
from morphgen.tasks.scenes.obstacles import LayoutSide, layouts_of, place_boxes
from morphgen.tasks.sim.base import Block, Scene
from morphgen.tasks.task import EnvSpec


class EpisodeLayouts:
    """Draws the layout of every episode, and holds the current poses of all obstacles.

    Attributes:
        poses: Current poses of the obstacles in the world, shape (n, O, 7); zeros where an
            environment has fewer than O. Updated in place.
        entries: Observation of the obstacles, ``obstacles`` and ``obstacle_mask``; all padding if
            the state is not observed. Updated in place.
        current: Layout of each environment, an index of ``GoalSet.layouts``, shape (n,), int64; -1
            without obstacles. Updated in place.
    """

    def __init__(
        self,
        specs: Sequence[EnvSpec],
        env_robot_index: torch.Tensor,
        side: LayoutSide,
        observe: ObservationConfig,
    ) -> None:
        """Begin with the first layout of every environment.

        env_robot_index: Index of each environment's specification, shape (n,), int64.
        """
        device = env_robot_index.device
        self._specs = [specs[i] for i in env_robot_index.tolist()]
        self._index = env_robot_index
        scenes = [spec.scene for spec in self._specs]
        choices = [layouts_of(spec.config, side) for spec in specs]
        first, count = torch.tensor([(each.start, len(each)) for each in choices]).T.to(device)
        self._first, self._count = first[env_robot_index], count[env_robot_index]
        has_obstacles = torch.tensor([bool(scene.obstacles) for scene in scenes], device=device)
        self._has_obstacles = has_obstacles
        self.current = torch.where(has_obstacles, self._first, -1)
        self.entries = obstacle_tokens(scenes, observe.obstacles, device)
        self._is_observed = observe.state
        if not observe.state:
            self.entries = {name: torch.zeros_like(v) for name, v in self.entries.items()}
        num_obstacles = max(len(scene.obstacles) for scene in scenes)
        self._layout_poses = _layout_poses(specs, num_obstacles).to(device)
        self.poses = torch.zeros(len(scenes), num_obstacles, 7, device=device)
        self._place()

    @property
    def any(self) -> bool:
        """Whether an environment has obstacles."""
        return self.poses.shape[1] > 0

    def draw(self, mask: torch.Tensor, random: EpisodeRandom) -> None:
        """Draw the layouts of new episodes.

        mask: Environments whose episodes begin, shape (n,), bool.
        """
        if self.any:
            layout = self._first + random.integers(Stream.LAYOUT, self._count)
            self.current.copy_(torch.where(mask & self._has_obstacles, layout, self.current))
            self._place()

    def obstacles(self, env: int) -> tuple[Block, ...]:
        """Return the obstacles of an environment at their current poses."""
        spec, layout = self._specs[env], int(self.current[env])
        if layout < 0:
            return ()
        return place_boxes(spec.scene.obstacles, spec.goals.layouts[layout])

    def scene(self, env: int) -> Scene:
        """Return the scene of an environment with its obstacles at their current poses."""
        scene: Scene = self._specs[env].scene
        return replace(scene, obstacles=self.obstacles(env))

    def _place(self) -> None:
        """Put the obstacles where the current layouts have them."""
        self.poses.copy_(self._layout_poses[self._index, self.current.clamp(min=0)])
        if self._is_observed:
            self.entries["obstacles"][:, : self.poses.shape[1], :7] = self.poses


def _layout_poses(specs: Sequence[EnvSpec], num_obstacles: int) -> torch.Tensor:
    """Return the poses of the obstacles of S specifications in all L layouts, (S, L, O, 7).

    There are zeros where a specification has fewer obstacles or layouts.
    """
    layouts = {
        i: torch.from_numpy(spec.goals.layouts[:, :num_obstacles])
        for i, spec in enumerate(specs)
        if spec.scene.obstacles
    }
    num_layouts = max(map(len, layouts.values()), default=1)
    table = torch.zeros(len(specs), num_layouts, num_obstacles, 7)
    for i, poses in layouts.items():
        table[i, : len(poses), : poses.shape[1]] = poses
    return table
