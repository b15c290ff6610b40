"""Constants of agents and of PPO, each with its source; "paper" is AnyBody, arXiv 2505.14986."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Literal, get_args

from morphgen.errors import TaskError, nearest

AgentName = Literal["se", "me-mlp", "me-tf"]
AGENTS: tuple[AgentName, ...] = get_args(AgentName)
"""``se`` is for one robot, and sees no morphology; ``me-...`` are for many."""
MAX_WIDTH = 8192
"""Numbers of a layer of a network; the weights between two such layers are 256 MiB."""
MAX_LAYERS = 100
"""Layers of a network."""
MAX_STEPS = 16_384
"""Steps of every environment between updates, which are held in memory."""


@dataclass(frozen=True)
class PolicyConfig:
    """Networks of actor and critic: two of the same kind, which share nothing.

    The paper gives no sizes; unless said otherwise these are those of its released code.
    """

    agent: AgentName = "me-tf"
    discrete: bool = True
    """Bins or numbers as actions (paper: bins for reach, numbers for push)."""
    fixed_deviation: bool = False
    """Numbers as actions keep the deviation that they start with (as in the paper's released code,
    by a clamp); otherwise it is learned."""
    mask_morphology: bool = False
    """Hide of the links' tokens all but the codes of the joint positions; ``se`` always does."""
    tool_position: bool = False
    """See where the tool is, too (ours; the paper's policies have to work it out)."""
    mlp_features: int = 16
    """Of a token in the MLP."""
    mlp_width: int = 192
    mlp_layers: int = 3
    features: int = 64
    """Of a token in the transformer."""
    layers: int = 4
    heads: int = 4
    feedforward: int = 512
    decoder: int = 64
    """Width of the MLP from a link's features to its action, and to the value (ours)."""
    logit_scale: float = 64.0
    """What the transformer's numbers for bins are multiplied by (ours): a step of the optimiser
    moves probabilities by as much more. The MLP learns less with it, and has none."""

    def __post_init__(self) -> None:
        """Check.

        Raises:
            TaskError: If the agent is unknown, or a size is none.
        """
        if self.agent not in AGENTS:
            raise TaskError(f"agent {self.agent!r}{nearest(self.agent, AGENTS)}")
        if self.fixed_deviation and self.discrete:
            raise TaskError("fixed-deviation: bins have no deviation; it goes with --no-discrete")
        if not self.logit_scale > 0:
            raise TaskError(f"logit_scale {self.logit_scale:g}: expected more than 0")
        for each in fields(self):
            if each.type == "int":
                most = MAX_LAYERS if each.name.endswith("layers") else MAX_WIDTH
                _at_least(each.name, getattr(self, each.name), 1)
                if getattr(self, each.name) > most:
                    raise TaskError(
                        f"{each.name} {getattr(self, each.name)}: expected at most {most}"
                    )
        if self.features % self.heads:
            raise TaskError(f"features {self.features}: expected a multiple of heads {self.heads}")

    @property
    def kind(self) -> Literal["continuous", "discrete"]:
        """Of the actions."""
        return "discrete" if self.discrete else "continuous"

    @property
    def blind(self) -> bool:
        """Whether the agent sees no morphology."""
        return self.mask_morphology or self.agent == "se"


OWNERS: Mapping[str, tuple[AgentName, ...]] = {
    each.name: ("se", "me-mlp") if each.name.startswith("mlp_") else ("me-tf",)
    for each in fields(PolicyConfig)
    if each.type in ("int", "float")
}
"""Whose networks have which numbers."""


@dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimisation (Schulman et al. 2017), and what the paper adds to it."""

    transitions: int = 2_000_000
    """Steps of all environments together; rounded up to whole updates (paper: 1.28e9)."""
    steps: int = 128
    """Of every environment between updates (paper)."""
    epochs: int = 4
    """Passes over these (paper)."""
    minibatches: int = 16
    """Of an epoch (paper)."""
    clip: float = 0.2
    """Of the ratio of probabilities (paper)."""
    gamma: float = 0.99
    """Discount (paper)."""
    lam: float = 0.95
    """Of generalised advantage estimation (Schulman et al. 2017)."""
    learning_rate: float = 3e-4
    """Of the first update; falls in a line to zero after the last (Schulman et al. 2017)."""
    target_kl: float = 0.0
    """If not 0, the actor's learning rate is lowered where an update changes its actions by more
    than this, and raised where by less: between a hundredth of ``learning_rate`` and all of it. KL
    divergence, nats (after Rudin et al. 2022, "Learning to Walk in Minutes"; for robots that learn
    alone with few environments, where the same learning rate changes more)."""
    adam_epsilon: float = 1e-5
    """Huang et al. 2022, "The 37 implementation details of PPO"."""
    gradient_clip: float = 1.0
    """Largest norm of the actor's gradient, and of the critic's (ours)."""
    entropy: float = 0.002
    """Weight of the entropy, which is the sum of that of the joints (ours)."""
    symlog: bool = True
    """The critic predicts the symlog of returns (paper, after DreamerV3), that of their mean, by
    ``matching_loss`` (ours; the squared error of symlogs learns the mean of the symlogs)."""
    slow_critic: bool = True
    """Returns to learn come from a moving average of the critic (paper)."""
    slow_decay: float = 0.9
    """Of that average, a gradient step (ours; the paper gives none). DreamerV3's 0.98 is a lag of
    an update here, when returns to learn are made of the values of the last but one."""
    task_reweighting: bool = False
    """Robots count with weights drawn anew every gradient step (paper: "random")."""
    curriculum: bool = True
    """Move the line of push; nothing else has one (paper)."""
    bf16: bool = False
    """Networks in bfloat16, by autocast."""
    compile: bool = False
    """Networks and losses by ``torch.compile``; on a GPU as CUDA graphs."""

    def __post_init__(self) -> None:
        """Check.

        Raises:
            TaskError: If a number is out of its range.
        """
        for name in ("transitions", "steps", "epochs", "minibatches"):
            _at_least(name, getattr(self, name), 1)
        if self.steps > MAX_STEPS:
            raise TaskError(f"steps {self.steps}: expected at most {MAX_STEPS}")
        for name in ("clip", "learning_rate", "adam_epsilon", "gradient_clip"):
            if not getattr(self, name) > 0:
                raise TaskError(f"{name} {getattr(self, name):g}: expected more than 0")
        for name in ("gamma", "lam", "slow_decay"):
            if not 0 <= getattr(self, name) <= 1:
                raise TaskError(f"{name} {getattr(self, name):g}: expected 0 to 1")
        for name in ("entropy", "target_kl"):
            if not getattr(self, name) >= 0:
                raise TaskError(f"{name} {getattr(self, name):g}: expected 0 or more")

    def updates(self, num_envs: int) -> int:
        """How many updates the transitions are."""
        return -(-self.transitions // (self.steps * num_envs))

    def minibatch(self, num_envs: int) -> int:
        """Transitions of a minibatch.

        Raises:
            TaskError: If the minibatches would not be of one size.
        """
        size, rest = divmod(self.steps * num_envs, self.minibatches)
        if rest or not size:
            raise TaskError(
                f"{self.steps} steps of {num_envs} environments cannot be split into "
                f"{self.minibatches} equal minibatches"
            )
        return size


def _at_least(name: str, value: int, least: int) -> None:
    if value < least:
        raise TaskError(f"{name} {value}: expected {least} or more")
