"""Demonstrations: recording, the files, what readers see, and replay."""

import json
import math
import shutil
from contextlib import closing

import imageio_ffmpeg
import numpy as np
import pytest
import torch

import morphgen
from morphgen.benchmark.demonstrations import describe
from morphgen.benchmark.licences import CROISSANT_FILE
from morphgen.encoding.robot_hash import robot_hash
from morphgen.errors import FormatError, MorphgenError, TaskError
from morphgen.formats.bundle import read_bundle
from morphgen.formats.files import folder_hashes
from morphgen.model.kinematics import frame_pose
from morphgen.rl.baselines import BASELINES
from morphgen.rl.demonstrations import recording
from morphgen.rl.demonstrations.cameras import DEPTH_MAX, DEPTH_MIN, DEPTH_SHIFT, depth_code
from morphgen.rl.demonstrations.lerobot import BODIES, INFO, read_episodes
from morphgen.rl.demonstrations.recording import RecordingConfig, record, replay
from morphgen.rl.inference import run_episodes
from morphgen.rl.runs.robot_source import drawn_source, robot_source
from morphgen.tasks.observation import ObservationConfig
from morphgen.tasks.renderer import FRONT_FOV, WRIST, Renderer, RenderState
from morphgen.tasks.scenes.make import batch_from_specs
from morphgen.tasks.scenes.robot_tables import build_robot_tables

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

SHOWN = ("velocity", "previous_action", "tool", "lag", "joint", "poses", "jacobian", "dls", "tree")
CHANNELS = ObservationConfig(**dict.fromkeys(SHOWN, True), points=8)


def config(tasks=("reach",), grammars="prims:1,planar_arm:1", **changes):
    sources = tuple(drawn_source(grammars, task) for task in tasks)
    return RecordingConfig(sources, episodes=2, **changes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two robots at reach, with noise."""
    return record(tmp_path_factory.mktemp("demos") / "demos", config(noise=0.2))


@pytest.fixture(scope="module")
def described(folder, tmp_path_factory):
    """The same with card, licences, Croissant and hashes."""
    copy = copied(folder, tmp_path_factory.mktemp("described"))
    describe(morphgen.demos(copy))
    return copy


@pytest.fixture
def demos(folder):
    return morphgen.demos(folder)


def copied(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "demos")


@pytest.fixture
def copy(folder, tmp_path):
    return copied(folder, tmp_path)


def test_the_folder_is_a_lerobot_data_set(folder):
    info = json.loads((folder / INFO).read_text())
    table = pq.read_table(folder / info["data_path"].format(chunk_index=0, file_index=0))
    assert info["codebase_version"] == "v3.0"
    assert (info["total_episodes"], info["total_frames"]) == (4, len(table))
    assert list(info["features"]) == table.column_names
    for name, feature in info["features"].items():
        size = getattr(table.schema.field(name).type, "list_size", 1)
        assert [size] == feature["shape"], name
    assert table["index"].to_pylist() == list(range(len(table)))
    rows = [*read_episodes(folder)]
    assert [row["episode_index"] for row in rows] == [0, 1, 2, 3]
    assert sum(row["length"] for row in rows) == len(table)
    assert rows[-1]["dataset_to_index"] == len(table)
    stats = json.loads((folder / "meta/stats.json").read_text())
    state = np.array(table["observation.state"].to_pylist())
    np.testing.assert_allclose(stats["observation.state"]["mean"], state.mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(stats["observation.state"]["std"], state.std(axis=0), atol=1e-9)
    tasks = pq.read_table(folder / "meta/tasks.parquet")
    assert tasks.to_pydict() == {"task_index": [0], "task": ["reach"]}


def test_every_episode_has_its_body(folder, demos):
    for episode in demos.episodes:
        body = folder / BODIES / episode.robot_hash
        facts = json.loads((body / "body.json").read_text())
        assert robot_hash(read_bundle(body)) == facts["robot_hash"] == episode.robot_hash
        assert facts["licences"] == ["MIT"]
        assert len(facts["joints"]) == demos.robots[episode.robot_index].dof
        assert facts["derivation"]
        for name in ("robot.urdf", "robot.xml", "tokens.npz", "goals/reach.npz"):
            assert (body / name).is_file()


def test_padding_is_zero_and_counted(demos):
    dofs = [robot.dof for robot in demos.robots]
    assert len(set(dofs)) == 2
    state, count = demos.columns["observation.state"], demos.columns["joint_count"]
    assert state.shape[1] == max(dofs)
    padding = torch.arange(max(dofs)) >= count[:, None]
    assert padding.any()
    for name in ("observation.state", "action", "normalized_action", "executed_action"):
        assert not demos.columns[name][padding].any()


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_observations_equal_those_of_the_environment(demos, kind):
    episode = demos.episodes[-1]
    spec = demos.specs[episode.robot_index, episode.task]
    batch = batch_from_specs([spec], 1, observe=CHANNELS, workers=1)
    observed, labels = demos.observe(episode.frames, CHANNELS, kind=kind)
    executed, _ = demos.columns["executed_action"], batch.reset(seed=[episode.seed])
    for t, frame in enumerate(episode.frames):
        for name, values in batch.observe().items():
            if name not in ("joints", "joint_parents", "joint_relations"):  # padded to more joints
                assert torch.equal(observed[name][t], values[0]), (name, t)
        action = batch.observation.link_joints(executed[frame, None, : spec.robot.dof])
        batch.step(action.where(batch.action_mask, 0.0))
    batch.close()
    assert labels.shape == observed["actions"].shape
    assert labels.is_floating_point() == (kind == "continuous")


def test_the_label_is_the_planners_own_action_and_not_the_noisy_one(demos):
    label, executed = demos.columns["normalized_action"], demos.columns["executed_action"]
    assert (label - executed).abs().max() > 0.1
    targets, action = demos.columns["observation.targets"], demos.columns["action"]
    rows = demos.columns["robot_index"] == 0
    tables = build_robot_tables(demos.robots[:1])
    dof = demos.robots[0].dof
    wanted = targets[rows, :dof] + label[rows, :dof] * tables.max_step[0]
    assert torch.equal(action[rows, :dof], wanted.clamp(tables.lower[0], tables.upper[0]))


def test_items_are_steps_that_a_data_loader_collates(demos):
    loader = torch.utils.data.DataLoader(demos, batch_size=8, shuffle=True)
    batch = next(iter(loader))
    assert batch["action"].shape == (8, demos.columns["action"].shape[1])
    assert len(loader.dataset) == sum(episode.length for episode in demos.episodes)


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("recording.json", '{"format": 9}', "format 9; this version reads 1"),
        ("recording.json", "[]", "no sound data set"),
        ("recording.json", '{"format": 1, "sim": [], "constants": {}}', "name of a simulator"),
        ("recording.json", '{"format": 1, "sim": "mujoco", "constants": {}}', "reach"),
        ("bodies/robots.jsonl", '{"robot_hash": "../../mine"}', "32 hexadecimal digits"),
        ("bodies/robots.jsonl", f'{{"robot_hash": "{"0" * 32}"}}\n' * 2, "names a robot twice"),
        ("bodies/robots.jsonl", "[" * 100_000, "nested deeper"),
        ("data/chunk-000/file-000.parquet", "PAR1", "no sound data set"),
        ("meta/episodes/chunk-000/file-000.parquet", "", "no sound data set"),
    ],
)
def test_damaged_files_are_one_clear_error(copy, name, text, match):
    (copy / name).write_text(text)
    with pytest.raises(FormatError, match=match) as caught:
        morphgen.demos(copy)
    assert "\n" not in str(caught.value)


DATA, EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"


def change_column(folder, name, change):
    """Change a column of a data set by a function of its values."""
    path = folder / (DATA if "." in name or "action" in name else EPISODES)
    table = pq.read_table(path)
    values = change(table[name].to_pylist())
    place, field = table.column_names.index(name), table.schema.field(name)
    pq.write_table(table.set_column(place, field, pa.array(values, field.type)), path)


@pytest.mark.parametrize(
    ("name", "change", "match"),
    [
        ("length", lambda values: [0, *values[1:]], "does not begin where"),
        ("length", lambda values: [*values[:-1], values[-1] + 1], "the episodes have"),
        ("episode_index", lambda values: values[::-1], "does not begin where"),
        ("robot_index", lambda values: [1 - each for each in values], "another robot"),
        ("robot_index", lambda values: [9 for _ in values], "no sound data set"),
        ("robot_index", lambda values: [-1 for _ in values], "negative"),
        ("seed", lambda values: [None for _ in values], "no sound data set"),
        ("task", lambda values: ["../../mine" for _ in values], "mine"),
    ],
)
def test_episodes_that_disagree_with_their_steps_are_refused(copy, name, change, match):
    change_column(copy, name, change)
    with pytest.raises(FormatError, match=match):
        morphgen.demos(copy)


def test_small_files_cannot_take_much_memory(copy):
    table = pq.read_table(copy / EPISODES)
    place = table.column_names.index("policy")
    rows = table.take([0] * 400)
    wide = pa.DictionaryArray.from_arrays([0] * 400, ["x" * 2**20])
    pq.write_table(rows.set_column(place, "policy", wide), copy / EPISODES, store_schema=False)
    with pytest.raises(ValueError, match="more than 256 MB"):
        list(read_episodes(copy))
    steps = pa.table({"index": pa.array(np.zeros(16_000_000, np.int64))})
    pq.write_table(steps, copy / DATA)
    assert (copy / DATA).stat().st_size < 2**20
    with pytest.raises(FormatError, match="16000000 steps in a file of its size"):
        morphgen.demos(copy)
    wide = pa.array(["x" * 2**27, "", "", ""])
    pq.write_table(table.set_column(place, "policy", wide), copy / EPISODES, compression="zstd")
    with pytest.raises(ValueError, match="unpacks to more than 200 times"):
        list(read_episodes(copy))


def test_goals_of_another_robot_or_none_are_refused(copy):
    paths = [copy / BODIES / each / "goals/reach.npz" for each in morphgen.demos(copy).robot_hashes]
    shutil.copy(paths[0], paths[1])
    with pytest.raises(FormatError, match=r"goals of \d joints, not"):
        morphgen.verify(copy, episodes=1)
    paths[1].unlink()
    with pytest.raises(FormatError, match="no such file"):
        morphgen.verify(copy, episodes=1)
    np.savez_compressed(paths[1], q=np.zeros((2**20, 6)))
    with pytest.raises(MorphgenError, match="its arrays have more than"):
        morphgen.verify(copy, episodes=1)


def test_a_position_that_is_not_finite_does_not_agree(described, tmp_path):
    copy, lost = copied(described, tmp_path), [math.nan] * 7
    change_column(copy, "observation.object_pose", lambda rows: [lost for _ in rows])
    assert not any(each.agrees for each in morphgen.verify(copy).replays)


def test_the_channel_ik_is_observed_in_whole_episodes(demos, tmp_path):
    """The path that it shows is planned when an episode begins, and again as the block moves."""
    observe = ObservationConfig(ik=True)
    with pytest.raises(TaskError, match="'ik' depends on earlier steps"):
        demos.observe([0], observe)
    out = tmp_path / "pushes"
    pushes = morphgen.record("arm3-stick", tasks=["push"], policy="path", episodes=3, out=out)
    assert sum(episode.success for episode in pushes.episodes) >= 2
    seen = {}
    for frames, observed, labels in pushes.observe_episodes([2, 0], observe):
        assert len(frames) == len(labels) == len(observed["ik"])
        seen |= dict(zip(frames.tolist(), observed["ik"], strict=True))
    (spec,) = pushes.specs.values()
    for episode in (pushes.episodes[i] for i in (0, 2)):
        batch = batch_from_specs([spec], 1, sim="mujoco", observe=observe, workers=1)
        observation = batch.reset(seed=[episode.seed])
        for frame in episode.frames:
            torch.testing.assert_close(seen.pop(frame), observation["ik"][0])
            action = pushes.columns["normalized_action"][frame, None, : spec.robot.dof]
            action = batch.observation.link_joints(action).where(batch.action_mask, 0.0)
            observation = batch.step(action).observation
        batch.close()
    assert not seen


def test_an_interrupted_recording_continues_to_the_same_bytes(folder, tmp_path, monkeypatch):
    copy, once = tmp_path / "demos", config(noise=0.2)
    real = recording.record_robot

    def stop_at_the_second(*arguments):
        if any((copy / "shards").glob("*.npz")):
            raise KeyboardInterrupt
        return real(*arguments)

    monkeypatch.setattr(recording, "record_robot", stop_at_the_second)
    with pytest.raises(KeyboardInterrupt):
        record(copy, once)
    assert len(list((copy / "shards").glob("*.npz"))) == 1
    with pytest.raises(FormatError, match="not finished"):
        morphgen.demos(copy)
    monkeypatch.undo()
    record(copy, once)
    assert folder_hashes(copy) == folder_hashes(folder)


def test_a_recording_that_was_interrupted_at_its_very_end_is_finished(copy, folder):
    (copy / "shards").mkdir()
    record(copy, config(noise=0.2))
    assert folder_hashes(copy) == folder_hashes(folder)
    assert not (copy / "shards").exists()


def test_a_task_both_among_obstacles_and_without_is_refused(tmp_path):
    """A robot's goals are a file per task."""
    sources = [robot_source("prims", "reach", obstacles=each) for each in (False, True)]
    with pytest.raises(TaskError, match="record them apart"):
        record(tmp_path / "demos", RecordingConfig(tuple(sources)))
    assert not (tmp_path / "demos").exists()


@pytest.mark.slow
@pytest.mark.parametrize("workers", [{"ray": ""}, {"jobs": 2}], ids=str)
def test_several_processes_give_the_same_bytes(workers, folder, tmp_path):
    if "ray" in workers:
        pytest.importorskip("ray")
    record(tmp_path / "demos", config(noise=0.2), **workers)
    assert folder_hashes(tmp_path / "demos") == folder_hashes(folder)


def test_a_folder_of_something_else_is_refused(folder, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    for other, why in ((folder, "its seed is 0, not 1"), (tmp_path, r"no recording\.json")):
        with pytest.raises(TaskError, match=why):
            record(other, config(noise=0.2, seed=1))
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"drawn": "prims:1", "tasks": ["reach"], "policy": "jacobian", "noise": -1}, "noise"),
        ({"drawn": "prims:1", "tasks": ["push"], "policy": "ik"}, "is for reach, not for push"),
        ({"drawn": "prims:1", "tasks": ["fly"]}, "unknown task 'fly'"),
        ({"drawn": "prims:1", "robots": "prims"}, "either robots"),
        ({}, "either robots"),
        ({"drawn": "prims"}, "is not a grammar and a number"),
        ({"drawn": "prims:1", "sim": "best"}, "unknown simulator 'best'"),
        ({"robots": "interpolation/arm3/reach", "tasks": ["reach"]}, "has its own: reach"),
        ({"drawn": "prims:1", "cameras": ["back"]}, "unknown camera 'back'"),
        ({"drawn": "prims:1", "depth": True}, "depth: only with cameras"),
    ],
)
def test_invalid_arguments_write_nothing(tmp_path, arguments, match):
    with pytest.raises(MorphgenError, match=match):
        morphgen.record(**arguments, out=tmp_path / "demos")
    assert not (tmp_path / "demos").exists()


def test_only_successes_are_kept_if_asked_for(tmp_path):
    few = {"grammars": "prims:2", "policy": "jacobian"}
    every = morphgen.demos(record(tmp_path / "all", config(**few))).episodes
    kept = morphgen.demos(record(tmp_path / "kept", config(**few, only_success=True))).episodes
    assert [each.seed for each in kept] == [each.seed for each in every if each.success]


def test_a_recording_without_success_leaves_nothing(tmp_path):
    with pytest.raises(TaskError, match="no episode ended in success"):
        record(tmp_path / "demos", config(policy="zero", only_success=True))
    assert [*tmp_path.glob("demos/*")] == []


def test_recorded_results_are_those_of_the_policy(demos):
    """Without the end after successes they are the episodes of an evaluation."""
    spec = demos.specs[0, "reach"]
    batch = batch_from_specs([spec], 2, workers=1)
    scores = run_episodes(batch, BASELINES["ik"].make(0), 1)
    assert all(each.success for each in scores)
    assert all(episode.success for episode in demos.episodes)
    for episode in demos.episodes:
        success = demos.columns["next.success"][list(episode.frames)]
        assert success[-25:].all()
        assert demos.columns["next.done"][episode.frames[-1]]
        assert not demos.columns["next.done"][list(episode.frames[:-1])].any()


def test_verify_replays_episodes_and_names_changed_files(described, tmp_path):
    result = morphgen.verify(described, episodes=2)
    assert result.agrees
    for each in result.replays:
        assert each.joint_error == each.object_error == each.reward_error == 0
    copy = copied(described, tmp_path)
    urdf = next(copy.glob("bodies/*/robot.urdf"))
    urdf.write_text(urdf.read_text() + "<!-- mine -->")
    result = morphgen.verify(copy, episodes=1)
    assert result.changed_files == (str(urdf.relative_to(copy)),)
    assert not result.agrees


def test_verify_tells_other_actions(described, tmp_path):
    copy = copied(described, tmp_path)
    change_column(copy, "executed_action", lambda rows: rows[::-1])
    assert not any(each.agrees for each in morphgen.verify(copy, episodes=4).replays)


def test_croissant_is_valid_and_reads_all_records(described):
    mlcroissant = pytest.importorskip("mlcroissant")
    dataset = mlcroissant.Dataset(jsonld=described / CROISSANT_FILE)
    issues = dataset.metadata.ctx.issues
    assert (issues.errors, len(issues.warnings)) == (set(), 1)  # it has no date
    data = json.loads((described / CROISSANT_FILE).read_text())
    assert data["conformsTo"] == "http://mlcommons.org/croissant/1.1"
    assert data["prov:wasGeneratedBy"]["prov:wasAssociatedWith"]["prov:label"].startswith("morph")
    demos = morphgen.demos(described)
    robots, episodes, steps = (list(dataset.records(n)) for n in ("robots", "episodes", "steps"))
    assert [each["robots/robot_hash"].decode() for each in robots] == [*demos.robot_hashes]
    assert [each["episodes/seed"] for each in episodes] == [each.seed for each in demos.episodes]
    assert len(steps) == len(demos)


def test_the_card_has_licences_and_results(described):
    text = (described / "README.md").read_text()
    assert "license: mit" in text
    assert "| reach  | ik " in text
    assert "prims-000000" in (described / "licences.json").read_text()


@pytest.mark.slow
def test_tasks_with_objects_share_a_data_set(tmp_path):
    folder = record(tmp_path / "demos", config(("reach", "drawer", "push"), "serial:1"))
    demos = morphgen.demos(folder)
    assert {episode.task for episode in demos.episodes} == {"reach", "drawer", "push"}
    assert all(each.agrees for each in replay(demos, range(len(demos.episodes))))
    observed, _ = demos.observe(range(len(demos)))
    assert len(observed["tokens"]) == len(demos)


def test_depths_are_coded_as_lerobot_does():
    depth = np.geomspace(DEPTH_MIN, DEPTH_MAX, 1000)
    low, high = np.log(DEPTH_MIN + DEPTH_SHIFT), np.log(DEPTH_MAX + DEPTH_SHIFT)
    decoded = np.exp(depth_code(depth) / 4095 * (high - low) + low) - DEPTH_SHIFT
    half_a_code = (DEPTH_MAX + DEPTH_SHIFT) * (high - low) / 4095 / 2
    assert abs(decoded - depth).max() < 1.01 * half_a_code
    assert depth_code(np.array([0.0, 99.0])).tolist() == [0, 4095]


@pytest.mark.slow
def test_cameras_add_videos(tmp_path):
    folder = record(tmp_path / "demos", config(cameras=("front", "wrist"), depth=True))
    demos = morphgen.demos(folder)
    info = json.loads((folder / INFO).read_text())
    names = [name for name, each in info["features"].items() if each["dtype"] == "video"]
    kinds = ("front", "front_depth", "wrist", "wrist_depth")
    assert names == [f"observation.images.{kind}" for kind in kinds]
    rows = [*read_episodes(folder)]
    stats = json.loads((folder / "meta/stats.json").read_text())
    for name in names:
        channels = info["features"][name]["shape"][2]
        assert np.shape(stats[name]["mean"]) == (channels, 1, 1)
        for file in range(len(demos.robots)):
            path = folder / f"videos/{name}/chunk-000/file-{file:03d}.mp4"
            own = [row for row in rows if row[f"videos/{name}/file_index"] == file]
            count, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
            assert count == sum(row["length"] for row in own)
            ends = [row[f"videos/{name}/to_timestamp"] for row in own]
            starts = [row[f"videos/{name}/from_timestamp"] for row in own]
            assert [0.0, *ends] == [*starts, count / 50]
    cameras = json.loads((folder / BODIES / demos.robot_hashes[0] / "body.json").read_text())
    assert set(cameras["cameras"]["front"]["T_world_camera"]) == {"reach"}
    again = record(tmp_path / "again" / "demos", config(cameras=("front", "wrist"), depth=True))
    assert folder_hashes(again) == folder_hashes(folder)


@pytest.mark.slow
def test_views_are_those_of_the_documented_poses(demos):
    spec = demos.specs[0, "reach"]
    with closing(Renderer.of_spec(spec, (64, 64))) as renderer:
        state = RenderState(np.array(spec.robot.home, np.float32))
        pixels, depth = renderer.view(state, "front")
        assert np.array_equal(pixels, renderer.frame(state))
        # The lowest row sees the ground: a ray through it from the pose meets z = 0 there.
        pose, half = renderer.front, math.tan(math.radians(FRONT_FOV / 2))
        ray = pose.matrix[:3, :3] @ (half / 64, -half * 63 / 64, -1.0)
        assert depth[-1, 32] == pytest.approx(-pose.position[2] / ray[2], rel=1e-3)
        renderer.view(state, "wrist")
        T = frame_pose(spec.robot, np.array([spec.robot.home]))[0] @ WRIST.matrix
        eyes = renderer._scene.camera
        np.testing.assert_allclose((eyes[0].pos + eyes[1].pos) / 2, T[:3, 3], atol=1e-5)
        np.testing.assert_allclose(eyes[0].forward, -T[:3, 2], atol=1e-5)
