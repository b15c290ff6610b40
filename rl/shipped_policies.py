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


def _shipped(name: str, folder: str, task: str = "reach") -> ShippedPolicy:
    file = Path(__file__).resolve().parent / "checkpoints" / folder / "checkpoint.pt"
    return ShippedPolicy(name, file, (task,))


_ZERO_SHOT = {
    ("reach", "position", False): _shipped("zero-shot", "reach"),
    ("reach", "position", True): _shipped("zero-shot-obstacles", "reach-obstacles"),
    ("reach", "pose", False): _shipped("zero-shot-pose", "pose"),
    ("reach", "pose", True): _shipped("zero-shot-pose-obstacles", "pose-obstacles"),
    **{
        (task, "position", False): _shipped(f"zero-shot-{task}", task, task)
        for task in ("push", "drawer", "door", "dial")
    },
}
"""Policies of ``morphgen zeroshot`` for any robot, by task, goal and presence of obstacles."""
POLICIES: Registry[ShippedPolicy] = Registry(
    "policy", "morphgen.policies", {each.name: each for each in _ZERO_SHOT.values()}
)
"""Shipped policies by name."""


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
