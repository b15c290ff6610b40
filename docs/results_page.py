"""Write the tables and figures of docs/results.md from the scores in results/.

    python docs/results_page.py

Each table stands between two comments of the page, ``<!-- NAME -->`` and ``<!-- /NAME -->``, and is
replaced. The figures are in docs/images/results: reach.png, push.png, fine-tuning.png,
robots.png and similarity.png.
"""

from __future__ import annotations

import argparse
import re
import runpy
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from tabulate import tabulate

from morphgen.benchmark.split import SIDES, Side
from morphgen.formats.data_files import read_json
from morphgen.rl.runs.checkpoint import read_config
from morphgen.rl.scores.scores import Interval, Score, score_from_json, success_of
from morphgen.rl.scores.study import stored_cell, tuned_name

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs/results.md"
IMAGES = ROOT / "docs/images/results"
STUDIES = ("reach-30m", "reach-30m-4epochs", "reach-100m", "push-30m")
TASKS = ("reach", "reach-obstacles", "push", "push-obstacles")
EE_TASK = "composition/ee-task"
"""The split whose robots have different tasks."""
SPLITS = (
    "interpolation/arm3",
    "interpolation/panda",
    "composition/ee-arm",
    "extrapolation/primitives",
    "extrapolation/arms",
    "extrapolation/arms-small",
)
FIGURE_SPLITS = SPLITS[:5]
TUNED_STEPS = (10_000, 30_000)
TUNED = ("deterministic", *map(tuned_name, TUNED_STEPS))
"""Modes of a run before and after fine-tuning."""
PAPER_AGENT = "-symlog-slow-critic-discrete"
CHANNELS = "+normalize+lag+joint+poses+jacobian+dls"
AGENTS = {
    "me-graph": "`me-graph`",
    f"me-mlp{PAPER_AGENT}{CHANNELS}": "`me-mlp`, kinematic channels",
    f"me-tf{PAPER_AGENT}{CHANNELS}": "`me-tf`, kinematic channels",
    f"me-mlp{PAPER_AGENT}": "`me-mlp`, the paper's observations",
    f"me-tf{PAPER_AGENT}": "`me-tf`, the paper's observations",
    f"se{PAPER_AGENT}": "`se`, the paper's observations",
    f"se{PAPER_AGENT}@test": "`se` on the test robot",
}
BASELINES = ("scripted", "ik", "jacobian", "random", "zero")
COLOURS = ("#2b6cb0", "#38a169", "#d69e2e", "#9ae6b4", "#f6e05e")
CURVE_COLOURS = ("#2b6cb0", "#38a169", "#d69e2e", "#c53030", "#805ad5")
sys.path.append(str(ROOT / "benchmarks"))
CURVE = runpy.run_path(str(ROOT / "benchmarks/robot_curve.py"))
CURVE_OPTIONS = CURVE["arguments"](["--report", "--out", str(ROOT / "results/robot-curve")])
TRANSFER = runpy.run_path(str(ROOT / "benchmarks/similarity_transfer.py"))


@dataclass(frozen=True)
class Result:
    """Scores of the robots of a side, over all seeds of an agent."""

    seeds: int
    score: float
    """Mean score over seeds and robots."""
    success: Interval
    """Success rate of all episodes with its Wilson interval."""


Modes = Mapping[str, Mapping[Side, Result]]
"""Results by mode, or by the name of a baseline."""


def results_of(study: str, split: str, task: str | None = None) -> dict[tuple[str, int], Modes]:
    """Return the results of a split by agent and transitions; baselines have 0 transitions.

    Args:
        study: Folder in results/.
        split: Name of the split.
        task: Task of the robots; by default all robots of the split.
    """
    found: dict[tuple[str, int], dict[str, dict[Side, list[list[Score]]]]] = {}
    for path in sorted((ROOT / "results" / study / split).glob("*/**/scores.json")):
        agent, steps = path.parent.name, 0
        if path.with_name("config.json").exists():
            agent = path.parent.parent.name
            steps = read_config(path.parent).ppo.total_timesteps
        modes = found.setdefault((agent, steps), {})
        for mode, scores in stored_cell(path, read_json(path)).scores.items():
            for side in SIDES:
                own = [s for s in scores if s.side == side and task in (None, s.task)]
                if own:
                    modes.setdefault(mode, {}).setdefault(side, []).append(own)
    return {
        key: {
            mode: {side: _result(seeds) for side, seeds in sides.items()}
            for mode, sides in modes.items()
        }
        for key, modes in found.items()
    }


def _result(seeds: list[list[Score]]) -> Result:
    scores = [score for seed in seeds for score in seed]
    return Result(len(seeds), mean(score.score for score in scores), success_of(scores))


def by_mean(modes: Modes) -> Mapping[Side, Result]:
    """Return the results of a policy that acts by its mean, or of a baseline."""
    return modes.get("deterministic") or next(iter(modes.values()))


def split_table(task: str) -> str:
    """Return the table of a task: every split with all agents and baselines."""
    lines = []
    with_scores = task.startswith("reach")  # the score of push is its success
    for split in SPLITS:
        found: dict[tuple[str, int, str], Modes] = {}
        for study in STUDIES:
            note = ", four epochs" if "4epochs" in study else ""
            for (agent, steps), modes in results_of(study, f"{split}/{task}").items():
                if agent in (*AGENTS, *BASELINES):
                    found[agent, steps, note] = modes
        order = [*AGENTS, *BASELINES]
        for agent, steps, note in sorted(found, key=lambda key: (order.index(key[0]), key[1:])):
            modes = found[agent, steps, note]
            lines.append([split, *_line(agent, steps, note, modes, with_scores)])
            split = ""
    score = ["MT", "success", "ZS", "success"] if with_scores else ["MT", "ZS"]
    headers = ["split", "agent", "transitions", "seeds", *score]
    return tabulate(lines, headers=headers, tablefmt="github", disable_numparse=True)


def ee_task_table() -> str:
    """Return success of the split in which robots have different tasks, by side and task."""
    push, reach = (results_of("ee-task-30m", EE_TASK, task) for task in ("push", "reach"))
    order = [*AGENTS, *BASELINES]
    lines = []
    keys = [key for key in {*push, *reach} if key[0] in order]
    for key in sorted(keys, key=lambda key: order.index(key[0])):
        agent, steps = key
        by_task = [by_mean(found[key]) if found.get(key) else {} for found in (push, reach)]
        pushing, reaching = by_task
        seeds = max(result.seeds for sides in by_task for result in sides.values())
        columns = (pushing.get("train"), reaching.get("train"), pushing.get("test"))
        rates = [column.success.as_percent() if column else "" for column in columns]
        score = f"{reaching['train'].score:.1f}" if reaching else ""
        lines.append([*_run_cells(agent, steps, seeds), rates[0], score, *rates[1:]])
    headers = ["agent", "transitions", "seeds", "MT, push", "MT, reach", "success", "ZS, push"]
    return tabulate(lines, headers=headers, tablefmt="github", disable_numparse=True)


def _run_cells(agent: str, steps: int, seeds: int, note: str = "") -> list[str]:
    """Return agent, transitions and seeds; the latter two are empty for a baseline."""
    name = AGENTS.get(agent, f"`{agent}`") + note
    share = " a robot" if agent.startswith("se") else ""
    return [name, *([f"{round(steps / 1e6)} million{share}", str(seeds)] if steps else ["", ""])]


def _names(run: Path) -> list[str]:
    """Return split, agent and seed of a run's folder, relative to results/."""
    _, *split, agent, seed = run.parts
    return ["/".join(split), AGENTS[agent], seed.removeprefix("seed")]


def _line(agent: str, steps: int, note: str, modes: Modes, with_scores: bool) -> list[str]:
    sides = by_mean(modes)
    cells = _run_cells(agent, steps, sides["test"].seeds, note)
    for side in SIDES:
        if side not in sides:
            cells += [""] * (2 if with_scores else 1)
            continue
        success = sides[side].success.as_percent()
        cells += [f"{sides[side].score:.1f}", success] if with_scores else [success]
    return cells


def fine_tuned_runs() -> dict[str, list[tuple[list[str], list[Result]]]]:
    """Return runs by their test task: split, agent and seed, and results by mode of ``TUNED``."""
    found: dict[str, list[tuple[list[str], list[Result]]]] = {}
    for path in sorted((ROOT / "results").glob("*-30m/**/scores.json")):
        scores = stored_cell(path, read_json(path)).scores
        if not scores.keys() >= set(TUNED):
            continue
        tests = [[score for score in scores[mode] if score.side == "test"] for mode in TUNED]
        names = _names(path.parent.relative_to(ROOT / "results"))
        found.setdefault(tests[0][0].task, []).append((names, [_result([rows]) for rows in tests]))
    return found


def fine_tuning_table() -> str:
    """Return success on the test robots before and after fine-tuning."""
    lines = []
    for task, rows in sorted(fine_tuned_runs().items()):
        lines += [[*names, *(x.success.as_percent() for x in results)] for names, results in rows]
        means = [mean(results[i].success.value for _, results in rows) for i in range(len(TUNED))]
        lines.append([f"**mean of {len(rows)}, {task}**", "", "", *(f"**{x:.1%}**" for x in means)])
    steps = [f"{number:,} steps" for number in TUNED_STEPS]
    headers = ["split", "agent", "seed", "zero-shot", *steps]
    return tabulate(lines, headers=headers, tablefmt="github", disable_numparse=True)


def pybullet_table() -> str:
    """Return scores on the test robots in MuJoCo and in PyBullet, for runs that have both."""
    lines: list[list[str]] = []
    differences: dict[str, list[float]] = {}
    for path in sorted((ROOT / "results/pybullet").rglob("seed*.json")):
        run = path.relative_to(ROOT / "results/pybullet").with_suffix("")
        stored = ROOT / "results" / run / "scores.json"
        ours = stored_cell(stored, read_json(stored)).scores["deterministic"]
        tests = [score for score in ours if score.side == "test"]
        mujoco = _result([tests])
        bullet = _result([[score_from_json(row) for row in read_json(path)["deterministic"]]])
        rates = [100 * result.success.value for result in (mujoco, bullet)]
        differences.setdefault(tests[0].task, []).append(rates[1] - rates[0])
        split, agent, seed = _names(run)
        if run.parts[0].endswith("100m"):
            agent += ", 100 million"
        cells = [split, agent, seed, *(f"{rate:.0f}%" for rate in rates)]
        cells.append(f"{rates[1] - rates[0]:+.0f} points")
        if tests[0].task == "reach":  # the score of push is its success
            scores = mujoco.score, bullet.score
            cells += [*(f"{x:.1f}" for x in scores), f"{scores[1] - scores[0]:+z.1f}"]
        lines.append(cells)
    for task, values in sorted(differences.items()):
        mean_of = f"**mean of {len(values)}, {task}**"
        lines.append([mean_of, "", "", "", "", f"**{mean(values):+.1f} points**"])
    rate, score = ("MuJoCo", "PyBullet", "difference"), ("score", "PyBullet", "difference")
    headers = ["split", "agent", "seed", *rate, *score]
    return tabulate(lines, headers=headers, tablefmt="github", disable_numparse=True)


def curve_table(name: str) -> str:
    """Return the table of a variant of benchmarks/robot_curve.py."""
    return str(CURVE["table"](name, CURVE_OPTIONS))


def write_tables(tables: Mapping[str, str], page: str) -> str:
    """Return a page with its tables replaced.

    Raises:
        ValueError: If the page has no place for a table.
    """
    for name, table in tables.items():
        pattern = rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)"
        page, count = re.subn(pattern, rf"\1\n{table}\n\n\2", page, flags=re.DOTALL)
        if count != 1:
            raise ValueError(f"{PAGE}: {count} places for the table {name}; expected one")
    return page


def bar_figure(task: str, baseline: str) -> Figure:
    """Return bars of the zero-shot success of each agent and a baseline on each split of a task."""
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    axes = figure.subplots()
    results = [results_of(f"{task}-30m", f"{split}/{task}") for split in FIGURE_SPLITS]
    found_agents = {agent for found in results for agent, _ in found}
    names = {
        agent: name
        for agent, name in AGENTS.items()
        if agent.startswith("me-") and agent in found_agents
    }
    names[baseline] = f"`{baseline}`"
    width = 0.8 / len(names)
    for i, (agent, name) in enumerate(names.items()):
        label: str | None = name.replace("`", "")
        for x, found in enumerate(results):
            modes = [modes for (of, _), modes in found.items() if of == agent]
            if not modes:
                continue
            rate = by_mean(modes[0])["test"].success
            axes.bar(
                x + (i - (len(names) - 1) / 2) * width,
                100 * rate.value,
                width,
                yerr=[[100 * (rate.value - rate.low)], [100 * (rate.high - rate.value)]],
                color="#a0aec0" if agent == baseline else COLOURS[i],
                label=label,
                error_kw={"elinewidth": 0.8},
            )
            label = None  # once in the legend
    axes.set_xticks(range(len(FIGURE_SPLITS)), FIGURE_SPLITS, fontsize=8)
    axes.set_ylabel("zero-shot success [%]")
    axes.set_ylim(0, 105)
    figure.legend(loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def fine_tuning_figure() -> Figure:
    """Return success on the test robots of each split of push against the steps of fine-tuning."""
    figure = Figure(figsize=(6.5, 3.2), layout="constrained")
    axes = figure.subplots()
    by_split: dict[str, list[list[float]]] = {}
    for (split, *_), results in fine_tuned_runs()["push"]:
        by_split.setdefault(split, []).append([100 * x.success.value for x in results])
    steps = [0, *(number / 1000 for number in TUNED_STEPS)]
    for i, (split, rows) in enumerate(by_split.items()):
        label = f"{split.removesuffix('/push')} ({len(rows)})"
        axes.plot(
            steps, [mean(column) for column in zip(*rows, strict=True)], f"C{i}o-", label=label
        )
        for row in rows:
            axes.plot(steps, row, color=f"C{i}", lw=0.5, alpha=0.5)
    axes.set_xticks(steps)
    axes.set_xlabel("thousand control steps on the test robot")
    axes.set_ylabel("success at push [%]")
    axes.set_ylim(0, 105)
    figure.legend(loc="outside right center", fontsize=8, frameon=False)
    return figure


def curve_figure() -> Figure:
    """Return success on ten real arms against the number of training robots, by variant."""
    figure = Figure(figsize=(5.5, 3.2), layout="constrained")
    axes = figure.subplots()
    for name, colour in zip(CURVE["VARIANTS"], CURVE_COLOURS, strict=True):
        points: dict[int, list[float]] = {}
        for robots in CURVE_OPTIONS.robots:
            seeds = CURVE["real_arm_rows"](CURVE["stored_scores"](name, robots, CURVE_OPTIONS))
            if seeds:
                points[robots] = [100 * mean(row["success"] for row in rows) for rows in seeds]
        if points:
            axes.plot(list(points), [mean(p) for p in points.values()], color=colour, label=name)
        for robots, rates in points.items():
            axes.plot([robots] * len(rates), rates, "o", ms=3, color=colour)
    axes.set_xscale("log")
    axes.set_xlabel("robots of the grammar serial in training")
    axes.set_ylabel("success on ten real arms [%]")
    axes.set_ylim(0, 102)
    axes.legend(fontsize=8, frameon=False)
    return figure


def save(figure: Figure, name: str) -> Path:
    """Write a figure, and return its path."""
    IMAGES.mkdir(parents=True, exist_ok=True)
    path = IMAGES / name
    FigureCanvasAgg(figure).print_figure(path, dpi=110, metadata={"Software": None})
    return path


def tables() -> dict[str, str]:
    """Return the tables of the page by their names."""
    return {
        **{task: split_table(task) for task in TASKS},
        "ee-task": ee_task_table(),
        "fine-tuning": fine_tuning_table(),
        "pybullet": pybullet_table(),
        **{f"robots-{name}": curve_table(name) for name in CURVE["VARIANTS"]},
        "similarity": TRANSFER["table"](similarity_rows()),
    }


def similarity_rows() -> list[Any]:
    """Return the rows of benchmarks/similarity_transfer.py."""
    return list(TRANSFER["read_rows"](ROOT / TRANSFER["OUT"]))


def main() -> int:
    """Write the page and the figures."""
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    PAGE.write_text(write_tables(tables(), PAGE.read_text("utf-8")), "utf-8")
    print(PAGE)
    print(save(bar_figure("reach", "jacobian"), "reach.png"))
    print(save(bar_figure("push", "scripted"), "push.png"))
    print(save(fine_tuning_figure(), "fine-tuning.png"))
    print(save(curve_figure(), "robots.png"))
    TRANSFER["draw_figure"](similarity_rows(), IMAGES / "similarity.png")
    print(IMAGES / "similarity.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
