"""Goal sets and environment specifications of a robot, by the constants of a task."""

from morphgen.tasks.env_specs import GoalConfig, env_spec
from morphgen.tasks.goal_sets import goal_set
from morphgen.tasks.registry import TASKS


def draw_goals(robot, config, *, obstacles=False, seed=0, **options):
    """The goal set of a robot, from the constants of its task."""
    return goal_set(robot, TASKS[config.task], config, obstacles=obstacles, seed=seed, **options)


def draw_spec(robot, config, *, obstacles=False, seed=0, cache=None):
    """The environment specification of a robot, likewise."""
    own = GoalConfig(seed, (config,))
    return env_spec(robot, config.task, own, obstacles=obstacles, cache=cache)
