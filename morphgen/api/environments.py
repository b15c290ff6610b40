"""Gymnasium environments of robots at a task, in one call."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, overload

from morphgen.arguments import text_argument
from morphgen.errors import TaskError
from morphgen.extras import explain_missing_extras
from morphgen.grammar.robot_source import is_one_robot, robot_list

if TYPE_CHECKING:
    from morphgen.grammar.robot_source import RobotLike
    from morphgen.tasks.gym.env import TaskEnv
    from morphgen.tasks.gym.vector import TaskVector


@overload
def make_env(
    task: str, robot: RobotLike = ..., *, num_envs: None = None, **options: object
) -> TaskEnv: ...
@overload
def make_env(
    task: str,
    robot: RobotLike | Sequence[RobotLike] = ...,
    *,
    num_envs: int,
    **options: object,
) -> TaskVector: ...
@explain_missing_extras()
def make_env(
    task: str,
    robot: RobotLike | Sequence[RobotLike] = "ur5-plane",
    *,
    num_envs: int | None = None,
    **options: Any,
) -> TaskEnv | TaskVector:
    """Make a Gymnasium environment of a robot at a task, or a vector environment of several.

    Examples:
        >>> env = morphgen.make_env("reach", "arm=ur5 ee=plane")
        >>> observation, info = env.reset(seed=0)
        >>> action = env.action_space.sample()
        >>> observation, reward, terminated, truncated, info = env.step(action)
        >>> terminated, truncated
        (False, False)
        >>> env.close()
        >>> envs = morphgen.make_env("reach", ["ur5-plane", "arm3-stick"], num_envs=4)
        >>> envs.reset(seed=0)[0]["tokens"].shape
        (4, 10, 48)
        >>> envs.close()

    Args:
        task: Name of a task, such as ``reach`` or ``push``.
        robot: A robot, or its name: words of ``compose``, parts joined by dashes, a bundle's folder
            or a URDF. For vector environments it may be a list: environment i has robot i modulo
            their number.
        num_envs: None for one environment without a batch axis, ``TaskEnv``; a number, also 1, for
            that many in a vector environment, ``TaskVector``.
        **options: The simulator (``sim="pybullet"``), ``obstacles=True``, ``kind="discrete"``,
            ``library`` and others: for one environment those of ``TaskEnv``, such as
            ``render_mode="rgb_array"``; for vector environments those of ``make_batch``, such as
            ``workers=2``.

    Raises:
        TaskError: If an argument is unknown or invalid.
        MissingDependencyError: If the extra ``tasks`` or the simulator is not installed.
        MorphgenError: If a robot cannot be composed or read, or cannot do the task.
    """
    texts: dict[str, object] = {"task": task, **options}
    for name in ("task", "sim", "kind"):
        if name in texts and (name, texts[name]) != ("sim", None):
            text_argument(name, texts[name], TaskError)
    if num_envs is None:
        from morphgen.tasks.gym.env import TaskEnv

        if not is_one_robot(robot):
            raise TaskError(f"robot {robot!r}: expected one robot; name several with num_envs")
        return TaskEnv(task, robot, **options)
    from morphgen.tasks.gym.vector import task_vector

    several = robot_list(robot)
    if not several:
        raise TaskError("robot []: expected at least one robot")
    return task_vector(num_envs, task=task, robots=several, **options)
