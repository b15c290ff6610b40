"""Studies: cells, resumption, tables and curves."""

import csv
import json
import re
import shutil
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from filelock import FileLock
from PIL import Image

import morphgen
from helpers.commands import tree
from helpers.runs import EVAL, QUIET, equal, small_config, small_source, weights
from morphgen.errors import TaskError
from morphgen.formats.files import LOCK
from morphgen.rl.evaluation import Score
from morphgen.rl.inference import MODES
from morphgen.rl.runs.checkpoint import CHECKPOINT
from morphgen.rl.runs.recorders import METRICS
from morphgen.rl.runs.robot_source import members, other_side
from morphgen.rl.runs.training import subruns_of
from morphgen.rl.scores import study
from morphgen.rl.scores import study as study_work
from morphgen.rl.scores.score_tables import (
    CURVES,
    DATA,
    ROBOTS,
    TABLE,
    rows,
    table_text,
    write_tables,
)
from morphgen.rl.scores.scores import UNSTABLE
from morphgen.rl.scores.study import (
    SCORES,
    agent_cell,
    baseline_cells,
    matched_budget,
    read_scores,
    require_cells,
    run_cells,
    run_cells_on_ray,
)
from morphgen.rl.scores.submission import read_submission

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
    outcomes = list(run_cells(cells, QUIET))
    assert [each.error for each in outcomes] == [""] * len(cells)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The cells of an uninterrupted study."""
    cells = cells_in(tmp_path_factory.mktemp("study"))
    finished(cells)
    return cells


def results(cells):
    return {cell: read_scores(cell) for cell in cells}


def test_a_cell_is_a_run_folder_with_scores(whole):
    names = [cell.agent for cell in whole]
    assert names == ["random", "zero", "jacobian", "ik", "se", "se", "me-mlp", "me-mlp"]
    for cell in whole:
        scores = read_scores(cell)
        assert set(scores) == (set(MODES) if cell.config else {cell.agent})
        for own in scores.values():
            assert [each.side for each in own] == ["train", "train", "test"]
        assert (cell.folder / CHECKPOINT).is_file() == (cell.agent == "me-mlp")


def test_a_cell_has_its_episodes_as_submissions(whole):
    for cell in whole:
        for mode, own in read_scores(cell).items():
            submission = read_submission(cell.folder / f"{mode}.json")
            assert (submission.method, submission.training_seed) == (cell.agent, cell.seed)
            assert [robot.side for robot in submission.robots] == [each.side for each in own]
            for robot, score in zip(submission.robots, own, strict=True):
                assert np.mean(robot.score) == pytest.approx(score.raw)
                assert np.mean(robot.success) == pytest.approx(score.success)
            assert not cell.config or submission.training.transitions == 64


def test_fine_tuning_is_added_to_finished_cells(whole, tmp_path):
    folder = tmp_path / "study"
    shutil.copytree(whole[0].folder.parents[2], folder)
    mode, steps = "fine-tuned 2,048", 2048  # one update
    cells = cells_in(folder, finetune=(steps,))
    before = {cell: read_scores(cell) for cell in cells}
    finished(cells)
    for cell in cells:
        after = read_scores(cell)
        assert (mode in after) == (cell.agent == "me-mlp")
        assert {key: after[key] for key in before[cell]} == before[cell]
    tuned = cells[-1]
    assert [each.side for each in read_scores(tuned)[mode]] == ["test"]
    submission = read_submission(tuned.folder / f"fine-tuned-{steps}.json")
    assert (submission.mode, submission.training.finetuned) == ("deterministic", steps)
    assert not equal(weights(tuned.folder / f"finetuned/{steps}"), weights(tuned.folder))
    table = rows({cell: read_scores(cell) for cell in cells})
    assert [(row.agent, row.seeds) for row in table if row.mode == mode] == [("me-mlp", (0, 1))]


def test_finished_cells_are_not_repeated(whole, monkeypatch):
    folder = whole[0].folder.parents[2]
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
    done = [cell for cell in cells if read_scores(cell) is not None]
    assert [cell.agent for cell in done] == ["random", "zero", "jacobian", "ik"]
    first_robot = cells[4].folder / "robots" / begun[0][0].name
    kept = {cell.folder: tree(cell.folder) for cell in done} | {first_robot: tree(first_robot)}
    list(run_cells(cells, QUIET, show))
    assert [path for path, _ in begun].count(begun[0][0]) == 1
    for folder, before in kept.items():
        assert tree(folder) == before
    for one, other in zip(whole, cells, strict=True):
        assert repr(read_scores(one)) == repr(read_scores(other))
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

    monkeypatch.setattr(study_work.time, "sleep", wait)
    order = [outcome.cell.agent for outcome in run_cells(cells, QUIET)]
    assert order == ["zero", "jacobian", "ik", "random"]
    assert waits


def test_a_failed_cell_is_reported_and_the_others_continue(tmp_path):
    good, bad = cells_in(tmp_path, agents=("me-mlp",), seeds=(0, 1))[-2:]
    other = replace(bad, config=replace(bad.config, ppo=replace(bad.config.ppo, gamma=0.5)))
    finished([other])
    (bad.folder / SCORES).unlink()
    outcomes = list(run_cells([bad, good], QUIET))
    assert "another run: ppo.gamma 0.5, not 0.99" in outcomes[0].error
    assert outcomes[1].error == ""
    assert read_scores(bad) is None


def test_scores_of_another_evaluation_are_rejected(whole):
    with pytest.raises(TaskError, match="of another evaluation"):
        read_scores(replace(whole[0], eval_config=replace(EVAL, episodes=5)))
    for cell in (whole[0], whole[-1]):
        with pytest.raises(TaskError, match="of another set of robots"):
            read_scores(replace(cell, source=replace(cell.source, goal_seed=1)))


def test_scores_of_another_version_of_morphgen_are_read(whole):
    cell = whole[0]
    assert json.loads((cell.folder / SCORES).read_text())["morphgen"] == morphgen.__version__
    newer = re.sub("(?m)^morphgen: .*$", 'morphgen: "0.2.99"', cell.source.split)
    assert newer != cell.source.split
    assert read_scores(replace(cell, source=replace(cell.source, split=newer))) is not None


def test_scores_of_another_run_are_rejected_without_its_checkpoint(whole, tmp_path):
    """Studies may be kept without their checkpoints."""
    folder = tmp_path / "study"
    shutil.copytree(whole[0].folder.parents[2], folder)
    for checkpoint in folder.rglob(CHECKPOINT):
        checkpoint.unlink()
    kept = [
        replace(cell, folder=folder / cell.folder.relative_to(whole[0].folder.parents[2]))
        for cell in whole
    ]
    require_cells(kept)
    mlp = kept[-1]
    ppo = replace(mlp.config.ppo, gamma=0.5)
    with pytest.raises(TaskError, match=r"has another run: ppo.gamma 0\.\d+, not 0.5"):
        require_cells([*kept[:-1], replace(mlp, config=replace(mlp.config, ppo=ppo))])


def test_an_unexpected_error_does_not_stop_the_other_cells(tmp_path, monkeypatch, capsys):
    bad, good = cells_in(tmp_path, agents=("me-mlp",), seeds=(0, 1))[-2:]
    train = study.train

    def without_memory(folder, config, **options):
        if config.seed == 0:
            raise RuntimeError("CUDA out of memory")
        return train(folder, config, **options)

    monkeypatch.setattr(study, "train", without_memory)
    outcomes = list(run_cells([bad, good], QUIET))
    assert [each.error for each in outcomes] == ["RuntimeError: CUDA out of memory", ""]
    assert "Traceback" in capsys.readouterr().err


def test_curves_are_as_long_as_the_longest_seed(whole, tmp_path, monkeypatch):
    drawn = []
    from matplotlib.axes import Axes

    plot = Axes.plot
    monkeypatch.setattr(
        Axes, "plot", lambda self, *a, **k: drawn.append((k["label"], a)) or plot(self, *a, **k)
    )
    path = whole[-1].folder / METRICS
    text = path.read_text()
    path.write_text(text.splitlines(keepends=True)[0])
    try:
        write_tables(tmp_path, results(whole))
    finally:
        path.write_text(text)
    label, (steps, values) = drawn[-1]
    assert label == "me-mlp (1 of 2 seeds to the end)"
    assert list(steps) == [32, 64]
    assert np.isfinite(values).all()


def score(side, value, robot="a"):
    return Score(
        robot, side, "reach", 2, 600, value, 0, 0, value, 0, success=0.5, random_success=0,
        distance=0.1, relative_distance=0.2,
    )  # fmt: skip


def by_hand(cells, values):
    """Return results with given scores of two train robots and a test robot; None: missing."""
    found = {}
    for cell, value in zip(cells, values, strict=True):
        found[cell] = None
        if value is not None:
            own = [score("train", value[0]), score("train", value[1]), score("test", value[2])]
            found[cell] = {"deterministic": own}
    return found


def test_rows_are_averages_over_seeds_and_robots(tmp_path):
    cells = cells_in(tmp_path)[4:]
    found = rows(by_hand(cells, [(1, 3, 10), (2, 6, 20), (5, 5, 5), (5, 5, 5)]))
    assert [(row.agent, row.mode, row.seeds) for row in found] == [
        ("se", "deterministic", (0, 1)),
        ("me-mlp", "deterministic", (0, 1)),
    ]
    train, test = found[0].groups["train"], found[0].groups["test"]
    assert (train.mean, train.success) == (3, 0.5)
    assert train.iqm.value == np.mean([2, 3])
    assert (test.mean, test.iqm.low, test.iqm.high) == (15, 10, 20)
    line = table_text(found).splitlines()[-1].split("|")
    assert [each.strip() for each in line[4:7]] == ["5.00", "5.00 [5.00, 5.00]", "50%"]


def test_the_table_counts_unstable_episodes(tmp_path):
    cells = cells_in(tmp_path, ("me-mlp",))[4:]
    found = by_hand(cells, [(1, 3, 10), (2, 6, 20)])
    assert "unstable" not in table_text(rows(found))
    for scores in found.values():
        scores["deterministic"][0] = replace(scores["deterministic"][0], unstable=2)
    last = table_text(rows(found)).splitlines()[-1]
    assert last == f"me-mlp deterministic: {UNSTABLE}: 4"


def test_se_policies_trained_on_the_test_robots_are_resampled_independently(tmp_path):
    source = other_side(small_source(), "test")
    cells = [
        agent_cell(tmp_path, "se@test", small_config(source, agent="se", seed=seed), EVAL)
        for seed in range(3)
    ]
    values = [(0, 10), (10, 0), (0, 10)]
    found = {
        cell: {"deterministic": [score("test", a), score("test", b, robot="b")]}
        for cell, (a, b) in zip(cells, values, strict=True)
    }
    (row,) = rows(found)
    assert (row.groups["test"].iqm.low, row.groups["test"].iqm.high) == (0, 10)


def test_missing_scores_are_shown_as_missing(tmp_path):
    cells = cells_in(tmp_path)
    random, _, _, _, se0, se1, mlp0, mlp1 = cells
    own = {random: {"random": [score("train", 0.0), score("test", 0.0)]}}
    own |= by_hand([se0, se1, mlp0, mlp1], [(1, 3, 10), None, None, None])
    own |= {cell: None for cell in cells[1:4]}
    found = {cell: own[cell] for cell in cells}
    written = write_tables(tmp_path, found)
    assert [path.name for path in written] == [TABLE, DATA, ROBOTS, CURVES]
    lines = (tmp_path / TABLE).read_text().splitlines()
    cut = {
        line.split("|")[1].strip(): [c.strip() for c in line.split("|")[2:-1]] for line in lines[4:]
    }
    assert cut["random"][2] == "0.00"
    assert cut["se"][1] == "1 of 2 (missing: 1)"
    assert cut["se"][2] == "2.00"
    assert cut["me-mlp"] == ["", "0 of 2 (missing: 0, 1)", *["missing"] * 6]
    assert cut["ik"][2:] == ["missing"] * 6
    with (tmp_path / ROBOTS).open() as file:
        table = list(csv.DictReader(file))
    gone = [line for line in table if line["agent"] == "me-mlp"]
    assert [(line["seed"], line["status"], line["score"]) for line in gone] == [
        ("0", "missing", ""),
        ("1", "missing", ""),
    ]
    data = json.loads((tmp_path / DATA).read_text())
    assert [each["scores"] for each in data["cells"] if each["agent"] == "me-mlp"] == [None, None]
    (row,) = [each for each in data["rows"] if each["agent"] == "me-mlp"]
    assert (row["groups"], row["missing"]) == ({}, [0, 1])


def test_only_trained_agents_have_curves(whole, tmp_path, monkeypatch):
    drawn = []
    from matplotlib.axes import Axes

    plot = Axes.plot
    monkeypatch.setattr(
        Axes, "plot", lambda self, *a, **k: drawn.append((k["label"], a)) or plot(self, *a, **k)
    )
    found = results(whole)
    (whole[-1].folder / METRICS).rename(tmp_path / "aside")
    try:
        write_tables(tmp_path, found)
    finally:
        (tmp_path / "aside").rename(whole[-1].folder / METRICS)
    (se, (steps, values)), (mlp, _) = drawn
    assert (se, mlp) == ("se", "me-mlp (1 of 2 seeds to the end)")
    assert list(steps) == [32, 64]
    assert np.isfinite(values).all()
    with Image.open(tmp_path / CURVES) as image:
        assert image.size[0] > 500


def test_an_agent_trained_on_the_test_robots_has_only_test_scores(tmp_path):
    source = other_side(small_source(), "test")
    config = small_config(source, agent="se", total_timesteps=32)
    cell = agent_cell(tmp_path, "se@test", config, EVAL)
    finished([cell])
    found = results([cell])
    (row, _) = rows(found)
    assert set(row.groups) == {"test"}
    assert " - " in table_text([row])
    assert "missing" not in table_text([row])


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


@pytest.mark.slow
def test_ray_gives_the_same_scores(whole, tmp_path):
    pytest.importorskip("ray")
    cells = cells_in(tmp_path, seeds=(0,))
    for _ in range(2):
        outcomes = list(run_cells_on_ray(None)(cells, QUIET))
        assert sorted(each.cell.agent for each in outcomes) == sorted(c.agent for c in cells)
        assert all(each.error == "" for each in outcomes)
    same = [cell for cell in whole if cell.seed != 1]
    for one, other in zip(same, cells, strict=True):
        assert repr(read_scores(one)) == repr(read_scores(other))
