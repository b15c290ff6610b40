"""Videos of recorded episodes: a camera that stands and one at the tool, in colour and depth.

All episodes of a robot are one file per camera. Depths are coded as LeRobot does: 12 bits, in
proportion to the logarithm of the depth plus 3.5 m, from 0.01 m to 10 m, without loss.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, get_args

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray

from morphgen.errors import TaskError, nearest
from morphgen.rl.demonstrations.lerobot import FPS, Arrays, moments
from morphgen.tasks.renderer import (
    FRONT_FOV,
    WRIST,
    WRIST_FOV,
    Camera,
    Renderer,
    RenderState,
    require_complete,
)
from morphgen.tasks.scenes.make import batch_from_specs
from morphgen.tasks.task import EnvSpec

CAMERAS: tuple[Camera, ...] = get_args(Camera)
SIZE = (256, 256)  # width and height of a frame [pixels]
DEPTH_MIN, DEPTH_MAX, DEPTH_SHIFT = 0.01, 10.0, 3.5  # of the code of a depth [m]
_MAX_CODE = 4095
_EVERY_FRAME, _EVERY_PIXEL = 10, 8  # one of so many is part of the statistics
_INFO: dict[str, object] = {
    "video.height": SIZE[1],
    "video.width": SIZE[0],
    "video.fps": FPS,
    "has_audio": False,
}
_COLOUR: dict[str, object] = {
    "video.codec": "h264",
    "video.pix_fmt": "yuv420p",
    "video.channels": 3,
}
_DEPTH: dict[str, object] = {
    **{"video.codec": "hevc", "video.pix_fmt": "gray12le", "video.channels": 1},
    **{"video.depth_min": DEPTH_MIN, "video.depth_max": DEPTH_MAX, "video.shift": DEPTH_SHIFT},
    **{"video.use_log": True, "depth_unit": "m"},
}
_ENCODERS: dict[bool, dict[str, Any]] = {
    False: {"pix_fmt_in": "rgb24", "pix_fmt_out": "yuv420p", "codec": "libx264", "quality": 7},
    True: {"pix_fmt_in": "gray12le", "pix_fmt_out": "gray12le", "codec": "libx265"},
}
_LOSSLESS = ["-x265-params", "lossless=1:log-level=none", "-tag:v", "hvc1"]
# A frame that can be decoded alone every 10: readers jump. One thread, and no version of ffmpeg in
# the file: the same frames give the same bytes.
_OUTPUT = ["-g", "10", "-threads", "1", "-fflags", "+bitexact", "-flags:v", "+bitexact"]


def require_cameras(cameras: Sequence[str], *, depth: bool) -> None:
    """Require names of cameras, and a camera for depths."""
    for name in cameras:
        if name not in CAMERAS:
            raise TaskError(f"unknown camera {name!r}{nearest(name, CAMERAS)}")
    if depth and not cameras:
        raise TaskError("depth: only with cameras")


def video_features(cameras: Sequence[str], *, depth: bool) -> dict[str, dict[str, Any]]:
    """Return the features of LeRobot by name, such as ``observation.images.front_depth``."""
    features = {}
    for name in cameras:
        for is_depth in (False, True)[: 1 + depth]:
            features[f"observation.images.{name}{'_depth' * is_depth}"] = {
                "dtype": "video",
                "shape": [SIZE[1], SIZE[0], 1 if is_depth else 3],
                "names": ["height", "width", "channels"],
                "info": _INFO | (_DEPTH if is_depth else _COLOUR) | {"is_depth_map": is_depth},
            }
    return features


def depth_code(depth: NDArray[np.floating[Any]]) -> NDArray[np.uint16]:
    """Return the 12-bit codes of depths [m]."""
    low, high = math.log(DEPTH_MIN + DEPTH_SHIFT), math.log(DEPTH_MAX + DEPTH_SHIFT)
    share = (np.log(depth + DEPTH_SHIFT) - low) / (high - low)
    codes: NDArray[np.uint16] = np.rint(share * _MAX_CODE).clip(0, _MAX_CODE).astype(np.uint16)
    return codes


@dataclass(eq=False)
class Film:
    """Videos of a robot's episodes, one after another; see ``filming``."""

    cameras: Sequence[Camera]
    depth: bool
    writers: Mapping[str, Generator[None, Any, None]]
    num_frames: int = 0
    poses: dict[str, Any] = field(default_factory=dict)
    """Poses and fields of view of the cameras, by task for the one that stands."""

    def add(self, spec: EnvSpec, seed: int, arrays: Arrays) -> dict[str, Any]:
        """Append an episode; return its first frame and the statistics of each feature."""
        thing, first = spec.scene.object, self.num_frames
        samples: dict[str, list[NDArray[Any]]] = {name: [] for name in self.writers}
        with (
            closing(batch_from_specs([spec], 1, workers=1)) as batch,
            closing(Renderer.of_spec(spec, SIZE)) as renderer,
        ):
            batch.reset(seed=[seed])  # for what the seed determines: goal and obstacles
            markers = batch.groups.marker_poses(0)
            obstacles = batch.layouts.poses[0, : len(spec.scene.obstacles)].numpy()
            self.poses.setdefault("wrist", {"fovy": WRIST_FOV, "T_tool_camera": asdict(WRIST)})
            front = self.poses.setdefault("front", {"fovy": FRONT_FOV, "T_world_camera": {}})
            front["T_world_camera"].setdefault(spec.task, asdict(renderer.front))
            for t, (q, pose) in enumerate(zip(arrays["q"], arrays["object_pose"], strict=True)):
                state = RenderState(q, None if thing is None else pose, markers, obstacles)
                for camera in self.cameras:
                    pixels, depth = renderer.view(state, camera)
                    images: dict[str, tuple[NDArray[Any], NDArray[Any]]]
                    images = {f"observation.images.{camera}": (pixels, pixels / 255)}
                    if self.depth:
                        depth = depth.clip(DEPTH_MIN, DEPTH_MAX)
                        code = depth_code(depth)
                        images[f"observation.images.{camera}_depth"] = code, depth[..., None]
                    for name, (frame, values) in images.items():
                        self.writers[name].send(np.ascontiguousarray(frame))
                        if t % _EVERY_FRAME == 0:
                            samples[name].append(values[::_EVERY_PIXEL, ::_EVERY_PIXEL])
                self.num_frames += 1
        return {
            name: {"first": first, "stats": _image_statistics(np.stack(values))}
            for name, values in samples.items()
        }


def _image_statistics(images: NDArray[Any]) -> dict[str, Any]:
    """Return the statistics of images (n, h, w, c), each of the shape (c, 1, 1)."""
    values = moments(images.reshape(-1, images.shape[-1]).astype(np.float64))
    data: dict[str, Any] = {key: row[:, None, None].tolist() for key, row in values.items()}
    return {**data, "count": [len(images)]}


@contextmanager
def filming(
    cameras: Sequence[Camera], path_of: Callable[[str], Path], *, depth: bool
) -> Generator[Film, None, None]:
    """Yield a film, whose videos are complete after the block."""
    names = video_features(cameras, depth=depth)
    with ExitStack() as stack:
        writers = {}
        for name in names:
            is_depth = name.endswith("_depth")
            output = [*_OUTPUT, *(_LOSSLESS if is_depth else [])]
            writer = imageio_ffmpeg.write_frames(
                str(path_of(name)),
                SIZE,
                fps=FPS,
                ffmpeg_log_level="quiet",
                output_params=output,
                **_ENCODERS[is_depth],
            )
            writers[name] = stack.enter_context(closing(writer))
            writer.send(None)
        film = Film(cameras, depth, writers)
        yield film
    for name in names if film.num_frames else ():
        require_complete(path_of(name), film.num_frames, path_of(name))
