"""A batch of observations with padding, and small networks for it."""

from types import SimpleNamespace

import pytest
import torch

from morphgen.rl.agents import AGENTS, transformer
from morphgen.rl.config import PolicyConfig
from morphgen.rl.observation_layout import layout_of
from morphgen.rl.policies import make_networks
from morphgen.tasks.observation import tree_entries

N, LINKS, OBSTACLES, POINTS = 4, 6, 3, 8
COUNT = torch.tensor([6, 4, 1, 3])
MASKS = {
    **dict.fromkeys(("tokens", "velocity", "previous_action", "lag", "jacobian"), "links"),
    **{"goal": "goal_mask", "object": "object_mask", "line": "object_mask"},
    **{"obstacles": "obstacle_mask", "points": "point_mask"},
}
"""Mask of the rows of each observation entry."""


def observed(seed=0, *, extras=True):
    """A mixed batch: rows 0 and 1 reach, 2 and 3 push; 3 has no obstacle, and 2 no point."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    links = torch.arange(LINKS) < COUNT[:, None]
    actions = links & (torch.arange(LINKS) > 0)
    actions[2, 0] = True
    pushes = torch.tensor([False, False, True, True])
    found = {
        "tokens": normal(N, LINKS, 48),
        "links": links,
        "actions": actions,
        "goal": normal(N, 7),
        "goal_mask": ~pushes,
        "object": normal(N, 13),
        "object_mask": pushes,
        "line": normal(N, 1),
        "obstacles": normal(N, OBSTACLES, 13),
        "obstacle_mask": torch.tensor([[1, 0, 1], [1, 1, 1], [0, 1, 0], [0, 0, 0]]).bool(),
        **chain_entries(actions),
    }
    if extras:
        found["velocity"], found["previous_action"] = normal(N, LINKS), normal(N, LINKS)
        found["points"], found["tool"] = normal(N, POINTS, 3), normal(N, 3)
        found["point_mask"] = torch.tensor([True, True, False, True])[:, None].repeat(1, POINTS)
        found["point_mask"][0, 5:] = False
        found["lag"], found["jacobian"] = normal(N, LINKS, 1), normal(N, LINKS, 20)
    return found


def chain_entries(actions):
    """Return the tree of robots whose links follow each other, for movable links (n, L)."""
    chain = torch.ones(LINKS, LINKS).tril().bool().expand(len(actions), -1, -1)
    return tree_entries(SimpleNamespace(ancestors=chain), torch.arange(len(actions)), actions)


def mask_of(seen, name):
    """Return the mask of an observation entry, in the entry's shape."""
    mask = seen[MASKS[name]] if name in MASKS else torch.ones(N).bool()
    return mask.reshape(mask.shape + (1,) * (seen[name].dim() - mask.dim())).expand_as(seen[name])


def filled(seen, value):
    """Return the observation with its masked entries filled with a value."""
    values = {k: seen[k].masked_fill(~mask_of(seen, k), value) for k in MASKS if k in seen}
    return {**seen, **values}


def networks(agent="me-tf", seen=None, *, discrete=True, proprioceptive_only=False, lively=True):
    """Return an actor and a critic; ``lively`` ones have noise on the initial weights."""
    layout = layout_of(seen or observed())
    network = transformer.Config(logit_scale=1.0) if agent == "me-tf" else None
    options = {"proprioceptive_only": proprioceptive_only, "tool_position": layout.tool}
    config = PolicyConfig(agent=agent, discrete=discrete, network=network, **options)
    actor, critic = make_networks(config, layout, seed=0)
    if lively:
        generator = torch.Generator().manual_seed(1)
        for each in (*actor.parameters(), *critic.parameters()):
            each.data += 0.1 * torch.randn(each.shape, generator=generator)
    return actor, critic


def outputs(actor, critic, seen):
    """Return the modes, the log-probabilities of sampled actions, and the values."""
    head = actor.distribution(seen)
    return head.mode(), head.log_prob(head.sample(torch.Generator().manual_seed(0))), critic(seen)


agents = pytest.mark.parametrize("agent", list(AGENTS))
kinds = pytest.mark.parametrize("discrete", [True, False], ids=["discrete", "continuous"])
