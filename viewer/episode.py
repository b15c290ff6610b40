"""Episodes as they were played, to be shown again: what moved, and how it was scored.

An episode's file is an ``.npz``. ``about`` is a text of JSON: ``format`` (2), ``morphgen`` (its
version), ``task``, ``policy``, ``seed``, ``obstacles`` (whether any were asked for), ``simulator``,
``period`` (seconds between two moments), and of every body in ``bodies``: ``name``, ``place`` (see
``morphgen.viewer.robot_uri``), ``body`` (its ``robot_hash``), ``ground`` (metres, or null),
``obstacles`` (``size`` and ``pose`` of each), ``block`` (its edges, or null) and ``markers``
(``name``, ``shape`` and ``size`` of each shape that shows a goal, see ``morphgen.tasks.task``).

Arrays of body ``i``, of T control steps, in SI units; poses are (x, y, z, qw, qx, qy, qz):

    i/q          (T + 1, J)  independent joint positions at the start and after every step
    i/tool       (T + 1, 7)  pose of the tool in the root frame, which is the world's
    i/block      (T + 1, 7)  pose of the block in the world, if there is one
    i/<marker>   (T + 1, 7)  pose of each marker, such as ``goal`` (reach) or ``line`` (push)
    i/score      (T,)        score of every step, see ``morgphen.tasks``
    i/distance   (T,)        metres from success
    i/success    (T,)        whether it was successful then

In format 1, which is still read, ``i/goal`` is of shape (7,), and ``line`` is a y in ``bodies``.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morphgen.benchmark.robot_hash import robot_hash
from morphgen.errors import MorphgenError
from morphgen.formats.bundle import split_colours
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import frame_pose
from morphgen.model.robot import Robot
from morphgen.model.rotation import Vec3
from morphgen.tasks.registry import TASKS
from morphgen.tasks.sim.base import Block
from morphgen.tasks.task import Marker
from morphgen.viewer.robot_uri import FileAccess, read_robot_uri

Array = NDArray[np.float32]

FORMAT = 2
_NEAR = 0.03
"""Radius of the ball that showed a goal of format 1, metres."""


class EpisodeError(MorphgenError):
    """A file that is no episode, or one of another robot."""


@dataclass(eq=False)
class Track:
    """What one body did; it grows while its episode is simulated."""

    robot: Robot
    place: str
    ground: float | None
    obstacles: tuple[Block, ...] = ()
    markers: tuple[Marker, ...] = ()
    """Shapes that show the goal."""
    block_size: tuple[float, float, float] | None = None
    q: list[Array] = field(default_factory=list)
    """Positions of the independent joints at every moment, the start first."""
    block: list[Array] = field(default_factory=list)
    """Poses of the block likewise; empty where there is none."""
    marker_poses: dict[str, list[Array]] = field(default_factory=dict)
    """Poses of each marker likewise, by name."""
    score: list[float] = field(default_factory=list)
    distance: list[float] = field(default_factory=list)
    success: list[bool] = field(default_factory=list)
    fault: str = ""
    """Why it did not get to its end."""

    @property
    def steps(self) -> int:
        """Control steps so far."""
        return len(self.q) - 1


@dataclass(eq=False)
class Episode:
    """Bodies at the same task under the same policy."""

    task: str
    policy: str
    seed: int
    obstacles: bool
    simulator: str
    period: float
    """Seconds between two moments."""
    tracks: list[Track]

    @property
    def steps(self) -> int:
        """Control steps so far of the body that has most."""
        return max((track.steps for track in self.tracks), default=0)


def score_until(track: Track, task: str, step: int) -> float | None:
    """The score of an episode as if it had ended, see ``Task.episode_score``.

    Args:
        track: What the body did.
        task: Its task.
        step: Steps that count; later ones than it has are as its last.

    Returns:
        None at the start.
    """
    scores = track.score[:step]
    if not scores:
        return None
    return TASKS[task].episode_score(sum(scores), scores[-1], len(scores))


def still(episode: Episode) -> Episode:
    """The episode as it is now, whatever is simulated meanwhile."""
    return replace(episode, tracks=[_still(track) for track in episode.tracks])


def episode_bytes(episode: Episode) -> bytes:
    """An episode's file; the same episode gives the same bytes.

    Raises:
        MeshError: If a mesh of a robot cannot be read.
    """
    about = {
        "format": FORMAT,
        "morphgen": version("morphgen"),
        "task": episode.task,
        "policy": episode.policy,
        "seed": episode.seed,
        "obstacles": episode.obstacles,
        "simulator": episode.simulator,
        "period": episode.period,
        "bodies": [_about(track) for track in episode.tracks],
    }
    arrays: dict[str, Any] = {"about": np.array(json.dumps(about))}
    for i, track in enumerate(episode.tracks):
        arrays |= {f"{i}/{name}": values for name, values in _arrays(track).items()}
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    return content.getvalue()


def read_episode(path: Path, places: FileAccess) -> Episode:
    """Read an episode's file, with its robots.

    Args:
        path: The file.
        places: Where its robots may be.

    Raises:
        EpisodeError: If it is none, or one of its robots is another now.
        MorphgenError: If there is no such robot any more.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        about = json.loads(str(arrays["about"]))
        if about["format"] not in (1, FORMAT) or about["task"] not in TASKS:
            raise ValueError(f"format {about['format']}, task {about['task']!r}")
        tracks = [
            _track(row, _arrays_of(arrays, f"{i}/"), places)
            for i, row in enumerate(about["bodies"])
        ]
        if not tracks:
            raise ValueError("it has no bodies")
        return Episode(
            about["task"],
            str(about["policy"]),
            int(about["seed"]),
            bool(about["obstacles"]),
            str(about["simulator"]),
            float(about["period"]),
            tracks,
        )
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise EpisodeError(f"{path} is no episode of morphgen view: {error}") from error


def _still(track: Track) -> Track:
    steps = min(track.steps, len(track.score))
    return replace(
        track,
        q=track.q[: steps + 1],
        block=track.block[: steps + 1],
        marker_poses={name: poses[: steps + 1] for name, poses in track.marker_poses.items()},
        score=track.score[:steps],
        distance=track.distance[:steps],
        success=track.success[:steps],
    )


def _arrays_of(arrays: Mapping[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    return {
        name.removeprefix(prefix): values
        for name, values in arrays.items()
        if name.startswith(prefix)
    }


def _about(track: Track) -> dict[str, Any]:
    return {
        "name": track.robot.name,
        "place": track.place,
        "body": robot_hash(track.robot),
        "ground": track.ground,
        "obstacles": [
            {"size": list(block.size), "pose": [*block.pose.position, *block.pose.quaternion]}
            for block in track.obstacles
        ],
        "block": track.block_size and list(track.block_size),
        "markers": [asdict(marker) for marker in track.markers],
    }


def _arrays(track: Track) -> dict[str, NDArray[Any]]:
    steps = track.steps
    q = np.array(track.q[: steps + 1], dtype=np.float32)
    poses = [Pose.from_matrix(T) for T in frame_pose(track.robot, q)]
    found: dict[str, NDArray[Any]] = {
        "q": q,
        "tool": np.array([[*p.position, *p.quaternion] for p in poses], dtype=np.float32),
        "score": np.array(track.score[:steps], dtype=np.float32),
        "distance": np.array(track.distance[:steps], dtype=np.float32),
        "success": np.array(track.success[:steps], dtype=np.bool_),
    }
    for name, moved in track.marker_poses.items():
        found[name] = np.array(moved[: steps + 1], dtype=np.float32)
    if track.block:
        found["block"] = np.array(track.block[: steps + 1], dtype=np.float32)
    return found


def _track(row: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], places: FileAccess) -> Track:
    robot = split_colours(read_robot_uri(str(row["place"]), places))
    if robot_hash(robot) != row["body"]:
        raise EpisodeError(
            f"the robot at {row['place']} is not the one that was recorded: it has changed since"
        )
    q, block = arrays["q"], arrays.get("block")
    if q.ndim != 2 or not len(q):
        raise ValueError(f"q has shape {q.shape}; expected ({robot.dof},) for every moment")
    if "markers" not in row:
        row, arrays = _as_format_2(row, arrays)
    markers = tuple(
        Marker(str(each["name"]), each["shape"], _edges(each["size"])) for each in row["markers"]
    )
    poses = [marker.name for marker in markers] + ["block"] * (row["block"] is not None)
    if any(marker.shape not in ("frame", "box") for marker in markers):
        raise ValueError(f"markers {row['markers']}")
    _require(arrays, {"q": (len(q), robot.dof), **dict.fromkeys(poses, (len(q), 7))})
    _require(arrays, dict.fromkeys(("score", "distance", "success"), (len(q) - 1,)))
    return Track(
        robot,
        str(row["place"]),
        None if row["ground"] is None else float(row["ground"]),
        tuple(_block(each["size"], each["pose"]) for each in row["obstacles"]),
        markers,
        None if block is None else _block(row["block"], block[0]).size,
        list(q.astype(np.float32)),
        [] if block is None else list(block.astype(np.float32)),
        {marker.name: list(arrays[marker.name].astype(np.float32)) for marker in markers},
        arrays["score"].tolist(),
        arrays["distance"].tolist(),
        [bool(each) for each in arrays["success"]],
    )


def _as_format_2(
    row: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Return what an episode of format 1 says of a body, with its goal and line as markers."""
    markers, moments, own = [], len(arrays["q"]), dict(arrays)
    if "goal" in arrays:
        _require(arrays, {"goal": (7,)})
        markers.append({"name": "goal", "shape": "frame", "size": [2 * _NEAR] * 3})
        own["goal"] = np.tile(arrays["goal"], (moments, 1))
    if row["line"] is not None:
        _require(arrays, {"block": (moments, 7)})
        x, ground = float(arrays["block"][0, 0]), float(row["ground"] or 0.0)
        length = 2 * (max(map(float, row["block"])) + 0.3)
        markers.append({"name": "line", "shape": "box", "size": [length, 0.012, 0.002]})
        own["line"] = np.tile([x, float(row["line"]), ground, 1.0, 0.0, 0.0, 0.0], (moments, 1))
    return {**row, "markers": markers}, own


def _require(arrays: Mapping[str, NDArray[Any]], shapes: Mapping[str, tuple[int, ...]]) -> None:
    for name, shape in shapes.items():
        values = arrays[name]
        if values.shape != shape or values.dtype.kind not in "fb":
            raise ValueError(f"{name} has shape {values.shape}; expected {shape}")
        if not np.isfinite(values).all():
            raise ValueError(f"{name} is not finite")


def _edges(size: Any) -> Vec3:  # noqa: ANN401
    x, y, z = (float(value) for value in size)
    return (x, y, z)


def _block(size: Any, pose: Any) -> Block:  # noqa: ANN401
    values = [float(value) for value in pose]
    return Block(_edges(size), Pose((values[0], values[1], values[2]), _unit(values[3:])))


def _unit(quaternion: list[float]) -> tuple[float, float, float, float]:
    w, x, y, z = (np.array(quaternion) / np.linalg.norm(quaternion)).tolist()
    return (w, x, y, z)
