"""Record episodes of a policy robot by robot, in any number of processes, and verify them.

Each robot is a unit of work. Its bundle is written first, and the episodes are those of the robot
that is read from the bundle, so that whoever has the folder can simulate them again. The episodes
of a robot wait in a shard; when all are there, ``lerobot.assemble`` writes the data set from them.
An interrupted recording continues. ``replay`` simulates episodes again.
"""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.encoding.tokens import tokens, tokens_npz
from morphgen.errors import TaskError
from morphgen.files import write_atomic
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.bundle import write_bundle
from morphgen.formats.files import begin_folder, locked_folder, require_writable_folder
from morphgen.grammar.library import Library, default_library
from morphgen.grammar.robot_source import is_robot_file, resolve_robot
from morphgen.model.kinematics import joint_limits
from morphgen.model.kinematics_torch import frame_pose, quaternion_from_matrix
from morphgen.model.robot import TOOL, Robot
from morphgen.processes import one_torch_thread, parallel_map, ray_cluster, require_ray
from morphgen.progress import report, stage
from morphgen.rl.baselines import BASELINES, Controller, baselines_for
from morphgen.rl.demonstrations.cameras import filming, require_cameras, video_features
from morphgen.rl.demonstrations.lerobot import (
    BODIES,
    BODY,
    FORMAT,
    INFO,
    RECORDING,
    Arrays,
    assemble,
    require_pyarrow,
    video_path,
)
from morphgen.rl.demonstrations.reader import Demonstrations, RecordedEpisode, at_links
from morphgen.rl.inference import EpisodeResults, make_controller, read_controller
from morphgen.rl.runs.robot_source import (
    GrammarSource,
    OneRobot,
    Source,
    SplitSource,
    draw,
    identity,
    members,
    robot_source,
    tasks_of,
)
from morphgen.splits.split import Member, compose_member
from morphgen.tasks.actions import encode_actions
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.goal_sets import set_npz
from morphgen.tasks.registry import DEFAULT_SIMULATOR, SIMULATORS, TASKS
from morphgen.tasks.renderer import Camera
from morphgen.tasks.scenes.env_specs import GoalConfig, env_spec, load_robot
from morphgen.tasks.scenes.make import batch_from_specs
from morphgen.tasks.split_goals import certify_goal_set, read_goals, shipped_goal_set
from morphgen.tasks.task import EnvSpec

PLANNER = "scripted"
"""Policy that is the best baseline of each task: ``ik`` for reach, ``scripted`` for others."""
SHARDS, TOKENS_FILE = "shards", "tokens.npz"
_SEED_OFFSET = 0xDE_305
"""Mixed into the seeds of episodes, which thus differ from those of training and evaluation."""


def best_of(task: str, policy: str) -> str:
    """Return a policy's name, or for ``PLANNER`` that of the best baseline of a task."""
    return baselines_for(task)[0] if policy == PLANNER else policy


@dataclass(frozen=True)
class RecordingConfig:
    """All that determines the episodes of a data set."""

    sources: tuple[Source, ...]  # robots with their tasks; those of a split have a task each
    policy: str = PLANNER  # a baseline, a shipped policy, a checkpoint, or `PLANNER`
    teacher: str = ""
    """Policy whose actions are the labels, in the states that ``policy`` leads to; empty for those
    of ``policy``. See ``record_states``."""
    episodes: int = 20  # number of episodes of each robot at each of its tasks
    seed: int = 0  # seed of the episodes, of the policy and of the noise
    noise: float = 0.0  # standard deviation of the noise on normalized actions; labels have none
    hold: int = 25
    """Control steps in success, one after another, that end an episode: reach has no other end
    before its time limit, and a robot that stays at its goal shows little more."""
    only_success: bool = False  # whether to keep only the episodes that end in success
    sim: str = DEFAULT_SIMULATOR
    cameras: tuple[Camera, ...] = ()  # cameras whose videos are added, `front` and `wrist`
    depth: bool = False  # whether cameras also have depths
    goals: GoalConfig = field(default_factory=GoalConfig)

    def as_data(self, tasks: Sequence[str]) -> dict[str, Any]:
        """Return the entries of ``recording.json``; they contain no folder of this machine."""
        robots = []
        for source in self.sources:
            entries = identity(source)
            name = Path(source.name).name if is_robot_file(source.name) else source.name
            entries |= {"name": name}
            robots.append({k: v for k, v in entries.items() if k not in ("library", "goal_dir")})
        return {
            "format": FORMAT,
            "morphgen": version("morphgen"),
            "robots": robots,
            "policy": {task: _named(best_of(task, self.policy)) for task in tasks},
            **{key: getattr(self, key) for key in _KEYS},
            "constants": self.goals.as_data(tasks),
        }


_KEYS = ("teacher", "episodes", "seed", "noise", "hold", "only_success", "sim", "cameras", "depth")


def _named(policy: str) -> str:
    return policy if policy in BASELINES or not Path(policy).exists() else Path(policy).name


Unit = dict[str, tuple[Source, Member | OneRobot]]
"""A robot to record, by task: its source, and the member of the split, or of the drawn robots."""


def robots_of(config: RecordingConfig, jobs: int = 1) -> dict[str, Unit]:
    """Return the robots of all sources by their hashes, in order."""
    units: dict[str, Unit] = {}
    for source in config.sources:
        described: Sequence[Member | OneRobot]
        if isinstance(source, OneRobot):
            described = (source,)
        elif isinstance(source, GrammarSource):
            with stage(f"drawing {source.name} for {source.task}", "robot"):
                described = draw(source, config.goals, jobs=jobs).members
        else:
            described = members(source)
            if isinstance(source, SplitSource):  # the text of all robots; each has its own
                source = replace(source, split="")
        for robot in described:
            unit = units.setdefault(robot.robot_hash, {})
            _, known = unit.setdefault(robot.task, (source, robot))
            if known.obstacles != robot.obstacles:
                raise TaskError(
                    f"robot {robot.name}: {robot.task} both among obstacles and without; record "
                    "them apart"
                )
    return units


def record(folder: Path, config: RecordingConfig, *, jobs: int = 1, ray: str | None = None) -> Path:
    """Record the episodes of all robots into a data set, and return its folder.

    An interrupted call continues, and gives the same bytes.

    Args:
        folder: The data set: a new folder, or one that the same config was recorded to.
        config: Robots, tasks, policy and seed.
        jobs: Number of processes.
        ray: Address of a Ray cluster, or an empty text for a local one; None for processes.
    """
    require_pyarrow()
    require_cameras(config.cameras, depth=config.depth)
    require_writable_folder(folder)
    tasks = tuple(dict.fromkeys(task for source in config.sources for task in tasks_of(source)))
    for task in tasks:
        policy = best_of(task, config.policy)
        read_controller(policy, task)  # raises if the policy is not for the task
    settings = config.as_data(tasks)
    if (folder / INFO).is_file():
        begin_folder(folder / RECORDING, settings, "data set", TaskError)
        shutil.rmtree(folder / SHARDS, ignore_errors=True)  # an interrupted run may have left them
        return folder
    robots = robots_of(config, jobs)
    begin_folder(folder / RECORDING, settings, "data set", TaskError)
    with locked_folder(folder):
        (folder / SHARDS).mkdir(exist_ok=True)
        shards = {robot: _shard(folder, robot) for robot in robots}
        missing = [robots[robot] for robot, shard in shards.items() if not shard.is_file()]
        work = partial(record_robot, folder.resolve(), replace(config, sources=()))
        with stage("recording", "robot"):
            run = (
                parallel_map(work, missing, jobs, 1) if ray is None else _on_ray(ray, work, missing)
            )
            for _ in run:
                pass
        try:
            assemble(folder, shards, tasks, video_features(config.cameras, depth=config.depth))
        except TaskError:  # no episode succeeded: leave nothing behind
            for name in (BODIES, SHARDS):
                shutil.rmtree(folder / name)
            (folder / RECORDING).unlink()
            raise
        shutil.rmtree(folder / SHARDS)
    return folder


def read_planner(planner: str, tasks: Sequence[str]) -> None:
    """Require a baseline that can do all tasks."""
    for task in tasks:
        name = best_of(task, planner)
        if name not in BASELINES:
            raise TaskError(f"{planner!r} is no baseline; valid: {', '.join(BASELINES)}")
        read_controller(name, task)  # raises if it is not for the task


def record_states(
    data: Demonstrations,
    folder: Path,
    policy: str | Path,
    planner: str,
    *,
    episodes: int,
    seed: int,
    jobs: int = 1,
) -> Path:
    """Let a policy act with the robots of a data set, and record a planner's actions (DAgger).

    Ross, Gordon and Bagnell 2011, "A reduction of imitation learning and structured prediction to
    no-regret online learning". A round is a data set of its own, with the goals of the other one.
    ``episodes`` are those of each robot at each task.
    """
    sources = tuple(
        robot_source(
            str(data.folder / BODIES / data.robot_hashes[index]),
            task,
            obstacles=bool(spec.scene.obstacles),
            goal_seed=spec.goals.seed,
        )
        for (index, task), spec in data.specs.items()
    )
    config = RecordingConfig(
        sources,
        policy=str(policy),
        teacher=planner,
        episodes=episodes,
        seed=seed,
        sim=data.settings["sim"],
        goals=GoalConfig(tasks=data.configs),
    )
    return record(folder, config, jobs=jobs)


def _shard(folder: Path, robot: str) -> Path:
    return folder / SHARDS / f"{robot}.npz"


def _on_ray(address: str, work: Callable[[Unit], int], units: Sequence[Unit]) -> Iterator[int]:
    """Record robots as tasks of a Ray cluster, whose machines share the folder."""
    ray = require_ray()
    with ray_cluster(address or None):
        remote = ray.remote(num_cpus=1)(lambda unit: work(unit))
        running = [remote.remote(unit) for unit in units]
        while running:
            (done, *_), running = ray.wait(running)
            yield ray.get(done)
            report(len(units) - len(running), len(units))


def record_robot(folder: Path, config: RecordingConfig, unit: Unit) -> int:
    """Write a robot's bundle and the shard of its episodes; return their number."""
    source, described = next(iter(unit.values()))
    library = default_library(tuple(map(Path, source.library)))
    shard, body = _shard(folder, described.robot_hash), folder / BODIES / described.robot_hash
    if isinstance(described, OneRobot):
        robot = resolve_robot(described.name, library)
    else:
        robot = compose_member(described, library)
    write_bundle(robot, body, picture=False, edits_kept=False)
    robot = load_robot(body)  # which the episodes are of
    arrays: dict[str, list[NDArray[Any]]] = {}
    episodes: list[dict[str, Any]] = []
    goals: dict[str, dict[str, Any]] = {}
    fields = {f"field.{f.name}": f.size for task in unit for f in TASKS[task].fields}
    (body / "goals").mkdir()
    path_of = partial(video_path, shard)
    with filming(config.cameras, path_of, depth=config.depth) as film:
        for task, (source, each) in unit.items():
            constants = replace(config.goals, seed=source.goal_seed)
            shipped = None
            if isinstance(source, SplitSource) and source.goal_dir:
                sets = read_goals(source.goal_dir, source.side)
                shipped = shipped_goal_set(sets, each.name, source.goal_dir)
            spec = env_spec(robot, task, constants, obstacles=each.obstacles, shipped=shipped)
            (body / "goals" / f"{task}.npz").write_bytes(set_npz(spec.goals))
            goals[task] = {"key": spec.goals.key, "obstacles": each.obstacles}
            for episode, frames in _record_task(spec, config, described.robot_hash):
                if config.cameras:
                    episode["videos"] = film.add(spec, episode["seed"], frames)
                episodes.append(episode)
                length = episode["length"]
                others = {k: np.zeros((length, n), np.float32) for k, n in fields.items()}
                for name, values in (others | frames).items():
                    arrays.setdefault(name, []).append(values)
    _write_body(body, robot, described, goals, library, film.poses)
    joined = {name: np.concatenate(values) for name, values in arrays.items()}
    joined["episodes"] = np.array(json.dumps(episodes))
    content = io.BytesIO()
    np.savez_compressed(content, **joined)  # type: ignore[arg-type]  # they are not allow_pickle
    write_atomic(shard, content.getvalue())
    return len(episodes)


def _write_body(
    body: Path,
    robot: Robot,
    described: Member | OneRobot,
    goals: Mapping[str, Mapping[str, Any]],
    library: Library,
    cameras: Mapping[str, Any],
) -> None:
    """Write tokens and a summary of a robot beside its bundle."""
    names = [link.name for link in robot.links]
    shapes = token_shapes(robot, library.folders)
    array = tokens(robot, shapes, max_links=max(len(names), 2))
    (body / TOKENS_FILE).write_bytes(tokens_npz(array, names, robot.name, max(len(names), 2)))
    tool = robot.frame(TOOL)
    joints = []
    for k, (lower, upper) in zip(robot.independent_joints, joint_limits(robot), strict=True):
        joint = robot.joints[k]
        facts = {"name": joint.name, "kind": joint.kind, "lower": lower, "upper": upper}
        joints.append(facts | {"velocity": joint.velocity, "effort": joint.effort})
    parts = robot.provenance.get("parts", [])
    assert isinstance(parts, list)
    licences = sorted({part.get("licence", "") for part in parts} - {""})
    data = {
        "robot_hash": described.robot_hash,
        "name": robot.name,
        "category": described.category if isinstance(described, Member) else "",
        "derivation": robot.provenance.get("derivation", ""),
        "licences": licences,
        "joints": joints,
        "tool": {"link": tool.link, **asdict(tool.T_link_frame)},
        "goals": goals,
        **({"cameras": cameras} if cameras else {}),
    }
    (body / BODY).write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")


def episode_seeds(seed: int, robot: str, task: str, count: int) -> list[int]:
    """Return the seed of each episode of a robot, by its hash, at a task."""
    words = [_SEED_OFFSET, seed, int(robot, 16), *task.encode()]
    states = np.random.SeedSequence(words).generate_state(count, np.uint64)
    return [int(state >> 1) for state in states]  # Parquet has no unsigned column in LeRobot


def _record_task(
    spec: EnvSpec, config: RecordingConfig, robot: str
) -> Iterator[tuple[dict[str, Any], Arrays]]:
    """Yield the episodes of a robot at a task, each with the arrays of its steps."""
    policy = best_of(spec.task, config.policy)
    controller_spec = read_controller(policy, spec.task)
    seeds = episode_seeds(config.seed, robot, spec.task, config.episodes)
    simulator = SIMULATORS[config.sim]
    batch = batch_from_specs(
        [spec],
        len(seeds),
        sim=config.sim,
        device=simulator.devices[0],
        workers=1,
        **vars(controller_spec.interface),
    )
    with closing(batch):
        controllers = [make_controller(controller_spec, config.seed)]
        if config.teacher:
            teacher = read_controller(best_of(spec.task, config.teacher), spec.task)
            controllers.append(make_controller(teacher, config.seed))
        generator = torch.Generator().manual_seed(seeds[0])
        results, steps = _run(batch, controllers, seeds, config, generator)
        stacked = {k: torch.stack([step[k] for step in steps]).cpu().numpy() for k in steps[0]}
        for seed, episode in zip(seeds, results.episodes(batch), strict=True):
            arrays = {k: v[: episode.steps, episode.env] for k, v in stacked.items()}
            if not episode.diverged and (episode.success or not config.only_success):
                facts = {"task": spec.task, "policy": _named(policy), "seed": seed}
                facts |= {k: getattr(episode, k) for k in ("success", "score", "distance")}
                yield {**facts, "length": episode.steps}, arrays


@one_torch_thread()
def _run(
    batch: TaskBatch,
    controllers: Sequence[Controller],
    seeds: Sequence[int],
    config: RecordingConfig,
    generator: torch.Generator,
) -> tuple[EpisodeResults, list[dict[str, torch.Tensor]]]:
    """Run an episode of every environment; return the results and all steps, (n, ...) each.

    The first controller acts. The actions of the last one are the labels.
    """
    noise, hold = config.noise, config.hold
    batch.reset(seed=seeds)
    results = EpisodeResults(batch.num_envs, 1, batch.device)
    successes, steps = torch.zeros_like(batch.episode_step), []
    while not bool((results.finished > 0).all()):
        values = step_state(batch)
        mask = batch.action_mask
        acted, *labels = (
            batch.decode_actions(each.act(batch), mask.shape).where(mask, 0.0)
            for each in controllers
        )
        action, executed = (labels or [acted])[-1], acted  # the first controller acts
        if noise:
            random = torch.randn(mask.shape, generator=generator).to(action)
            executed = (acted + noise * random).clamp(-1, 1).where(mask, 0.0)
        given = encode_actions(executed, batch.action_kind)
        executed = batch.decode_actions(given, mask.shape)
        values["normalized_action"] = at_joints(batch, action)
        values["action"] = commanded_targets(batch, values["normalized_action"])
        if noise or labels:
            values["executed_action"] = at_joints(batch, executed)
        step = batch.step(given)
        successes = torch.where(step.success, successes + 1, 0)
        is_held = (successes >= hold) & ~step.terminated
        step = replace(step, truncated=step.truncated | is_held)
        results.add(step)
        batch.is_idle = results.finished > 0
        values |= {"reward": step.reward, "success": step.success}
        values["done"] = step.terminated | step.truncated
        steps.append(values)
    return results, steps


def step_state(batch: TaskBatch) -> dict[str, torch.Tensor]:
    """Return all that the observations of a batch depend on, and what data sets add, (n, ...)."""
    simulation, q = batch.simulation, batch.q
    T_root_tool = frame_pose(batch.robot_tables.tool_chain, batch.env_robot_index, q)
    rotation = quaternion_from_matrix(T_root_tool[:, :3, :3])
    names = [field.name for task in {s.task for s in batch.specs} for field in TASKS[task].fields]
    fields = batch.groups.fields(simulation.object_pose)
    return {
        "q": q,
        "qd": simulation.qd.clone(),
        "targets": batch.targets.clone(),
        "tool_pose": torch.cat([T_root_tool[:, :3, 3], rotation], dim=1),
        "object_pose": simulation.object_pose.clone(),
        **{f"field.{name}": fields[name] for name in names},
    }


def commanded_targets(batch: TaskBatch, action: torch.Tensor) -> torch.Tensor:
    """Return the joint targets that normalized actions of joints (n, J) command, [rad or m]."""
    tables, index = batch.robot_tables, batch.env_robot_index
    targets: torch.Tensor = batch.targets + action * tables.max_step[index]
    return targets.clamp(tables.lower[index], tables.upper[index])


def at_joints(batch: TaskBatch, action: torch.Tensor) -> torch.Tensor:
    """Return actions of links (n, L) by independent joint, shape (n, J)."""
    link = batch.robot_tables.link_of_joint[batch.env_robot_index]
    return torch.gather(action, 1, link)


_COMPARED = ("observation.state", "observation.object_pose", "next.reward")
TOLERANCE = 1e-3
"""Largest deviation of a joint or of the object [rad or m]: another processor rounds differently,
and a contact makes a difference grow."""


@dataclass(frozen=True)
class Replay:
    """A recorded episode beside the same one in the simulator."""

    episode: RecordedEpisode
    robot: str  # name of the robot
    joint_error: float  # largest difference of a joint's position in any step [rad or m]
    object_error: float  # largest difference of the object's position in any step [m]
    reward_error: float  # largest difference of a reward
    success: bool  # whether the simulated episode ended in success
    faults: tuple[str, ...]  # faults of the certificates of its goals

    @property
    def agrees(self) -> bool:
        """Whether the episode is as it was recorded."""
        errors = self.joint_error, self.object_error
        is_near = all(error <= TOLERANCE for error in errors)  # unlike of max, NaN is never near
        return is_near and self.success == self.episode.success and not self.faults


def choose_episodes(demos: Demonstrations, count: int, seed: int) -> list[int]:
    """Return the indices of random episodes, ascending: all of them if there are no more."""
    total = len(demos.episodes)
    rng = np.random.default_rng(seed)
    return sorted(rng.choice(total, size=min(count, total), replace=False).tolist())


def replay(demos: Demonstrations, episodes: Sequence[int]) -> Iterator[Replay]:
    """Simulate episodes again, and yield how far they are from the recorded ones."""
    return (_replay(demos, demos.episodes[index]) for index in episodes)


@one_torch_thread()
def _replay(demos: Demonstrations, episode: RecordedEpisode) -> Replay:
    columns = {name: demos.columns[name][episode.first :][: episode.length] for name in _COMPARED}
    executed = demos.columns.get("executed_action", demos.columns["normalized_action"])
    spec = demos.spec(episode.robot_index, episode.task)
    dof, sim = spec.robot.dof, demos.settings["sim"]
    device = SIMULATORS[sim].devices[0]
    batch = batch_from_specs([spec], 1, sim=sim, device=device, workers=1)
    errors = torch.zeros(3)
    with closing(batch):
        batch.reset(seed=[episode.seed])
        for t in range(episode.length):
            state = {name: values.cpu() for name, values in step_state(batch).items()}
            action = executed[episode.first + t, None, :dof].to(batch.device)
            step = batch.step(at_links(batch, action))
            pairs = (
                (state["q"], columns["observation.state"][t, :dof]),
                (state["object_pose"][:, :3], columns["observation.object_pose"][t, :3]),
                (step.reward.cpu(), columns["next.reward"][t]),
            )
            differences = [(mine - recorded).abs().max() for mine, recorded in pairs]
            errors = torch.maximum(errors, torch.stack(differences))
            success = bool(step.success)
    faults = certify_goal_set(spec.goals, spec)
    joints, thing, reward = errors.tolist()
    return Replay(episode, spec.robot.name, joints, thing, reward, success, faults)
