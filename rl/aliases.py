"""Earlier names of config keys, read from run configs, checkpoints, scores and ``--set``.

This is the one table of them. A key is looked up by the section of the file that it is in.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from morphgen.rl.agents import AGENTS, network_fields

ALIASES: Mapping[str, Mapping[str, str]] = {
    "run": {"envs": "num_envs", "begin": "initial_checkpoint", "whole": "full_budget"},
    "source": {"body": "robot_hash", "goals": "goal_dir", "only": "member"},
    "policy": {"mask_morphology": "proprioceptive_only", "fixed_deviation": "fixed_std"},
    "ppo": {
        "transitions": "total_timesteps",
        "steps": "num_steps",
        "clip": "clip_coef",
        "lam": "gae_lambda",
        "target_kl": "desired_kl",
        "gradient_clip": "max_grad_norm",
        "entropy": "ent_coef",
    },
    "learner": {"slow": "target_critic", "share": "actor_lr_scale"},
    "actor": {"deviation": "raw_log_std"},
    "scores": {"exam": "eval"},
}
"""New names by section and old name."""


def renamed(section: str, table: object) -> Any:  # noqa: ANN401
    """Return a stored table with today's names of its keys; other values stay as they are.

    A key that is there under both names keeps its old name as well, so that readers refuse it.
    """
    if not isinstance(table, Mapping):
        return table
    names = ALIASES[section]
    return {
        names[key] if key in names and names[key] not in table else key: value
        for key, value in table.items()
    }


def current_name(name: str) -> str:
    """Return today's name of a number of ``--set``, or of a switch."""
    return ALIASES["ppo"].get(name) or ALIASES["policy"].get(name, name)


def current_run(data: object) -> Any:  # noqa: ANN401
    """Return a stored run config with today's names, in all of its sections."""
    run = renamed("run", data)
    if not isinstance(run, dict):
        return run
    for section, read in (("source", None), ("ppo", None), ("policy", current_policy)):
        if section in run:
            run[section] = read(run[section]) if read else renamed(section, run[section])
    return run


def current_policy(data: object) -> Any:  # noqa: ANN401
    """Return a stored policy config with today's names.

    Until format 2 the sizes of all agents' networks were entries of the policy itself; those of the
    policy's own agent are kept.
    """
    policy = renamed("policy", data)
    if not isinstance(policy, dict) or "network" in policy or policy.get("agent") not in AGENTS:
        return policy
    valid = {field.name for field in fields(AGENTS[policy["agent"]].config)}
    sizes = {name for name, _, _ in network_fields()} & policy.keys()
    network = {name: policy.pop(name) for name in sorted(sizes)}
    return {**policy, "network": {k: v for k, v in network.items() if k in valid}}


def current_learner(data: object) -> Any:  # noqa: ANN401
    """Return the learner of a checkpoint with today's names, in all of its sections."""
    learner = renamed("learner", data)
    if not isinstance(learner, dict):
        return learner
    if "policy" in learner:
        learner["policy"] = current_policy(learner["policy"])
    for key, section in (("config", "ppo"), ("actor", "actor")):
        if key in learner:
            learner[key] = renamed(section, learner[key])
    return learner
