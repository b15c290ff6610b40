"""Episodes: the motion of robots at a task, and its scores."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morphgen.model.robot import Robot
from morphgen.tasks.registry import TASKS
from morphgen.tasks.sim.articulated import ArticulatedObject
from morphgen.tasks.sim.base import Block
from morphgen.tasks.task import Marker

Array = NDArray[np.float32]

BLOCK = "block"  # name of the block, or of the articulated object, among the poses of a track
_OF_STEPS = ("score", "distance", "success")  # values of a track that every step has
STRIDE = 2  # control steps between two frames of a film


@dataclass(eq=False)
class Track:
    """Motion and scores of one robot; it grows while its episode is simulated."""

    robot: Robot
    uri: str
    ground: float | None  # height of the ground [m]; None without ground
    obstacles: tuple[Block, ...] = ()
    markers: tuple[Marker, ...] = ()  # shapes that show the goal
    block_size: tuple[float, float, float] | None = None
    object: ArticulatedObject | None = None
    q: list[Array] = field(default_factory=list)  # positions (J,) at the start and every step
    poses: dict[str, list[Array]] = field(default_factory=dict)
    """Poses in the world at the same times, (x, y, z, qw, qx, qy, qz): of each marker by its name,
    and of ``block`` if any, or of the object's contact point and the link that moves."""
    score: list[float] = field(default_factory=list)
    distance: list[float] = field(default_factory=list)  # to success [m]
    success: list[bool] = field(default_factory=list)
    reward: list[float] = field(default_factory=list)  # of demonstrations, which have them
    fault: str = ""  # error that ended the episode early; empty without error

    @property
    def num_steps(self) -> int:
        """Control steps so far."""
        return len(self.q) - 1

    def recorded(self, after: int = -1) -> dict[str, Any]:
        """Return copies of the lists after a number of steps, by default with the start."""
        last = min(self.num_steps, len(self.score))
        moments, steps = slice(after + 1, last + 1), slice(max(after, 0), last)
        lists: dict[str, Any] = {"q": self.q[moments]}
        lists["poses"] = {name: poses[moments] for name, poses in self.poses.items()}
        return lists | {name: getattr(self, name)[steps] for name in _OF_STEPS}

    def extend(self, lists: Mapping[str, Any]) -> None:
        """Append what ``recorded`` of the same robot has returned."""
        for name, poses in lists["poses"].items():
            self.poses[name] += poses
        # Last, because other threads read a track up to the length of q meanwhile.
        for name in (*_OF_STEPS, "q"):
            getattr(self, name).extend(lists[name])


@dataclass(eq=False)
class Episode:
    """Robots at the same task under the same policy."""

    task: str
    policy: str
    seed: int
    obstacles: bool  # whether obstacles were requested
    simulator: str
    period: float  # time of a control step [s]
    tracks: list[Track]

    @property
    def num_steps(self) -> int:
        """Control steps so far of the longest track."""
        return max((track.num_steps for track in self.tracks), default=0)

    @property
    def film_steps(self) -> list[int]:
        """Steps that a film shows: the start, every ``STRIDE`` steps, and the end."""
        return [*range(0, self.num_steps, STRIDE), self.num_steps]


def score_until(track: Track, task: str, step: int) -> float | None:
    """Return an episode's score as if it had ended at a step of its track; None at the start."""
    scores = track.score[:step]
    if not scores:
        return None
    return TASKS[task].episode_score(sum(scores), scores[-1], len(scores))


def snapshot(episode: Episode) -> Episode:
    """Return a copy of an episode that does not grow while the simulation continues."""
    tracks = [replace(track, **track.recorded()) for track in episode.tracks]
    return replace(episode, tracks=tracks)
