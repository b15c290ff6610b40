"""Running statistics equal those of all observations at once, and are part of a checkpoint."""

import torch

from helpers.learners import SMALL, stored
from helpers.line_batch import OnALine
from morphgen.rl.config import PolicyConfig
from morphgen.rl.observation_layout import Layout
from morphgen.rl.policies import MAX_NORMALIZED, RunningNormalizer
from morphgen.rl.ppo import Learner
from morphgen.rl.runs.training import resume_learner, state_of

LAYOUT = Layout(5, 48, 0, 0, (), vectors=(("lag", 1), ("dls", 3)))


def observed(seed, rows=7):
    random = torch.Generator().manual_seed(seed)
    links = torch.rand(rows, 5, generator=random) > 0.4
    lag = 3 + 2 * torch.randn(rows, 5, 1, generator=random)
    return {"links": links, "lag": lag, "dls": torch.randn(rows, 5, 3, generator=random)}


def test_statistics_of_parts_are_those_of_the_whole():
    normalizer, parts = RunningNormalizer(LAYOUT), [observed(seed, 3 + seed) for seed in range(4)]
    for part in parts:
        normalizer.update(part)
    values = torch.cat([torch.cat([p["lag"], p["dls"]], dim=-1)[p["links"]] for p in parts])
    torch.testing.assert_close(normalizer.mean, values.mean(dim=0))
    torch.testing.assert_close(normalizer.variance, values.var(dim=0, unbiased=False))
    assert int(normalizer.count) == len(values)


def test_columns_are_centred_and_scaled_and_padding_stays_zero():
    normalizer, seen = RunningNormalizer(LAYOUT), observed(0, 4000)
    normalizer.update(seen)
    normalized = normalizer(seen)
    values = normalized["lag"][seen["links"]]
    torch.testing.assert_close(values.mean(), torch.tensor(0.0), atol=0.02, rtol=0)
    torch.testing.assert_close(values.std(), torch.tensor(1.0), atol=0.02, rtol=0)
    assert not normalized["lag"][~seen["links"]].any()
    far = {**seen, "lag": seen["lag"] + 1e6}
    assert normalizer(far)["lag"].max() == MAX_NORMALIZED


class Lagging(OnALine):
    """A line whose observations have a lag."""

    def observe(self):
        observation = super().observe()
        return {**observation, "lag": observation["tokens"][..., 32:33] + 4.0}


def learner():
    policy = PolicyConfig("me-graph", discrete=False, observe=("lag",), normalize=True)
    return Learner(Lagging(8, kind="continuous", tree=True), policy, SMALL, seed=0)


def test_learners_update_all_networks_and_resume_with_the_statistics():
    one, other = learner(), learner()
    one.iterate()
    networks = (one.actor, one.critic, one.target_critic)
    assert len({float(network.normalizer.mean) for network in networks}) == 1
    assert abs(float(one.actor.normalizer.mean) - 4.0) < 1.5
    resume_learner(other, stored(state_of(one)))
    one.restart_episodes()
    for _ in range(2):
        one.iterate(), other.iterate()
    for name, value in one.actor.state_dict().items():
        assert value.equal(other.actor.state_dict()[name]), name
