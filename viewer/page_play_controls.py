"""Controls of a rollout: task, policy, seed and robots; and their state in the address."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import viser

from morphgen.errors import MorphgenError, nearest
from morphgen.rl.baselines import baselines_for
from morphgen.rl.shipped_policies import is_named, policies_for
from morphgen.tasks.registry import TASKS
from morphgen.viewer.address import MAX_PLAYED, Address, parse_count
from morphgen.viewer.robot_picker import Robots, add_picker, picked_uri, robot_lists
from morphgen.viewer.robot_uri import DEFAULT_WORDS, WORDS, FileAccess
from morphgen.viewer.rollout import (
    RolloutConfig,
    list_checkpoints,
    simulators,
    training_robots,
)
from morphgen.viewer.session import Session

ACTIONS = ("replace", "add", "only")
"""Actions on the chosen robot: replace the first, add it, or remove all others."""


@dataclass(eq=False)
class RolloutControls:
    """Controls of a rollout in one browser."""

    session: Session
    config: RolloutConfig
    """Config of the rollout that the page shows."""
    trained_on: Robots
    """Robots that the policy was trained on."""
    start: Callable[[RolloutConfig], object]
    """Starts a rollout."""
    handles: dict[str, Any] = field(default_factory=dict)


def parse_rollout(address: Address, trained_on: Robots) -> RolloutConfig:
    """Return the rollout that an address describes.

    Args:
        address: Address of the page.
        trained_on: Robots that the policy was trained on; the first is the default robot.

    Raises:
        MorphgenError: If the task, simulator or seed is invalid.
    """
    state, installed = address.state, simulators()
    task = address.subject
    if task not in TASKS:
        raise MorphgenError(f"no task {task!r} to play{nearest(task, TASKS)}")
    simulator = state.get("sim", installed[0])
    if simulator not in installed:
        raise MorphgenError(
            f"simulator {simulator!r} is not installed{nearest(simulator, installed)}"
        )
    seed_text = state.get("seed", "0")
    if (seed := parse_count(seed_text, -1)) < 0:
        raise MorphgenError(f"seed {seed_text!r:.80}: expected a whole number, 0 or more")
    robot = trained_on[0][1] if trained_on else WORDS + DEFAULT_WORDS
    return RolloutConfig(
        task,
        (address.robots or (robot,))[:MAX_PLAYED],
        state.get("policy") or baselines_for(task)[0],
        seed,
        bool(state.get("obstacles")),
        simulator,
    )


def rollout_address(config: RolloutConfig) -> Address:
    """Return the address of a rollout; default values are left out."""
    return Address("play", (config.task,), robots=config.robots).with_state(
        policy=config.policy,
        seed=str(config.seed),
        obstacles="yes" if config.obstacles else "",
        sim="" if config.simulator == simulators()[0] else config.simulator,
    )


def complete_address(session: Session) -> Robots:
    """Return the robots that the address's checkpoint was trained on.

    An address without a task gets the task and the obstacles of the training.
    """
    policy = session.address.state.get("policy", "")
    if not policy or is_named(policy):
        return []
    task, obstacles, robots = training_robots(policy, session.files)
    if not session.address.subject:
        address = replace(session.address, subjects=(task,))
        session.address = address.with_state(obstacles="yes" if obstacles else "")
    return robots


def add_rollout_controls(controls: RolloutControls) -> None:
    """Add the controls to the page."""
    gui, session, handles = controls.session.client.gui, controls.session, controls.handles
    config = controls.config
    restart = gui.add_button("New episode", icon=viser.Icon.REFRESH, hint="with the next seed")
    with gui.add_folder("Task"):
        handles["task"] = gui.add_dropdown("task", tuple(TASKS), initial_value=config.task)
        policies = _policies(session.files, config)
        handles["policy"] = gui.add_dropdown("policy", policies, initial_value=config.policy)
        handles["obstacles"] = gui.add_checkbox("obstacles", config.obstacles)
        handles["seed"] = gui.add_number("seed", config.seed, min=0, step=1)
        names = tuple(simulators())
        handles["simulator"] = gui.add_dropdown("simulator", names, initial_value=config.simulator)
    with gui.add_folder("Robots"):
        trained_on = {"trained on": lambda: controls.trained_on} if controls.trained_on else {}
        lists = robot_lists(config.robots[0], session.files, trained_on)
        picker = add_picker(session, lists, lambda: controls.config.robots[0])
        action = gui.add_button_group("this robot", ACTIONS)
    session.on_change(restart, lambda: _change(controls, seed=controls.config.seed + 1))
    session.on_change(handles["task"], lambda: _change_task(controls))

    def apply(name: str) -> None:
        _change(controls, **{name: handles[name].value})

    for name in ("policy", "obstacles", "seed", "simulator"):
        session.on_change(handles[name], functools.partial(apply, name), name)
    session.on_change(picker.robot, lambda: _use_robot(controls, picked_uri(picker), "replace"))
    session.on_change(action, lambda: _use_robot(controls, picked_uri(picker), action.value))


def _policies(files: FileAccess, config: RolloutConfig) -> tuple[str, ...]:
    """Return the task's baselines and shipped policies, and the checkpoints in this folder."""
    names = (*policies_for(config.task), *list_checkpoints(files), config.policy)
    return tuple(dict.fromkeys(names))


def _use_robot(controls: RolloutControls, uri: str, action: str) -> None:
    """Apply one of ``ACTIONS`` to the robot that the user named or picked."""
    robots = controls.config.robots
    if action == "add":
        if len(robots) >= MAX_PLAYED:
            raise MorphgenError(f"at most {MAX_PLAYED} robots are shown")
        _change(controls, robots=(*robots, uri))
    else:
        _change(controls, robots=(uri, *(robots[1:] if action == "replace" else ())))


def _change_task(controls: RolloutControls) -> None:
    """Start another task, with its own baseline if the current one is for the other task."""
    config = replace(controls.config, task=controls.handles["task"].value)
    if is_named(config.policy) and config.policy not in policies_for(config.task):
        config = replace(config, policy=baselines_for(config.task)[0])
    controls.handles["policy"].options = _policies(controls.session.files, config)
    controls.handles["policy"].value = config.policy
    _change(controls, task=config.task, policy=config.policy)


def _change(controls: RolloutControls, **changes: Any) -> None:  # noqa: ANN401
    """Start an episode with another config."""
    controls.config = replace(controls.config, **changes)
    if controls.handles["seed"].value != controls.config.seed:
        controls.handles["seed"].value = controls.config.seed
    controls.start(controls.config)
