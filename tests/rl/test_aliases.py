"""Names that configs and checkpoints had in earlier versions are still read."""

import json
from dataclasses import asdict, replace

import pytest
import torch

from helpers.runs import EVAL, QUIET, equal, small_config, weights
from morphgen.errors import TaskError
from morphgen.rl.aliases import ALIASES, current_policy
from morphgen.rl.config import PPOConfig, policy_from
from morphgen.rl.runs.agent_spec import parse_constants
from morphgen.rl.runs.checkpoint import CHECKPOINT, CONFIG, read_checkpoint, read_config
from morphgen.rl.runs.training import train
from morphgen.rl.scores.study import SCORES, agent_cell, read_scores

OTHER_SIZES = {
    "se": ("features", "layers", "heads", "feedforward", "decoder", "logit_scale"),
    "me-mlp": ("features", "layers", "heads", "feedforward", "decoder", "logit_scale"),
    "me-tf": ("mlp_features", "mlp_width", "mlp_layers"),
}
"""Sizes of other agents' networks, which format 2 stored with every agent."""


def old_names(section, table):
    back = {new: old for old, new in ALIASES[section].items()}
    return {back.get(key, key): value for key, value in table.items()}


def old_policy(policy):
    flat = {**{k: v for k, v in policy.items() if k != "network"}, **policy["network"]}
    flat.update(dict.fromkeys(OTHER_SIZES[policy["agent"]], 4))
    return old_names("policy", flat)


def old_run(run):
    return {
        **old_names("run", run),
        "source": old_names("source", run["source"]),
        "policy": old_policy(run["policy"]),
        "ppo": old_names("ppo", run["ppo"]),
    }


def old_checkpoint(content):
    """The content of a checkpoint as format 2 had it, without a hash."""
    learner = content["learner"]
    return {
        "format": 2,
        "run": old_run(content["run"]),
        "learner": {
            **old_names("learner", learner),
            "actor": old_names("actor", learner["actor"]),
            "policy": old_policy(learner["policy"]),
            "config": old_names("ppo", learner["config"]),
        },
    }


@pytest.mark.parametrize("agent", ["me-mlp", pytest.param("me-tf", marks=pytest.mark.slow)])
def test_a_run_of_format_2_is_read_and_resumed_to_the_same_weights(tmp_path, agent):
    config = small_config(agent=agent, total_timesteps=24 * 4 * 8)
    config = replace(config, policy=replace(config.policy, discrete=False, fixed_std=True))
    whole, old = tmp_path / "whole", tmp_path / "old"
    train(whole, config, execution=QUIET)

    class Stop(Exception):  # noqa: N818
        pass

    def stop(report, updates):
        if (old / CHECKPOINT).is_file():
            raise Stop

    with pytest.raises(Stop):
        train(old, config, execution=QUIET, show=lambda part: stop)
    content = torch.load(old / CHECKPOINT, weights_only=True)
    del content["sha256"]
    assert 0 < content["learner"]["update"] < config.num_updates
    stored = old_checkpoint(content)
    assert {"slow", "share"} <= stored["learner"].keys()
    assert {"lam", "clip", "transitions"} <= stored["learner"]["config"].keys()
    assert "deviation" in stored["learner"]["actor"]
    torch.save(stored, old / CHECKPOINT)
    text = json.loads((old / CONFIG).read_text())
    (old / CONFIG).write_text(json.dumps({**old_run(text), "format": 2}))

    assert read_config(old) == config
    assert read_checkpoint(old)[0] == config
    train(old, config, execution=QUIET, resume=True)
    assert equal(weights(old), weights(whole))


@pytest.mark.parametrize("agent", list(OTHER_SIZES))
def test_sizes_of_other_agents_are_left_out(agent):
    policy = small_config(agent=agent).policy
    assert policy_from(current_policy(old_policy(asdict(policy)))) == policy


def test_a_key_under_both_names_is_refused(tmp_path):
    train(tmp_path, small_config(total_timesteps=32), execution=QUIET)
    data = json.loads((tmp_path / CONFIG).read_text())
    data["ppo"]["lam"] = 0.5
    (tmp_path / CONFIG).write_text(json.dumps(data))
    with pytest.raises(TaskError, match="ppo: unknown key 'lam'"):
        read_config(tmp_path)


def test_scores_of_earlier_names_are_read(tmp_path):
    cell = agent_cell(tmp_path, "me-mlp", small_config(), EVAL)
    cell.folder.mkdir(parents=True)
    data = {
        "exam": cell.eval_config.as_data(),
        "source": old_names("source", asdict(cell.source)),
        "scores": {"deterministic": []},
    }
    (cell.folder / SCORES).write_text(json.dumps(data))
    assert read_scores(cell) == {"deterministic": []}


def test_constants_are_set_by_either_name():
    old = ["lam=0.5", "steps=8", "clip=0.1", "entropy=0.01", "gradient_clip=2", "target_kl=0.1"]
    new = parse_constants(old)
    assert new == {
        "gae_lambda": 0.5,
        "num_steps": 8,
        "clip_coef": 0.1,
        "ent_coef": 0.01,
        "max_grad_norm": 2.0,
        "desired_kl": 0.1,
    }
    assert new == parse_constants([f"{name}={value}" for name, value in new.items()])
    assert PPOConfig(**new).gae_lambda == 0.5
