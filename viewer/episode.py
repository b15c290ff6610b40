"""Recorded episodes: the motion of robots at a task, and its scores.

An episode's file is an ``.npz``. Its text ``about`` is JSON: ``format`` (2), ``morphgen``
(version), ``task``, ``policy``, ``seed``, ``obstacles`` (whether they were requested),
``simulator``, ``period`` (time between two moments [s]), and for every robot in ``bodies``:
``name``, ``place`` (its URI, see ``morphgen.viewer.robot_uri``), ``body`` (its ``robot_hash``),
``ground`` ([m], or null), ``obstacles`` (``size`` and ``pose`` of each), ``block`` (its edges, or
null), ``object`` (``urdf`` and ``pose`` of an articulated one, or null) and ``markers`` (``name``,
``shape`` and ``size`` of each shape that shows a goal, see ``morphgen.tasks.task``).

Arrays of robot ``i`` over T control steps, in SI units, poses as (x, y, z, qw, qx, qy, qz):

    i/q          (T + 1, J)  independent joint positions at the start and after every step
    i/tool       (T + 1, 7)  pose of the tool in the root frame, which is the world's
    i/block      (T + 1, 7)  pose of the block, or of the object's contact point and the link that
                             moves, in the world, if there is one
    i/<marker>   (T + 1, 7)  pose of each marker, such as ``goal`` or ``line`` (push)
    i/score      (T,)        score of every step, see ``morphgen.tasks``
    i/distance   (T,)        distance to success [m]
    i/success    (T,)        whether the step was successful
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

import msgspec
import numpy as np
from numpy.typing import NDArray

from morphgen.encoding.robot_hash import robot_hash
from morphgen.errors import MorphgenError, SimulationError
from morphgen.formats.bundle import split_colours
from morphgen.formats.urdf.write import urdf_text
from morphgen.formats.zip_files import read_npz
from morphgen.model.geometry import Mesh, Pose
from morphgen.model.kinematics import frame_pose
from morphgen.model.robot import Robot
from morphgen.model.rotation import Vec3
from morphgen.tasks.articulated.object_file import read_body
from morphgen.tasks.registry import TASKS
from morphgen.tasks.sim.articulated import ArticulatedObject
from morphgen.tasks.sim.base import Block
from morphgen.tasks.task import Marker
from morphgen.viewer.robot_uri import FileAccess, read_robot_uri

Array = NDArray[np.float32]

FORMAT = 2
BLOCK = "block"  # name of the block, or of the articulated object, among the poses of a track
_OF_STEPS = ("score", "distance", "success")  # values of a track that every step has
STRIDE = 2  # control steps between two frames of a film


@dataclass(frozen=True)
class _Obstacle:
    size: Vec3
    pose: tuple[float, float, float, float, float, float, float]


@dataclass(frozen=True)
class _Object:
    urdf: str
    pose: tuple[float, float, float, float, float, float, float]


@dataclass(frozen=True)
class _Body:
    """An entry of ``bodies``."""

    name: str
    place: str
    body: str
    ground: float | None
    obstacles: tuple[_Obstacle, ...]
    block: Vec3 | None
    markers: tuple[Marker, ...]
    object: _Object | None = None


@dataclass(frozen=True)
class _About:
    """The text ``about`` of an episode's file."""

    format: int
    morphgen: str
    task: str
    policy: str
    seed: int
    obstacles: bool
    simulator: str
    period: float
    bodies: tuple[_Body, ...]


class EpisodeError(MorphgenError):
    """A file is not an episode, or its robot has changed."""


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
    """Poses at the same times of each marker by its name, and of ``block`` or object if any."""
    score: list[float] = field(default_factory=list)
    distance: list[float] = field(default_factory=list)
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


def episode_bytes(episode: Episode) -> bytes:
    """Return an episode's file; the same episode gives the same bytes."""
    bodies = tuple(map(_body, episode.tracks))
    about = _About(
        format=FORMAT, morphgen=version("morphgen"), bodies=bodies, **_shared_fields(episode)
    )
    arrays: dict[str, Any] = {"about": np.array(json.dumps(msgspec.to_builtins(about)))}
    for i, track in enumerate(episode.tracks):
        arrays |= {f"{i}/{name}": values for name, values in _arrays(track).items()}
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    return content.getvalue()


def read_episode(path: Path, files: FileAccess) -> Episode:
    """Read an episode's file with its robots."""
    try:
        arrays = read_npz(path)
        data = json.loads(str(arrays["about"]))
        if data["format"] != FORMAT or data["task"] not in TASKS:
            raise ValueError(f"format {data['format']}, task {data['task']!r}")
        about = msgspec.convert(data, _About)
        tracks = []
        for i, body in enumerate(about.bodies):
            own = {k.partition("/")[2]: v for k, v in arrays.items() if k.startswith(f"{i}/")}
            tracks.append(_track(body, own, files))
        if not tracks:
            raise ValueError("it has no robots")
        if not 0 < about.period < math.inf:
            raise ValueError(f"a period of {about.period:g} s")
    except (
        *(OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError),
        msgspec.MsgspecError,
        SimulationError,
    ) as error:
        raise EpisodeError(f"{path} is not an episode of morphgen view: {error}") from error
    return Episode(tracks=tracks, **_shared_fields(about))


def _shared_fields(record: Episode | _About) -> dict[str, Any]:
    """Return what an episode and the text ``about`` of its file both have."""
    names = ("task", "policy", "seed", "obstacles", "simulator", "period")
    return {name: getattr(record, name) for name in names}


def _body(track: Track) -> _Body:
    return _Body(
        track.robot.name,
        track.uri,
        robot_hash(track.robot),
        track.ground,
        tuple(
            _Obstacle(block.size, (*block.pose.position, *block.pose.quaternion))
            for block in track.obstacles
        ),
        track.block_size,
        track.markers,
        None if track.object is None else _object(track.object),
    )


def _object(thing: ArticulatedObject) -> _Object:
    def refuse(mesh: Mesh) -> NoReturn:
        raise EpisodeError(f"the object has a mesh, {mesh.path}; files of episodes have none")

    pose = (*thing.pose.position, *thing.pose.quaternion)
    return _Object(urdf_text(split_colours(thing.body), refuse), pose)


def _arrays(track: Track) -> dict[str, NDArray[Any]]:
    n = track.num_steps
    q = np.array(track.q[: n + 1], dtype=np.float32)
    tool_poses = [Pose.from_matrix(T) for T in frame_pose(track.robot, q)]
    arrays: dict[str, NDArray[Any]] = {
        "q": q,
        "tool": np.array([[*p.position, *p.quaternion] for p in tool_poses], dtype=np.float32),
        "score": np.array(track.score[:n], dtype=np.float32),
        "distance": np.array(track.distance[:n], dtype=np.float32),
        "success": np.array(track.success[:n], dtype=np.bool_),
    }
    for name, poses in track.poses.items():
        arrays[name] = np.array(poses[: n + 1], dtype=np.float32)
    return arrays


def _track(body: _Body, arrays: Mapping[str, NDArray[Any]], files: FileAccess) -> Track:
    robot = split_colours(read_robot_uri(body.place, files))
    if robot_hash(robot) != body.body:
        raise EpisodeError(
            f"the robot at {body.place} is not the one that was recorded: it has changed since"
        )
    q = arrays["q"]
    if q.ndim != 2 or not len(q):
        raise ValueError(f"q has shape {q.shape}; expected ({robot.dof},) for every moment")
    thing = None
    if body.object is not None:
        thing = ArticulatedObject(read_body(body.object.urdf), _pose(body.object.pose))
    has_block = thing is not None or body.block is not None
    poses = [marker.name for marker in body.markers] + [BLOCK] * has_block
    _require(arrays, {"q": (len(q), robot.dof), **dict.fromkeys(poses, (len(q), 7))})
    _require(arrays, dict.fromkeys(_OF_STEPS, (len(q) - 1,)))
    return Track(
        robot,
        body.place,
        body.ground,
        tuple(Block(obstacle.size, _pose(obstacle.pose)) for obstacle in body.obstacles),
        body.markers,
        body.block,
        thing,
        list(q.astype(np.float32)),
        {name: list(arrays[name].astype(np.float32)) for name in poses},
        arrays["score"].tolist(),
        arrays["distance"].tolist(),
        [bool(success) for success in arrays["success"]],
    )


def _require(arrays: Mapping[str, NDArray[Any]], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Require shapes, and finite numbers, of arrays."""
    for name, shape in shapes.items():
        values = arrays[name]
        if values.shape != shape or values.dtype.kind not in "fb":
            raise ValueError(f"{name} has shape {values.shape}; expected {shape}")
        if not np.isfinite(values).all():
            raise ValueError(f"{name} is not finite")


def _pose(values: Sequence[float]) -> Pose:
    """Return a pose (x, y, z, qw, qx, qy, qz), its quaternion normalised."""
    x, y, z = values[:3]
    qw, qx, qy, qz = (np.array(values[3:]) / np.linalg.norm(values[3:])).tolist()
    return Pose((x, y, z), (qw, qx, qy, qz))
