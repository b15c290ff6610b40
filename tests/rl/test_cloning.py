"""Cloning of demonstrations: what is learned, resuming, DAgger, and refusals."""

import json
from contextlib import closing

import pytest
import torch

import morphgen
from helpers.runs import equal
from morphgen.errors import TaskError
from morphgen.rl.demonstrations.cloning import recorded_source, returns_of
from morphgen.rl.demonstrations.recording import record_states
from morphgen.rl.inference import load_policy
from morphgen.rl.runs.checkpoint import read_checkpoint
from morphgen.tasks.configs import DrawerConfig, ReachConfig
from morphgen.tasks.scenes.make import make_batch

pytest.importorskip("pyarrow")


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    """Return a data set of one robot that reaches."""
    folder = tmp_path_factory.mktemp("data") / "demos"
    return morphgen.record("prims", tasks=["reach"], episodes=6, hold=5, out=folder)


def test_a_clone_repeats_the_planner(demos, tmp_path):
    run = morphgen.clone(demos.folder, epochs=100, minibatch=128, out=tmp_path / "run")
    result = morphgen.evaluate(run.folder, robots="prims task=reach", episodes=20)
    (score,) = result.scores["deterministic"]
    assert score.success > 0.5
    lines = (run.folder / "metrics.jsonl").read_text("utf-8").splitlines()
    first, last = (json.loads(line) for line in (lines[0], lines[-1]))
    assert last["policy_loss"] < first["policy_loss"]
    assert last["explained_variance"] > 0.5


def test_a_policy_for_several_tasks_sees_the_fields_of_each(demos, tmp_path):
    """The steps of a chunk, and the first of all, may be of one task."""
    other = morphgen.record("prims", tasks=["drawer"], episodes=1, out=tmp_path / "drawer")
    both = [demos.folder, other.folder]
    run = morphgen.clone(both, epochs=0.2, minibatch=64, out=tmp_path / "run")
    assert "object_base" in str(read_checkpoint(run.folder)[1]["layout"])
    policy, configs = load_policy(run.folder), (ReachConfig(num_goals=2), DrawerConfig(num_goals=2))
    for task in ("reach", "drawer"):
        options = {"sim": "mujoco", "configs": configs, **policy.batch_options}
        with closing(make_batch(task, ["prims"], 1, cache=tmp_path, **options)) as batch:
            observation = batch.reset()
            assert policy.act(observation).shape == observation["links"].shape


def test_the_same_seed_gives_the_same_weights(demos, tmp_path):
    options = {"epochs": 1, "minibatch": 64, "seed": 3}
    runs = [morphgen.clone(demos.folder, out=tmp_path / name, **options) for name in "ab"]
    assert equal(*(read_checkpoint(run.folder)[1]["actor"] for run in runs))


def test_returns_are_discounted_to_the_end_of_the_episode(demos):
    returns, rewards = returns_of(demos, 0.9), demos.columns["next.reward"].flatten()
    for episode in demos.episodes:
        last = episode.frames[-1]
        assert returns[last] == rewards[last]
        assert returns[last - 1] == pytest.approx(float(rewards[last - 1] + 0.9 * rewards[last]))


def test_dagger_labels_the_states_of_the_policy(demos, tmp_path):
    small = {"epochs": 0.5, "minibatch": 64, "rounds": 1, "episodes": 2}
    run = morphgen.clone(demos.folder, dagger="jacobian", out=tmp_path / "run", **small)
    assert run.folder == tmp_path / "run" / "round1"
    states = morphgen.demos(tmp_path / "run" / "demos1")
    assert {each.policy for each in states.episodes} == {"round0"}
    label, executed = states.columns["normalized_action"], states.columns["executed_action"]
    assert not torch.equal(label, executed)
    assert run.config.initial_checkpoint.endswith("round0/checkpoint.pt")
    assert morphgen.verify(states.folder, episodes=1).agrees
    small |= {"dagger": "jacobian", "out": tmp_path / "run"}
    assert morphgen.clone(demos.folder, resume=True, **small).folder == run.folder


def test_a_clone_sees_the_path_of_its_teacher(tmp_path):
    """The channel ``ik`` depends on earlier steps, so episodes are observed step by step."""
    recorded = {"policy": "path", "episodes": 5, "only_success": True}
    data = morphgen.record("arm3-stick", tasks=["push"], out=tmp_path / "demos", **recorded)
    agent = {"agent": "me-graph+ik+contact+pace", "epochs": 60, "minibatch": 128}
    run = morphgen.clone(data.folder, out=tmp_path / "run", **agent)
    result = morphgen.evaluate(run.folder, robots="arm3-stick task=push", episodes=10)
    (score,) = result.scores["deterministic"]
    assert score.success > 0.5


def test_obstacles_are_those_of_the_goals_of_each_robot(tmp_path):
    """A split says of each of its robots whether it is among obstacles."""
    out = {"tasks": ["reach"], "obstacles": True, "episodes": 1, "out": tmp_path / "demos"}
    data = morphgen.record("prims", **out)
    del data.settings["robots"][0]["obstacles"]
    assert recorded_source([data]).obstacles
    states = record_states(data, tmp_path / "states", "jacobian", "ik", episodes=1, seed=1)
    assert morphgen.demos(states).specs[0, "reach"].goals.key == data.specs[0, "reach"].goals.key


def test_training_begins_with_the_networks_of_a_clone(demos, tmp_path):
    clone = morphgen.clone(demos.folder, epochs=0.5, minibatch=64, out=tmp_path / "clone")
    steps = {"steps": 256, "envs": 8, "constants": {"num_steps": 32, "minibatches": 2}}
    run = morphgen.train("prims task=reach", initial=clone.folder, out=tmp_path / "run", **steps)
    assert run.config.initial_checkpoint == "../clone/checkpoint.pt"
    assert run.config.policy == clone.config.policy
    actors = [read_checkpoint(each.folder)[1]["actor"] for each in (clone, run)]
    assert actors[1]["normalizer.count"] > actors[0]["normalizer.count"] > 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"agent": "se"}, "learns one robot"),
        ({"demonstrations": []}, "expected the folder"),
        ({"epochs": 0}, "more than 0"),
        ({"dagger": "zero-shot"}, "no baseline; valid"),
        ({"dagger": "nobody"}, "no baseline; valid"),
    ],
)
def test_refusals(demos, tmp_path, changes, message):
    with pytest.raises(TaskError, match=message):
        morphgen.clone(**{"demonstrations": demos.folder, "out": tmp_path / "run"} | changes)
    assert not (tmp_path / "run").exists()


def test_a_data_set_that_changed_is_refused(demos, tmp_path):
    run = morphgen.clone(demos.folder, epochs=0.2, minibatch=64, out=tmp_path / "run")
    text = (run.folder / "config.json").read_text("utf-8")
    content = run.config.source.content[0]
    (run.folder / "config.json").write_text(text.replace(content, "0" * 64), "utf-8")
    with pytest.raises(TaskError, match="content"):
        morphgen.clone(demos.folder, epochs=0.2, minibatch=64, out=tmp_path / "run", resume=True)
