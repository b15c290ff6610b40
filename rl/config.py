"""Constants of policies and of PPO, each with its source; "paper" is AnyBody, arXiv 2505.14986.

Agents with switches that are on or off are read from text, as the command line has it:
``me-tf-symlog``.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import lru_cache
from typing import Any, cast, get_type_hints

import msgspec
from msgspec import NODEFAULT

from morphgen.errors import TaskError, nearest
from morphgen.formats.records import Record, dotted_values, read_record
from morphgen.rl.agents import AGENTS, NetworkConfig, network_fields, preset_of, require_numbers
from morphgen.splits.split import Side
from morphgen.tasks.actions import ActionKind
from morphgen.tasks.observation import observation_config
from morphgen.tasks.registry import CHANNELS, TASKS

MAX_NUM_STEPS = 16_384  # largest rollout length per environment; a rollout is held in memory


@dataclass(frozen=True)
class PolicyConfig:
    """An agent and its networks: actor and critic have the same sizes and share no weights."""

    agent: str = "me-tf"  # name in `morphgen.rl.agents.AGENTS`
    discrete: bool = True
    """Actions are bins rather than numbers (paper: bins for reach, numbers for push)."""
    fixed_std: bool = False
    """Keep the initial standard deviation of continuous actions instead of learning it (the paper's
    released code does so, by a clamp)."""
    proprioceptive_only: bool = False
    """Hide all of the link tokens except the codes of the joint positions; ``se`` always does."""
    tool_position: bool = False
    """Show the tool's position to the networks (ours; the paper's policies have to infer it)."""
    observe: tuple[str, ...] = ()
    """Further observation channels, of ``morphgen.tasks.registry.CHANNELS``, in that order."""
    normalize: bool = False  # normalize the kinematic channels by their running means and variances
    residual: bool = False
    """Add the steps that the channel ``ik`` shows to the mean actions. The policy learns what to
    change about them (Silver et al. 2018, Residual policy learning, arXiv 1812.06298)."""
    network: NetworkConfig | None = None
    """Sizes of the agent's networks; by default those of the agent's module."""

    def __post_init__(self) -> None:
        """Check, and fill in the sizes of the networks."""
        observation_config(self.observe)  # raises if a channel is unknown
        if self.fixed_std and self.discrete:
            raise TaskError(
                "fixed-deviation: discrete actions have no deviation; it goes with --no-discrete"
            )
        if self.residual and (self.discrete or "ik" not in self.observe):
            raise TaskError(
                "residual: actions are added to the channel ik; expected --observe ik and "
                "--no-discrete"
            )
        if self.network is None:
            object.__setattr__(self, "network", AGENTS[self.agent].config())

    @property
    def kind(self) -> ActionKind:
        """Kind of the actions."""
        return "discrete" if self.discrete else "continuous"

    @property
    def channels(self) -> tuple[str, ...]:
        """Observation channels that the policy needs, those of its agent included."""
        needed = {*self.observe, *AGENTS[self.agent].channels}
        return tuple(name for name in CHANNELS if name in needed)

    @property
    def hides_morphology(self) -> bool:
        """Whether the networks see joint positions only, by choice or because of the agent."""
        return self.proprioceptive_only or AGENTS[self.agent].proprioceptive_only


def read_fields(
    data: object, kind: type, where: str, given: Collection[str] = ()
) -> dict[str, Any]:
    """Return stored values of a dataclass's fields, except those that are given otherwise."""
    record = read_record(data, _record_of(kind, frozenset(given)), where, TaskError)
    return {name: getattr(record, name) for name in cast(Mapping[str, Any], data)}


@lru_cache(maxsize=64)
def _record_of(kind: type, given: frozenset[str]) -> type[msgspec.Struct]:
    """Return a record with the fields of a dataclass: unlike this it has no unknown keys."""
    hints, declared = get_type_hints(kind), []
    for each in fields(kind):
        default = NODEFAULT if each.default is MISSING else each.default
        if each.default_factory is not MISSING:
            default = msgspec.field(default_factory=each.default_factory)
        if each.name not in given:
            declared.append((each.name, hints[each.name], default))
    return msgspec.defstruct(kind.__name__, declared, bases=(Record,), frozen=True, kw_only=True)


def differences(theirs: Mapping[str, Any], ours: Mapping[str, Any], between: str) -> str:
    """Return which of our values others have not, as ``seed 3, not 4``; empty if they are equal."""
    stored = dotted_values(theirs)
    pairs = {name: (stored.get(name), value) for name, value in dotted_values(ours).items()}
    return "; ".join(
        f"{name} {_short(their)}{between}{_short(our)}"
        for name, (their, our) in pairs.items()
        if their != our
    )


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) < 200 and "\n" not in text else f"of {len(text)} letters"


def policy_from(stored: object, where: str = "policy") -> PolicyConfig:
    """Return the policy config that ``dataclasses.asdict`` made a dictionary of."""
    data = dict(stored) if isinstance(stored, Mapping) else stored
    sizes = data.pop("network", None) if isinstance(data, dict) else None
    values = read_fields(data, PolicyConfig, where, ("network",))
    try:
        policy = PolicyConfig(**values)
    except TaskError as error:
        raise TaskError(f"{where}: {error}") from error
    if sizes is None:
        return policy
    config = AGENTS[policy.agent].config
    return replace(policy, network=config(**read_fields(sizes, config, f"{where}: network")))


@dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimisation (Schulman et al. 2017), and what the paper adds to it."""

    total_timesteps: int = 2_000_000
    """Control steps of all environments together; rounded up to whole updates (paper: 1.28e9)."""
    num_steps: int = 128  # rollout length per environment between updates [control steps] (paper)
    epochs: int = 4  # passes over a rollout per update (paper)
    minibatches: int = 16  # minibatches per epoch (paper)
    clip_coef: float = 0.2  # clip range of the ratio of action probabilities (paper)
    gamma: float = 0.99  # discount factor (paper)
    gae_lambda: float = 0.95
    """Lambda of generalised advantage estimation (Schulman et al. 2017)."""
    learning_rate: float = 3e-4
    """Learning rate of the first update; it falls linearly to zero after the last one (Schulman et
    al. 2017)."""
    desired_kl: float = 0.0
    """KL divergence per update that the actor's learning rate is adapted to [nats]; 0 for no
    adaptation. The rate is lowered after an update with a larger divergence and raised after one
    with a smaller one, between a hundredth of ``learning_rate`` and all of it (after Rudin et al.
    2022, "Learning to Walk in Minutes"). It helps robots that learn alone with few environments,
    where the same learning rate changes the policy more."""
    adam_epsilon: float = 1e-5
    """Epsilon of Adam (Huang et al. 2022, "The 37 implementation details of PPO")."""
    max_grad_norm: float = 1.0
    """Largest norm of the actor's gradient, and of the critic's; each is clipped by itself (ours).
    """
    ent_coef: float = 0.002
    """Weight of the entropy bonus; the entropy is the sum over the joints (ours)."""
    symlog: bool = True
    """Let the critic predict the symlog of the mean return (paper, after DreamerV3), learned by
    ``matching_loss`` (ours; the squared error of symlogs would learn the mean of the symlogs)."""
    slow_critic: bool = True
    """Compute returns with a moving average of the critic, the target critic (paper)."""
    slow_decay: float = 0.9
    """Decay of that average per gradient step (ours; the paper gives none). DreamerV3's 0.98 is a
    lag of one update here: returns would be made of the values of the last update but one."""
    task_reweighting: bool = False
    """Weight the robots randomly, with new weights for every gradient step (paper: "random")."""
    robot_advantages: bool = False
    """Normalize advantages robot by robot instead of over all robots: robots with small rewards
    learn as much as the others (ours)."""
    joint_entropy: bool = False
    """Let the entropy bonus be the mean over a robot's joints instead of their sum, so that it
    weighs the same for robots of any size (ours)."""
    curriculum: bool = True
    """Move the line of the push task from near to far during training (paper), and let the travel
    of drawer, door and dial grow; reach has no curriculum."""
    bf16: bool = False  # run the networks in bfloat16, by autocast
    compile: bool = False  # run networks and losses by `torch.compile`; on a GPU as CUDA graphs

    def __post_init__(self) -> None:
        require_numbers(self, "total_timesteps", "epochs", "minibatches", low=1, high=10**15)
        require_numbers(self, "num_steps", low=1, high=MAX_NUM_STEPS)
        positive = ("clip_coef", "learning_rate", "adam_epsilon", "max_grad_norm")
        require_numbers(self, *positive, above=True)
        require_numbers(self, "gamma", "gae_lambda", "slow_decay", high=1)
        require_numbers(self, "ent_coef", "desired_kl")

    def num_updates(self, num_envs: int) -> int:
        """Return how many updates ``total_timesteps`` are with so many environments."""
        return -(-self.total_timesteps // (self.num_steps * num_envs))

    def minibatch_size(self, num_envs: int) -> int:
        """Return the transitions per minibatch."""
        size, rest = divmod(self.num_steps * num_envs, self.minibatches)
        if rest or not size:
            raise TaskError(
                f"{self.num_steps} steps of {num_envs} environments cannot be split into "
                f"{self.minibatches} equal minibatches"
            )
        return size


NUMBERS: Mapping[str, Any] = {
    field.name: field.default
    for field in fields(PPOConfig)
    if type(field.default) in (int, float) and field.name != "total_timesteps"
}
"""Numbers of ``PPOConfig`` that ``--set`` changes, with their defaults."""


OBSERVATION_SWITCHES = tuple(name.replace("_", "-") for name in CHANNELS)
"""Names of observation channels on the command line."""
SWITCHES = (
    *("symlog", "slow-critic", "task-reweighting", "robot-advantages", "joint-entropy"),
    *("curriculum", "discrete", "fixed-deviation", "mask-morphology", "tool-position"),
    "residual",
    *("normalize", *OBSERVATION_SWITCHES),
)
"""Names of switches on the command line, in the order in which a spec prints them: first those of
``PPOConfig``, then those of ``PolicyConfig``, then observation channels."""
_FIELDS = {"fixed-deviation": "fixed_std", "mask-morphology": "proprioceptive_only"}
"""Fields of ``PolicyConfig`` of switches that have the paper's names; others have the field's."""


@dataclass(frozen=True)
class AgentSpec:
    """An agent with switches; ``configs_of`` decides those that are not named."""

    agent: str  # name of the agent
    switches: Mapping[str, bool] = field(default_factory=dict)
    """Whether a switch is on, by its name."""

    def __str__(self) -> str:
        """Return text such as ``me-tf-symlog+task-reweighting``, in the order of ``SWITCHES``."""
        named = (name for name in SWITCHES if name in self.switches)
        return self.agent + "".join("-+"[self.switches[name]] + name for name in named)


def parse_agent(text: str) -> AgentSpec:
    """Read ``me-tf+discrete-symlog``: an agent, and switches that are on (+) or off (-)."""
    agent = next((name for name in AGENTS if re.match(rf"{re.escape(name)}([+-]|$)", text)), None)
    if agent is None:
        AGENTS[text.partition("+")[0]]  # raises
        raise AssertionError(text)  # an agent's name alone is matched above
    switch = rf"([+-])({'|'.join(SWITCHES)})"
    rest = text[len(agent) :]
    if not re.fullmatch(rf"({switch})*", rest):
        raise TaskError(
            f"agent {text!r}: after {agent} come switches, each with + for on or - for off; "
            f"valid: {', '.join(SWITCHES)}"
        )
    named = re.findall(switch, rest)
    switches = {name: sign == "+" for sign, name in named}
    if len(switches) < len(named):
        raise TaskError(f"agent {text!r}: a switch is named twice")
    return AgentSpec(agent, switches)


def parse_agents(text: str) -> list[tuple[str, AgentSpec, Side]]:
    """Read the agents of a study: their labels, their specs, and the side they are trained on."""
    agents: dict[str, tuple[AgentSpec, Side]] = {}
    for part in text.split(","):
        name, at, side = part.partition("@")
        spec = parse_agent(name)
        if at and (side != "test" or not AGENTS[spec.agent].per_robot):
            valid = " and ".join(name for name in AGENTS if AGENTS[name].per_robot)
            raise TaskError(f"agent {part!r}: only {valid} may be trained elsewhere, on @test")
        label = f"{spec}{at}{side}"
        if label in agents:
            raise TaskError(f"agents {text}: {label} is there twice")
        agents[label] = spec, "test" if at else "train"
    return [(label, spec, side) for label, (spec, side) in agents.items()]


def configs_of(
    spec: AgentSpec, tasks: Sequence[str], changes: Mapping[str, Any], total_timesteps: int
) -> tuple[PolicyConfig, PPOConfig]:
    """Return the policy and the algorithm of a spec.

    Actions are discrete if all tasks prefer it (reach, in the paper), unless the spec says so.
    """
    network = AGENTS[spec.agent].config
    values = dict(changes)
    for name, on in spec.switches.items():
        if name not in OBSERVATION_SWITCHES:
            values[_FIELDS.get(name) or name.replace("-", "_")] = on
    values["observe"] = tuple(
        channel
        for channel, name in zip(CHANNELS, OBSERVATION_SWITCHES, strict=True)
        if spec.switches.get(name, False)
    )

    def values_for(config: type[PolicyConfig | PPOConfig | NetworkConfig]) -> dict[str, Any]:
        names = {field.name for field in fields(config)}
        return {name: value for name, value in values.items() if name in names}

    policy = PolicyConfig(
        spec.agent,
        discrete=all(TASKS[task].discrete_actions for task in tasks),
        network=network(**values_for(network)),
    )
    ppo = PPOConfig(total_timesteps=total_timesteps)
    return replace(policy, **values_for(PolicyConfig)), replace(ppo, **values_for(PPOConfig))


def spec_of(policy: PolicyConfig, ppo: PPOConfig, tasks: Sequence[str]) -> AgentSpec:
    """Return the agent of a run with the switches that its default preset has otherwise."""
    preset = AgentSpec(policy.agent, preset_of(None, policy.agent).switches)
    runs = ((policy, ppo), configs_of(preset, tasks, {}, ppo.total_timesteps))
    own, default = ({**vars(ppo), **vars(policy)} for policy, ppo in runs)
    switches = {}
    for name in SWITCHES:
        field_name = _FIELDS.get(name) or name.replace("-", "_")
        is_on, by_default = (
            field_name in values["observe"] if field_name in CHANNELS else values[field_name]
            for values in (own, default)
        )
        if is_on != by_default:
            switches[name] = bool(is_on)
    return AgentSpec(policy.agent, switches)


def parse_constants(texts: Sequence[str]) -> dict[str, Any]:
    """Read ``name=value`` for numbers of ``PPOConfig`` and of the networks of any agent."""
    valid = {**{name: default for name, default, _ in network_fields()}, **NUMBERS}
    values: dict[str, Any] = {}
    for text in texts:
        name, _, value = text.partition("=")
        if name not in valid:
            raise TaskError(f"unknown constant {name!r}{nearest(name, valid)}")
        try:
            values[name] = type(valid[name])(value)
        except ValueError as error:
            raise TaskError(f"{text}: expected a number as {valid[name]}") from error
    return values


def constants_text() -> str:
    """Return the names that ``parse_constants`` reads, with their defaults without a preset."""
    groups: dict[str, dict[str, Any]] = {"all agents": dict(NUMBERS)}
    for name, default, agents in network_fields():
        groups.setdefault(f"the networks of {' and '.join(agents)}", {})[name] = default
    texts = (
        f"{owner}: {', '.join(f'{name}={value:g}' for name, value in numbers.items())}"
        for owner, numbers in groups.items()
    )
    return "; ".join(texts)


def owners_of(name: str) -> tuple[str, ...]:
    """Return the agents whose networks have a number of a name; all agents for other numbers."""
    return next((agents for size, _, agents in network_fields() if size == name), tuple(AGENTS))
