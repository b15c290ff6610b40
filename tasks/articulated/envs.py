"""Environments with articulated objects as tensors: starts, rewards and scores of every step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.model.geometry import Pose
from morphgen.model.inertia import bounding_box
from morphgen.tasks.configs import ArticulatedConfig
from morphgen.tasks.observation import box_tokens
from morphgen.tasks.push.envs import GAP, curriculum_part, moving_result
from morphgen.tasks.random_numbers import EpisodeRandom, Stream
from morphgen.tasks.rows import (
    GoalChoices,
    namespace_of,
    padded_rows,
    positive_part,
    rotated,
    row_sums,
)
from morphgen.tasks.sim.articulated import ArticulatedObject, ObjectJoints
from morphgen.tasks.task import A, EnvSpec, StepFormulas, StepResult, TaskEnvs, TaskState


class ArticulatedFormulas(StepFormulas[A]):
    """Compares joints of objects with where they started; k rows.

    Attributes:
        start: Positions of the joints at the start, shape (k,) [rad or m].
        sign: Directions of the motions, 1 or -1, shape (k,).
        goal: Positions that the joints have to pass, shape (k,) [rad or m].
        travel: Motions that are a success, shape (k,) [rad or m]; the curriculum changes them.
        centre: Centres of the boxes at the contact points, in the frames of the poses, (k, 3) [m].
        surface: Points where tools push, in the frames of the objects' poses, shape (k, 3) [m].
    """

    def __init__(self, config: ArticulatedConfig, tables: Mapping[str, A]) -> None:
        """Keep the constants of the objects, ``object_tables``; all joints are at their goals."""
        self._config = config
        self._sine: A = tables["sine"]
        self._cosine: A = tables["cosine"]
        self._origin: A = tables["origin"]
        self._is_slide: A = tables["is_slide"]
        self._lever: A = tables["lever"]
        self._size: A = tables["size"]
        self.centre: A = tables["centre"]
        self._base: A = tables["base"]
        self._joint: A = tables["joint"]
        self.start: A = 0 * self._lever
        self.goal: A = 0 * self._lever
        self.sign: A = 0 * self._lever
        self.travel: A = 0 * self._lever
        self.surface: A = 0 * self.centre

    def position(self, object_pose: A) -> A:
        """Return the positions of the joints, shape (k,) [rad or m]; see ``object_tables``."""
        xp = namespace_of(object_pose)
        cosine = row_sums(object_pose[..., 3:] * self._cosine)
        sine = row_sums(object_pose * self._sine) - self._origin
        angle = 2 * xp.arctan2(xp.where(cosine < 0, -sine, sine), abs(cosine))
        position: A = xp.where(self._is_slide, sine, angle)
        return position

    def evaluate(self, state: TaskState[A]) -> StepResult[A]:
        """Compare the motions of the joints with the wanted ones."""
        pose = state.object_pose
        moved = self.sign * (self.position(pose) - self.start)
        to_go = positive_part(self.travel - moved) * self._lever
        surface = pose[..., :3] + rotated(pose[..., 3:], self.surface)
        return moving_result(self._config, state, to_go, moved > self.travel, surface)

    def observe(self, object_pose: A) -> dict[str, A]:
        """Return boxes around contact shapes and bases, and the joints."""
        join = namespace_of(object_pose).concatenate
        centre = object_pose[..., :3] + rotated(object_pose[..., 3:], self.centre)
        position = self.position(object_pose)[..., None]
        to_go = self.goal[..., None] - position
        return {
            "object": join([centre, object_pose[..., 3:], self._size], -1),
            "object_base": self._base,
            "object_joint": join([self._joint, position, to_go], -1),
        }


def object_tables(
    objects: Sequence[ArticulatedObject], device: torch.device
) -> dict[str, torch.Tensor]:
    """Return the constants of R objects, a row each.

    The position of a slide is the scalar product of the object's pose and ``sine``, minus
    ``origin``; that of a hinge is twice the angle whose sine is the product of the pose and
    ``sine``, and whose cosine is that of the pose's quaternion and ``cosine``.
    """
    joints = ObjectJoints(objects)
    frame, axis, is_slide = joints.frame, joints.axis, joints.is_slide
    # The product of the frame's inverse and a pose's quaternion turns about the axis: its scalar
    # part, and the part of its vector along the axis, are linear in that quaternion.
    w, xyz = frame[:, 3:4], frame[:, 4:]
    along = np.concatenate(
        [-(axis * xyz).sum(axis=1, keepdims=True), w * axis - np.cross(axis, xyz)], axis=1
    )
    slides = is_slide[:, None]
    direction = np.where(slides, joints.direction, 0.0)
    boxes = np.array([each.contact_box for each in objects])
    numbers = {
        "sine": np.concatenate([direction, np.where(slides, 0.0, along)], axis=1),
        "cosine": frame[:, 3:],
        "origin": (frame[:, :3] * direction).sum(axis=1),
        "lever": np.array([each.lever for each in objects]),
        "centre": boxes[:, 1],
        "joint": np.concatenate([joints.direction, frame[:, :3], slides], axis=1),
    }
    size = torch.from_numpy(boxes[:, 0]).float()
    tables = {name: torch.from_numpy(values).float() for name, values in numbers.items()}
    tables["is_slide"] = torch.from_numpy(is_slide)
    tables["size"] = box_tokens(size.new_zeros(len(size), 7), size)[:, 7:]
    tables["base"] = torch.stack([_base_token(each) for each in objects])
    return {name: values.to(device) for name, values in tables.items()}


def _base_token(thing: ArticulatedObject) -> torch.Tensor:
    """Return the token of a box around what stands still of an object, shape (13,)."""
    if not thing.base_shapes:
        return torch.zeros(13)
    low, high = bounding_box(thing.base_shapes)
    x, y, z = ((low + high) / 2).tolist()
    centre = thing.pose @ Pose((x, y, z))
    pose = torch.tensor([*centre.position, *centre.quaternion])
    return box_tokens(pose, torch.from_numpy(high - low).float())


class ArticulatedEnvs(TaskEnvs):
    """Environments that move the joints of the objects of their robots' start sets."""

    formulas: ArticulatedFormulas[torch.Tensor]

    def __init__(
        self, specs: Sequence[EnvSpec], env_spec_index: torch.Tensor, num_joints: int
    ) -> None:
        """Set up with the whole travel; arguments as of ``Task.make_envs``."""
        self._config: ArticulatedConfig = specs[0].config  # type: ignore[assignment]  # its own type
        sets: list[Any] = [spec.goals for spec in specs]  # each an ArticulatedStartSet
        device = env_spec_index.device
        self._env_spec_index = env_spec_index
        self._choices = GoalChoices(sets, 1, env_spec_index)
        self._q = padded_rows([starts.q for starts in sets], num_joints, device)
        columns = [starts.motions(GAP) for starts in sets]
        self._motions = padded_rows(columns, columns[0].shape[1], device)
        self.fraction = torch.ones(len(env_spec_index), device=device)
        """Part of the travel that is a success now, shape (k,)."""
        tables = object_tables([starts.thing for starts in sets], device)
        self.formulas = ArticulatedFormulas(
            self._config, {name: rows[env_spec_index] for name, rows in tables.items()}
        )
        self._end = torch.zeros(len(env_spec_index), 7, device=device)  # poses at the goals
        # Points before contact, in the frames of the objects' poses.
        self._before = torch.zeros(len(env_spec_index), 3, device=device)

    def begin(
        self, mask: torch.Tensor, random: EpisodeRandom, layout: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw starts of the robots' sets."""
        number = random.integers(Stream.START, self._choices.count(layout))
        start = self._choices.goals(layout, number[:, None])[:, 0]
        motion = self._motions[self._env_spec_index, start]
        pose, end, surface, before = torch.split(motion[:, 2:], [7, 7, 3, 3], dim=1)
        start_q, goal = motion[:, 0], motion[:, 1]
        travel = self.fraction * (goal - start_q).abs()
        drawn = (start_q, goal, torch.sign(goal - start_q), travel, surface, end, before)
        formulas = self.formulas
        numbers = (formulas.start, formulas.goal, formulas.sign, formulas.travel)
        vectors = (formulas.surface, self._end, self._before)
        for kept, new in zip((*numbers, *vectors), drawn, strict=True):
            rows = mask if kept.ndim == 1 else mask[:, None]
            kept.copy_(torch.where(rows, new, kept))
        return self._q[self._env_spec_index, start], pose

    def target_points(self, object_pose: torch.Tensor) -> torch.Tensor:
        """Return a point behind the surface where the tool pushes, that, and its end."""
        surface = self.formulas.surface
        return torch.stack(
            [
                pose[:, :3] + rotated(pose[:, 3:], point)
                for pose, point in (
                    (object_pose, self._before),
                    (object_pose, surface),
                    (self._end, surface),
                )
            ],
            dim=1,
        )

    def marker_poses(self, row: int) -> dict[str, NDArray[np.float32]]:
        """Return the pose of the contact shape at the goal."""
        end = self._end[row : row + 1]
        centre = self.formulas.centre[row : row + 1]
        pose = torch.cat([end[:, :3] + rotated(end[:, 3:], centre), end[:, 3:]], dim=1)
        return {"goal": pose[0].cpu().numpy()}

    def advance(self, progress: float) -> None:
        """Let the travel grow, in equal steps during the first half of the training."""
        formulas = self.formulas
        self.fraction.fill_(curriculum_part(self._config, progress))
        formulas.travel.copy_(self.fraction * (formulas.goal - formulas.start).abs())

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return the part of the travel."""
        return {"fraction": self.fraction.clone()}

    def load_state_dict(self, state: Mapping[str, torch.Tensor]) -> None:
        """Restore the part of the travel."""
        self.fraction.copy_(state["fraction"])
