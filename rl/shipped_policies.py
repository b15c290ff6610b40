"""Registry of trained policies that come with morphgen or with another package.

Importing the registry loads no torch, so that the command line starts quickly.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from morphgen.errors import TaskError
from morphgen.rl.baselines import BASELINES, baselines_for
from morphgen.tasks.registry import Registry


@dataclass(frozen=True)
class ShippedPolicy:
    """Entry of the registry: a checkpoint that is named wherever a path to one may stand."""

    name: str
    """Name in ``POLICIES``."""
    file: Path
    """The checkpoint."""
    tasks: tuple[str, ...]
    """Tasks that the policy is for."""


_FOLDER = Path(__file__).resolve().parent / "checkpoints"
ZERO_SHOT = ShippedPolicy("zero-shot", _FOLDER / "reach" / "checkpoint.pt", ("reach",))
"""The policy of ``morphgen zeroshot``: it reaches with any robot."""
ZERO_SHOT_OBSTACLES = ShippedPolicy(
    "zero-shot-obstacles", _FOLDER / "reach-obstacles" / "checkpoint.pt", ("reach",)
)
"""The policy of ``morphgen zeroshot --obstacles``: it reaches among three boxes."""
ZERO_SHOT_POSE = ShippedPolicy("zero-shot-pose", _FOLDER / "pose" / "checkpoint.pt", ("reach",))
"""The policy of ``morphgen zeroshot --goal pose``: it reaches poses."""
ZERO_SHOT_POSE_OBSTACLES = ShippedPolicy(
    "zero-shot-pose-obstacles", _FOLDER / "pose-obstacles" / "checkpoint.pt", ("reach",)
)
"""The policy of ``morphgen zeroshot --goal pose --obstacles``: it reaches poses among boxes."""
ZERO_SHOT_PUSH = ShippedPolicy("zero-shot-push", _FOLDER / "push" / "checkpoint.pt", ("push",))
"""The policy of ``morphgen zeroshot --task push``: it pushes with any robot."""

POLICIES: Registry[ShippedPolicy] = Registry(
    "policy",
    "morphgen.policies",
    {
        "zero-shot": f"{__name__}:ZERO_SHOT",
        "zero-shot-obstacles": f"{__name__}:ZERO_SHOT_OBSTACLES",
        "zero-shot-pose": f"{__name__}:ZERO_SHOT_POSE",
        "zero-shot-pose-obstacles": f"{__name__}:ZERO_SHOT_POSE_OBSTACLES",
        "zero-shot-push": f"{__name__}:ZERO_SHOT_PUSH",
    },
)
"""Shipped policies by name."""
_ZERO_SHOT = {
    ("reach", "position", False): ZERO_SHOT,
    ("reach", "position", True): ZERO_SHOT_OBSTACLES,
    ("reach", "pose", False): ZERO_SHOT_POSE,
    ("reach", "pose", True): ZERO_SHOT_POSE_OBSTACLES,
    ("push", "position", False): ZERO_SHOT_PUSH,
}


def zero_shot_policy(task: str, goal: str, *, obstacles: bool) -> ShippedPolicy:
    """Return the shipped policy that does a task with any robot."""
    try:
        return _ZERO_SHOT[task, goal, obstacles]
    except KeyError as error:
        wanted, valid = _described(task, goal, obstacles), [_described(*key) for key in _ZERO_SHOT]
        raise TaskError(
            f"no policy for {wanted} comes with morphgen; valid: {', '.join(valid)}; or name a "
            "policy with --policy"
        ) from error


def _described(task: str, goal: str, obstacles: bool) -> str:
    return f"{task}{' of poses' * (goal == 'pose')}{' among obstacles' * obstacles}"


def name_of(file: Path) -> str:
    """Return the name of a shipped policy by its checkpoint; for another file its path."""
    return next((name for name in POLICIES if POLICIES[name].file == file), str(file))


def policies_for(task: str) -> tuple[str, ...]:
    """Return the names of a task's baselines and shipped policies."""
    shipped = (name for name in POLICIES if task in POLICIES[name].tasks)
    return (*baselines_for(task), *shipped)


def tasks_of(policy: str) -> tuple[str, ...] | None:
    """Return the tasks of a baseline or shipped policy; None for all, or if there is none."""
    if policy in POLICIES:
        return POLICIES[policy].tasks
    return BASELINES[policy].tasks if policy in BASELINES else None


def is_named(policy: str) -> bool:
    """Return whether a policy is a baseline or a shipped policy, and not a checkpoint's path."""
    return policy in BASELINES or policy in POLICIES


def checkpoint_path(text: str | Path) -> Path:
    """Return the path of a checkpoint or run folder that is named by its path or as shipped."""
    name = str(text)
    return POLICIES[name].file if name in POLICIES else Path(text)
