"""Goal sets and environment specifications of a robot, by the constants of a task."""

from morphgen.tasks.env_specs import GoalConfig, env_spec
from morphgen.tasks.goal_sets import goal_set
from morphgen.tasks.registry import TASKS


def draw_goals(robot, config, *, obstacles=False, seed=0, **options):
    """Return the goal set of a robot for a task config."""
    return goal_set(robot, TASKS[config.task], config, obstacles=obstacles, seed=seed, **options)


def draw_spec(robot, config, *, obstacles=False, seed=0, cache=None):
    """Return the environment specification of a robot for a task config."""
    goal_config = GoalConfig(seed, (config,))
    return env_spec(robot, config.task, goal_config, obstacles=obstacles, cache=cache)
