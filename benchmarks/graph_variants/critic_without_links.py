"""The agent ``me-graph`` with a critic that does not see the descriptions of links."""

from __future__ import annotations

from morphgen.rl.agents import graph
from morphgen.rl.config import PolicyConfig
from morphgen.rl.observation_layout import Layout

Config = graph.Config


class Network(graph.Network):
    """The same networks; the critic's descriptions are zero."""

    def __init__(self, config: PolicyConfig, layout: Layout, outputs: int, per_link: bool) -> None:
        super().__init__(config, layout, outputs, per_link)
        self.hides_morphology |= not per_link
