"""Goal sets and environment specifications of a robot, and functions called once."""

from morphgen.tasks.configs import ReachConfig
from morphgen.tasks.goal_sets import goal_set
from morphgen.tasks.registry import TASKS
from morphgen.tasks.scenes.env_specs import GoalConfig, env_spec

CONFIG = ReachConfig(num_goals=12, train_layouts=3, eval_layouts=2)
"""Constants of a small goal set."""
LIFTED = -0.4
"""Height of the ground below a robot that is lifted [m]."""


def draw_goals(robot, config, *, obstacles=False, seed=0, **options):
    """Return the goal set of a robot for a task config."""
    return goal_set(robot, TASKS[config.task], config, obstacles=obstacles, seed=seed, **options)


def draw_spec(robot, config, *, obstacles=False, seed=0, cache=None):
    """Return the environment specification of a robot for a task config."""
    goal_config = GoalConfig(seed, (config,))
    return env_spec(robot, config.task, goal_config, obstacles=obstacles, cache=cache)


def sample_goals(body, cache, *, obstacles=False, seed=0, config=CONFIG, ground=LIFTED):
    """Return the goal set of a lifted robot, by default a small one."""
    return draw_goals(body, config, obstacles=obstacles, seed=seed, ground=ground, cache=cache)


def once(function, key):
    """Return a function that calls another one once for each key of its arguments."""
    known = {}

    def cached(*args, **options):
        at = key(*args, **options)
        if at not in known:
            known[at] = function(*args, **options)
        return known[at]

    return cached
