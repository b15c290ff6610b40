"""Measure the scores of the agent ``me-graph`` without each of its parts.

    python benchmarks/graph_ablation.py interpolation/arm3/reach --seeds 0..1 --steps 7e5
        --sim mujoco --envs 160 --out ablation

The options are those of ``morphgen study``, without ``--agents``. Rows are ``me-graph`` as it is;
without each of its observation channels, and without all of them; without normalization; with
advantages normalized robot by robot, and with the mean entropy of the joints; and two agents of
``graph_variants``: attention without the tree, and a critic without descriptions of links.
"""

from __future__ import annotations

import runpy
import sys
from dataclasses import replace

from morphgen.rl.agents import AGENTS, ME_GRAPH, Agent

WITHOUT_TREE, CRITIC_WITHOUT_LINKS = "graph-without-tree", "graph-critic-without-links"
AGENT_LABELS = (
    "me-graph",
    *(f"me-graph-{channel}" for channel in ("lag", "joint", "jacobian", "dls")),
    "me-graph-jacobian-dls",
    "me-graph-normalize-lag-joint-jacobian-dls",
    "me-graph-normalize",
    "me-graph+robot-advantages",
    "me-graph+joint-entropy",
    WITHOUT_TREE,
    CRITIC_WITHOUT_LINKS,
)


def variant(name: str, module: str) -> Agent:
    """Return an agent with the networks of a module and all else as ``me-graph`` has it."""
    return replace(ME_GRAPH, name=name, module=f"graph_variants.{module}")


if __name__ == "__main__":
    AGENTS.register(variant(WITHOUT_TREE, "no_tree"))
    AGENTS.register(variant(CRITIC_WITHOUT_LINKS, "critic_without_links"))
    agents = [] if "--agents" in sys.argv else ["--agents", ",".join(AGENT_LABELS)]
    sys.argv = ["morphgen", "study", *sys.argv[1:], *agents]
    runpy.run_module("morphgen", run_name="__main__", alter_sys=True)
