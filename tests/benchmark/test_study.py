"""Studies: cells, resumption and tables."""

import json
import re
import shutil
import threading
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
from filelock import FileLock

import morphgen
from helpers.commands import tree
from helpers.runs import EVAL, QUIET, equal, small_config, small_source, weights
from morphgen.benchmark.scores import study
from morphgen.benchmark.scores.results import result_rows
from morphgen.benchmark.scores.study import (
    DATA,
    TABLE,
    agent_cell,
    baseline_cells,
    matched_budget,
    require_cells,
    run_cells,
    stored_results,
    write_tables,
)
from morphgen.benchmark.scores.submission import EPISODES, append_submission, read_table
from morphgen.errors import TaskError
from morphgen.formats.files import LOCK
from morphgen.rl.inference import MODES
from morphgen.rl.runs.checkpoint import CHECKPOINT
from morphgen.rl.runs.robot_source import members, other_side, split_of, split_source
from morphgen.rl.runs.training import subruns_of
from morphgen.rl.scores import UNSTABLE, mean_interval, relative_scores, seeds_success_interval

pytestmark = pytest.mark.slow


def cells_in(folder, agents=("se", "me-mlp"), seeds=(0, 1), finetune=()):
    source = small_source()
    made = baseline_cells(folder, source, EVAL)
    for agent in agents:
        for seed in seeds:
            config = small_config(source, agent=agent, seed=seed, total_timesteps=64)
            made.append(agent_cell(folder, agent, config, EVAL, finetune))
    return made


def finished(cells):
    assert [error for _, error in run_cells(cells, QUIET)] == [""] * len(cells)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The cells of an uninterrupted study."""
    cells = cells_in(tmp_path_factory.mktemp("study"))
    finished(cells)
    return cells


def test_a_cell_is_a_run_folder_with_episodes(whole):
    names = [cell.agent for cell in whole]
    assert names == ["random", "zero", "jacobian", "ik", "se", "se", "me-mlp", "me-mlp"]
    for cell in whole:
        results = stored_results(cell)
        assert set(results) == (set(MODES) if cell.config else {cell.agent})
        for own in results.values():
            assert [robot.side for robot in own.robots] == ["train", "train", "test"]
            assert (own.method, own.training_seed) == (cell.agent, cell.seed)
            assert own.morphgen == morphgen.__version__
            assert not cell.config or own.training.transitions == 64
        assert (cell.folder / CHECKPOINT).is_file() == (cell.agent == "me-mlp")


def test_fine_tuning_is_added_to_finished_cells(whole, tmp_path):
    folder = tmp_path / "study"
    shutil.copytree(whole[0].study, folder)
    mode, steps = "fine-tuned 2,048", 2048  # one update
    cells = cells_in(folder, finetune=(steps,))
    before = {cell: stored_results(cell) for cell in cells}
    finished(cells)
    for cell in cells:
        after = stored_results(cell)
        assert (mode in after) == (cell.agent == "me-mlp")
        assert {key: after[key] for key in before[cell]} == before[cell]
    tuned = cells[-1]
    submission = stored_results(tuned)[mode]
    assert [robot.side for robot in submission.robots] == ["test"]
    assert (submission.mode, submission.finetuned) == ("deterministic", steps)
    assert not equal(weights(tuned.folder / f"finetuned/{steps}"), weights(tuned.folder))
    write_tables(tmp_path, cells)
    rows = [row for row in json.loads((tmp_path / DATA).read_text())["rows"] if row["finetuned"]]
    assert [(row["method"], row["seeds"]) for row in rows] == [("me-mlp", [0, 1])]


def test_finished_cells_are_not_repeated(whole, monkeypatch):
    folder = whole[0].study
    before = tree(folder)
    for name in ("train", "evaluate_run", "evaluate_baseline"):
        monkeypatch.delattr(study, name)
    finished(whole)
    assert tree(folder) == before


class Killed(BaseException):
    """Stands for a killed process: no code catches it."""


def test_a_killed_study_resumes_where_it_stopped(whole, tmp_path):
    cells = cells_in(tmp_path)
    begun = []

    def show(part):
        begun.append((part.folder.relative_to(tmp_path), len(begun)))

        def told(report, updates):
            # In the second robot of the first seed of se, after its first update.
            if len(begun) == 2 and report.update == 1:
                raise Killed

        return told

    with pytest.raises(Killed):
        list(run_cells(cells, QUIET, show))
    done = [cell for cell in cells if stored_results(cell)]
    assert [cell.agent for cell in done] == ["random", "zero", "jacobian", "ik"]
    first_robot = cells[4].folder / "robots" / begun[0][0].name
    kept = {cell.folder: tree(cell.folder) for cell in done} | {first_robot: tree(first_robot)}
    list(run_cells(cells, QUIET, show))
    assert [path for path, _ in begun].count(begun[0][0]) == 1
    for folder, before in kept.items():
        assert tree(folder) == before
    for one, other in zip(whole, cells, strict=True):
        assert stored_results(one) == stored_results(other)
    for one, other in zip(whole[-2:], cells[-2:], strict=True):
        assert equal(weights(one.folder), weights(other.folder))


def test_a_cell_locked_by_another_process_is_done_last(tmp_path, monkeypatch):
    cells = cells_in(tmp_path, agents=(), seeds=())
    cells[0].folder.mkdir(parents=True)
    other = FileLock(cells[0].folder / LOCK, thread_local=False)
    other.acquire()
    waits = []

    def wait(seconds):
        waits.append(seconds)
        threading.Thread(target=other.release).start()

    monkeypatch.setattr(study.time, "sleep", wait)
    order = [cell.agent for cell, _ in run_cells(cells, QUIET)]
    assert order == ["zero", "jacobian", "ik", "random"]
    assert waits


def test_a_failed_cell_is_reported_and_the_others_continue(tmp_path, monkeypatch, capsys):
    good, bad, worse = cells_in(tmp_path, agents=("me-mlp",), seeds=(0, 1, 2))[-3:]
    other = replace(bad, config=replace(bad.config, ppo=replace(bad.config.ppo, gamma=0.5)))
    finished([other])
    (bad.study / EPISODES).unlink()
    train = study.train

    def without_memory(folder, config, **options):
        if config.seed == 2:
            raise RuntimeError("CUDA out of memory")
        return train(folder, config, **options)

    monkeypatch.setattr(study, "train", without_memory)
    (_, first), (_, second), (_, third) = run_cells([bad, worse, good], QUIET)
    assert "another run: ppo.gamma 0.5, not 0.99" in first
    assert second == "RuntimeError: CUDA out of memory"
    assert "Traceback" in capsys.readouterr().err
    assert third == ""
    assert not stored_results(bad)


def test_episodes_of_another_evaluation_are_rejected(whole):
    with pytest.raises(TaskError, match="random: of another evaluation"):
        stored_results(replace(whole[0], eval_config=replace(EVAL, episodes=5)))
    newer = re.sub("(?m)^morphgen: .*$", 'morphgen: "0.2.99"', whole[0].source.split)
    assert stored_results(replace(whole[0], source=replace(whole[0].source, split=newer)))
    for cell in (whole[0], whole[-1]):
        with pytest.raises(TaskError, match="of another evaluation"):
            stored_results(replace(cell, source=replace(cell.source, goal_seed=1)))
        other = split_source(replace(split_of(cell.source), train=split_of(cell.source).train[:1]))
        with pytest.raises(TaskError, match="of another set of robots"):
            stored_results(replace(cell, source=other))


def test_episodes_of_another_run_are_rejected_without_its_folder(whole, tmp_path):
    """A study may be kept as its table alone."""
    shutil.copy(whole[0].study / EPISODES, tmp_path)
    kept = [replace(cell, study=tmp_path) for cell in whole]
    require_cells(kept)
    assert [stored_results(cell) for cell in kept] == [stored_results(cell) for cell in whole]
    mlp = kept[-1]
    ppo = replace(mlp.config.ppo, gamma=0.5)
    with pytest.raises(TaskError, match=r"has another run: ppo.gamma 0\.\d+, not 0.5"):
        require_cells([*kept[:-1], replace(mlp, config=replace(mlp.config, ppo=ppo))])


def test_policies_of_single_robots_are_resampled_by_robot(whole):
    for agent in ("se", "me-mlp"):
        own = [stored_results(cell)["deterministic"] for cell in whole if cell.agent == agent]
        (row,) = result_rows({str(each.training_seed): each for each in own})
        train = [[robot for robot in run.robots if robot.side == "train"] for run in own]
        scores = [[relative_scores(robot) for robot in robots] for robots in train]
        together = agent != "se"
        assert row.sides["train"].score == mean_interval(scores, together=together)
        successes = [[robot.success for robot in robots] for robots in train]
        wanted = seeds_success_interval(successes, together=together)
        assert row.sides["train"].success == wanted


def test_missing_and_diverged_episodes_are_named_under_the_table(whole, tmp_path):
    shutil.copytree(whole[0].study, tmp_path / "study")
    table = tmp_path / "study" / EPISODES
    kept = [each for each in read_table(table) if each.training_seed != 1][:6]
    table.unlink()
    for each in kept:
        robot = msgspec.structs.replace(each.robots[0], diverged=(True, False))
        robots = (robot, *each.robots[1:])
        append_submission(table, msgspec.structs.replace(each, robots=robots))
    cells = [replace(cell, study=tmp_path / "study") for cell in whole]
    assert [path.name for path in write_tables(tmp_path, cells)] == [TABLE, DATA]
    text = (tmp_path / TABLE).read_text()
    name = "mine/small"
    missing = [f"{name} se seed 1", f"{name} me-mlp seed 0", f"{name} me-mlp seed 1"]
    assert json.loads((tmp_path / DATA).read_text())["missing"] == missing
    assert re.findall("(?m)^- missing: (.*)$", text) == missing
    assert f"- {name} se seed0 stochastic: {UNSTABLE}: 1" in text
    few = [replace(cells[4], finetune=(10,))]
    write_tables(tmp_path, few)
    assert f"- missing: {name} se seed 0 (fine-tuned 10)" in (tmp_path / TABLE).read_text()


def test_an_agent_trained_on_the_test_robots_has_only_test_scores(tmp_path):
    source = other_side(small_source(), "test")
    config = small_config(source, agent="se", total_timesteps=32)
    cell = agent_cell(tmp_path, "se@test", config, EVAL)
    finished([cell])
    write_tables(tmp_path, [cell])
    data = json.loads((tmp_path / DATA).read_text())
    assert [list(row["sides"]) for row in data["rows"]] == [["test"], ["test"]]
    assert data["missing"] == []


def test_matched_budget_gives_test_robots_as_much_data_as_train_robots():
    source = other_side(small_source(), "test")
    train, test = (len(members(other_side(source, side))) for side in ("train", "test"))
    config = small_config(source, agent="se", total_timesteps=6400)
    own = matched_budget(config)
    assert own.ppo.total_timesteps == -(-6400 * test // train)
    assert own.num_envs == -(-config.num_envs * test // train)
    (part, *_) = subruns_of(Path("se"), replace(config, source=other_side(source, "train")))
    (alone, *_) = subruns_of(Path("se@test"), own)
    assert (alone.config.ppo, alone.config.num_envs) == (part.config.ppo, part.config.num_envs)
    assert matched_budget(replace(config, full_budget=True)) == replace(config, full_budget=True)
