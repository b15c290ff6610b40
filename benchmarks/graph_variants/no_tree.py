"""The agent ``me-graph`` with attention that does not know the tree.

Neither tree relations nor Jacobian columns bias the attention, and joints do not see the
descriptions of their parents.
"""

from __future__ import annotations

import torch

from morphgen.rl.agents import graph
from morphgen.tasks.observation import Observation

Config = graph.Config


class Network(graph.Network):
    """The same weights; those of the tree have no effect."""

    def _bias(
        self, observation: Observation, links: torch.Tensor, mask: torch.Tensor
    ) -> torch.Tensor:
        bias = super()._bias(observation, links, mask)
        return torch.where(bias.isneginf(), bias, torch.zeros_like(bias))

    def _of_parents(self, description: torch.Tensor, parents: torch.Tensor) -> torch.Tensor:
        return 0 * super()._of_parents(description, parents)
