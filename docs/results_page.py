"""Write the tables of docs/results.md and of three pages of results/, and figures, from the scores.

    python docs/results_page.py

Each table stands between two comments of a page, ``<!-- NAME -->`` and ``<!-- /NAME -->``, and is
replaced. The figures are in docs/images/results: reach.png, push.png, fine-tuning.png,
robots.png and similarity.png.
"""

from __future__ import annotations

import argparse
import json
import re
import runpy
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from statistics import mean
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from tabulate import tabulate

from morphgen.benchmark.scores.results import ResultRow, result_rows
from morphgen.benchmark.scores.submission import EPISODES, Submission, name_of, read_table
from morphgen.rl.scores import Interval, relative_scores, success_interval
from morphgen.splits.split import SIDES

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs/results.md"
TABLES = ROOT / "results/tables.md"
FILES = ROOT / "results/README.md"
OLDER = ROOT / "results/studies.md"
IMAGES = ROOT / "docs/images/results"
STUDIES = ("reach-30m", "reach-30m-4epochs", "reach-100m", "push-30m")
TASKS = ("reach", "reach-obstacles", "push", "push-obstacles")
EE_TASK = "composition/ee-task"
"""The split whose robots have different tasks."""
EE_TASK_STUDIES = {
    "ee-task-30m": "",
    "ee-task-20m": "",
    "ee-task-contact": ", channels `contact` and `pace`",
}
"""Studies of ``EE_TASK``, and what their policies see besides the channels of their agent."""
SHIPPED_PUSH = "zero-shot-push"  # it has trained on other robots than those of the split
SPLITS = (
    "interpolation/arm3",
    "interpolation/panda",
    "composition/ee-arm",
    "extrapolation/primitives",
    "extrapolation/arms",
    "extrapolation/arms-small",
)
FIGURE_SPLITS = SPLITS[:5]
OBJECTS = ("drawer", "door", "dial")
OBJECT_SPLITS = (*SPLITS[:3], "extrapolation/primitives-sliding", "extrapolation/arms")
TUNED_STEPS = (10_000, 30_000)
PAPER_AGENT = "-symlog-slow-critic-discrete"
CHANNELS = "+normalize+lag+joint+poses+jacobian+dls"
AGENTS = {
    "me-graph": "`me-graph`",
    "me-graph+clearance": "`me-graph`, channel `clearance`",
    f"me-mlp{PAPER_AGENT}{CHANNELS}": "`me-mlp`, kinematic channels",
    f"me-tf{PAPER_AGENT}{CHANNELS}": "`me-tf`, kinematic channels",
    f"me-mlp{PAPER_AGENT}": "`me-mlp`, the paper's observations",
    f"me-tf{PAPER_AGENT}": "`me-tf`, the paper's observations",
    f"se{PAPER_AGENT}": "`se`, the paper's observations",
    f"se{PAPER_AGENT}@test": "`se` on the test robot",
}
SHIPPED = {
    "reach": "reach",
    "obstacles": "`--obstacles`",
    "pose": "`--goal pose`",
    "pose-obstacles": "`--goal pose --obstacles`",
    "push": "`--task push`",
    **{task: f"`--task {task}`" for task in OBJECTS},
    **{
        f"elsewhere-{folder}-{task}": f"{task}, robots from elsewhere, {robots}"
        for task in ("reach", "push")
        for folder, robots in (
            ("mjcf", "bare"),
            ("mjcf-stick", "with a stick"),
            ("hand", "written by hand"),
        )
    },
}
"""Files of results/zero-shot, and what they measure."""
BASELINES = ("scripted", "ik", "jacobian", "random", "zero")
COLOURS = ("#2b6cb0", "#38a169", "#d69e2e", "#9ae6b4", "#f6e05e")
CURVE_COLOURS = ("#2b6cb0", "#38a169", "#d69e2e", "#c53030", "#805ad5")
sys.path.append(str(ROOT / "benchmarks"))
CURVE = runpy.run_path(str(ROOT / "benchmarks/robot_curve.py"))
CURVE_OPTIONS = CURVE["arguments"](["--report", "--out", str(ROOT / "results/robot-curve.json")])
LAW = runpy.run_path(str(ROOT / "benchmarks/scaling_law.py"))
LAW_CELLS = {  # numbers of robots, and seeds, by task
    "push": ((1, 10, 30, 100, 300, 1000), range(5)),
    "door": ((1, 10, 30, 100, 300, 1000), range(5)),
    "pose": ((1, 3, 10, 30, 100, 1000), range(4)),
    "push_cloned": ((1, 10, 30, 100), range(3)),
    "push_short": ((1, 3, 10, 30), range(2)),
}
TRANSFER = runpy.run_path(str(ROOT / "benchmarks/similarity_transfer.py"))
SHIPPED_ARMS = runpy.run_path(str(ROOT / "benchmarks/zero_shot_arms.py"))


@cache
def episodes_of(study: str) -> dict[str, Submission]:
    """Return the episodes of a study in results/, by split, method, seed and mode."""
    table = read_table(ROOT / "results" / study / EPISODES)
    return {name_of(submission): submission for submission in table}


@cache
def rows_of(study: str) -> list[ResultRow]:
    """Return the rows of a study for policies that act by their mean, and baselines."""
    episodes = episodes_of(study).items()
    return result_rows({k: v for k, v in episodes if v.mode != "stochastic" and not v.finetuned})


def results_of(study: str, split: str, task: str | None = None) -> dict[tuple[str, int], ResultRow]:
    """Return the rows of a split by agent and transitions; baselines have 0 transitions.

    Args:
        study: Folder in results/.
        split: Name of the split.
        task: Task of the robots; by default that of all robots of the split.
    """
    rows = [row for row in rows_of(study) if row.split == split and task in (None, row.task)]
    return {(row.method, row.transitions or 0): row for row in rows}


def rates_on_test(submission: Submission) -> tuple[list[float], list[int]]:
    """Return success rate and number of episodes of each test robot."""
    own = [robot.success for robot in submission.robots if robot.side == "test"]
    return [mean(each) for each in own], [len(each) for each in own]


def split_table(task: str) -> str:
    """Return the table of a task: every split with all agents and baselines."""
    lines = []
    with_scores = task.startswith("reach")  # the score of push is its success
    for split in SPLITS:
        found: dict[tuple[str, int, str], ResultRow] = {}
        for study in STUDIES:
            note = ", four epochs" if "4epochs" in study else ""
            for (agent, steps), row in results_of(study, f"{split}/{task}").items():
                if agent in (*AGENTS, *BASELINES):
                    found[agent, steps, note] = row
        order = [*AGENTS, *BASELINES]
        for agent, steps, note in sorted(found, key=lambda key: (order.index(key[0]), key[1:])):
            row = found[agent, steps, note]
            lines.append([split, *_line(agent, steps, note, row, with_scores)])
            split = ""
    score = ["MT", "success", "ZS", "success"] if with_scores else ["MT", "ZS"]
    headers = ["split", "agent", "transitions", "seeds", *score]
    return tabulate(lines, headers=headers, tablefmt="github", disable_numparse=True)


def summary_table() -> str:
    """Return zero-shot success on each split of reach and push, by agent."""
    columns = [agent for agent in AGENTS if not agent.startswith(("se", "me-graph+"))]
    lines = []
    for task, best in (("reach", "ik"), ("push", "scripted")):
        for split in SPLITS:
            rates: dict[str, str] = {}
            for (agent, _), row in results_of(f"{task}-30m", f"{split}/{task}").items():
                rates[agent] = row.sides["test"].success.as_percent() if "test" in row.sides else ""
            lines.append([f"{split}/{task}", *(rates.get(agent, "") for agent in (*columns, best))])
    headers = ["split", *(AGENTS[agent] for agent in columns), "`ik`; push: `scripted`"]
    return tabulate(lines, headers=headers, tablefmt="github", disable_numparse=True)


def objects_table() -> str:
    """Return success at drawer, door and dial on each split, by agent and side."""
    lines = []
    for split in OBJECT_SPLITS:
        found = [results_of("objects-30m", f"{split}/{task}") for task in OBJECTS]
        keys = {key for rows in found for key in rows}
        order = [*AGENTS, *BASELINES]
        for key in sorted(keys, key=lambda key: (order.index(key[0]), key[1])):
            rows = [each.get(key) for each in found]
            seeds = min((len(row.seeds) for row in rows if row), default=0)
            cells = [
                row.sides[side].success.as_percent() if row and side in row.sides else ""
                for row in rows
                for side in SIDES
            ]
            lines.append([split, *_run_cells(*key, seeds), *cells])
            split = ""
    headers = ["split", "agent", "transitions", "seeds"]
    headers += [f"{task}, {side}" for task in OBJECTS for side in ("MT", "ZS")]
    return tabulate(lines, headers=headers, tablefmt="github", disable_numparse=True)


def ee_task_table() -> str:
    """Return success of the split in which robots have different tasks, by side and task."""
    push, reach = (
        {
            (*key, note): row
            for study, note in EE_TASK_STUDIES.items()
            for key, row in results_of(study, EE_TASK, task).items()
        }
        for task in ("push", "reach")
    )
    order = [*AGENTS, SHIPPED_PUSH, *BASELINES]
    lines = []
    keys = [key for key in {*push, *reach} if key[0] in order]
    for key in sorted(keys, key=lambda key: (order.index(key[0]), key[1:])):
        agent, steps, note = key
        rows = [found[key] for found in (push, reach) if key in found]
        pushing, reaching = (found[key].sides if key in found else {} for found in (push, reach))
        seeds = max(len(row.seeds) for row in rows)
        columns = (pushing.get("train"), reaching.get("train"), pushing.get("test"))
        rates = [column.success.as_percent() if column else "" for column in columns]
        score = f"{reaching['train'].score.value:.1f}" if reaching else ""
        lines.append([*_run_cells(agent, steps, seeds, note), rates[0], score, *rates[1:]])
    headers = ["agent", "transitions", "seeds", "MT, push", "MT, reach", "success", "ZS, push"]
    return tabulate(lines, headers=headers, tablefmt="github", disable_numparse=True)


def seeds_table() -> str:
    """Return the splits of each study on which an agent has one seed, or no run as others have."""
    lines = []
    for study in (*STUDIES, *EE_TASK_STUDIES, "objects-30m", "reach-24m"):
        seeds: dict[str, dict[str, set[int]]] = {}
        for row in rows_of(study):
            if row.method in AGENTS and row.transitions:
                seeds.setdefault(row.method, {}).setdefault(row.split, set()).update(row.seeds)
        splits = list(dict.fromkeys(split for found in seeds.values() for split in found))
        for agent in sorted(seeds, key=list(AGENTS).index):
            one = [split for split, own in seeds[agent].items() if len(own) == 1]
            none = [split for split in splits if split not in seeds[agent]]
            if one or none:
                lines.append([f"`{study}`", AGENTS[agent], ", ".join(one), ", ".join(none)])
    headers = ["study", "agent", "one seed", "no run"]
    return tabulate(lines, headers=headers, tablefmt="github", disable_numparse=True)


def shipped_rows(file: str) -> dict[str, dict[str, Any]]:
    """Return the rows of a file of results/zero-shot by robot and, the policy first, controller."""
    data = json.loads((ROOT / f"results/zero-shot/{file}.json").read_text("utf-8"))
    return {robot: {row["controller"]: row for row in rows} for robot, rows in data.items()}


def shipped_table() -> str:
    """Return the mean success over robots of each shipped policy, and the lowest of a robot."""
    lines = []
    for file, label in SHIPPED.items():
        lines.append(_shipped_line(label, rows := shipped_rows(file)))
        if file == "push":  # other trainings of push have only these
            ten = {arm: rows[arm] for arm in CURVE["REAL_ARMS"]}
            lines.append(_shipped_line(f"{label}, ten arms of these", ten))
    names = ("path", "jacobian", "ik", "scripted", "random")
    headers = ["mean; lowest of a robot", "robots", "episodes", "policy"]
    headers += [f"`{name}`" for name in names]
    return tabulate(lines, headers=headers, tablefmt="github", disable_numparse=True)


def _shipped_line(label: str, by_robot: Mapping[str, dict[str, Any]]) -> list[str]:
    robots = [*by_robot.values()]
    policy, *_ = robots[0]
    trials = [rows[policy]["episodes"] for rows in robots]
    line = [label, str(len(robots)), str(max(trials))]
    for name in (policy, "path", "jacobian", "ik", "scripted", "random"):
        rates = [rows[name]["success"]["value"] for rows in robots if name in rows]
        text = f"{mean(rates):.1%}; {min(rates):.0%}" if rates else ""
        if name == policy:
            ends = success_interval(rates, trials).ends(".0%")
            text = f"{mean(rates):.1%} ({ends}); {min(rates):.0%}"
        line.append(text)
    return line


def shipped_objects_table() -> str:
    """Return success of the shipped policies of drawer, door and dial on each arm."""
    found = [shipped_rows(task) for task in OBJECTS]
    lines = []
    for arm in found[0]:
        rates = [next(iter(rows[arm].values()))["success"] for rows in found]
        lines.append([arm, *(Interval(**rate).as_percent() for rate in rates)])
    headers = ["arm", *OBJECTS]
    return tabulate(lines, headers=headers, tablefmt="github", disable_numparse=True)


def elsewhere_table() -> str:
    """Return success of the shipped policies and the best baselines on robots from elsewhere."""
    lines = []
    for file, label in SHIPPED.items():
        if not (file.startswith("elsewhere") and file.endswith("reach")):
            continue
        push = shipped_rows(file.replace("reach", "push"))
        for robot, rows in sorted(shipped_rows(file).items()):
            policy, *_ = rows.values()
            found = [policy, rows["jacobian"], rows["ik"]]
            if robot in push:
                policy, *_ = push[robot].values()
                found += [policy, push[robot]["scripted"]]
            cells = [f"{row['success']['value']:.0%}" for row in found]
            (name,) = re.findall(r"^(?:arm=rs_)?(\w+)", robot)
            lines.append([f"{name}, {label.split(', ')[-1]}", *cells, *[""] * (5 - len(cells))])
    headers = ["robot", "reach: policy", "`jacobian`", "`ik`", "push: policy", "`scripted`"]
    return tabulate(lines, headers=headers, tablefmt="github", disable_numparse=True)


def tolerance_table() -> str:
    """Return the table of ``benchmarks/zero_shot_arms.py --tolerances``."""
    stored = json.loads((ROOT / "results/zero-shot/tolerances.json").read_text("utf-8"))
    return str(SHIPPED_ARMS["tolerance_table"](stored["robots"]))


def _run_cells(agent: str, steps: int, seeds: int, note: str = "") -> list[str]:
    """Return agent, transitions and seeds; the latter two are empty for a baseline."""
    name = AGENTS.get(agent, f"`{agent}`") + (note if agent in AGENTS else "")
    share = " a robot" if agent.startswith("se") else ""
    return [name, *([f"{round(steps / 1e6)} million{share}", str(seeds)] if steps else ["", ""])]


def _names(submission: Submission) -> list[str]:
    """Return split, agent and seed of a run."""
    seed = str(submission.training_seed)
    return [submission.split.name, AGENTS[submission.method], seed]


def _line(agent: str, steps: int, note: str, row: ResultRow, with_scores: bool) -> list[str]:
    sides = row.sides
    cells = _run_cells(agent, steps, len(row.seeds), note)
    for side in SIDES:
        if side not in sides:
            cells += [""] * (2 if with_scores else 1)
            continue
        success = sides[side].success.as_percent()
        cells += [f"{sides[side].score.value:.1f}", success] if with_scores else [success]
    return cells


def fine_tuned_runs() -> dict[str, list[tuple[list[str], list[Interval]]]]:
    """Return runs by their test task: split, agent and seed, and success by steps of tuning."""
    found: dict[str, list[tuple[list[str], list[Interval]]]] = {}
    for study in ("ee-task-30m", "push-30m", "reach-30m"):
        runs: dict[tuple[object, ...], dict[int, Submission]] = {}
        for each in episodes_of(study).values():
            if each.mode == "deterministic":
                run = runs.setdefault((each.split.name, each.method, each.training_seed), {})
                run[each.finetuned] = each
        for run in runs.values():
            if run.keys() >= set(TUNED_STEPS):
                task = next(robot.task for robot in run[0].robots if robot.side == "test")
                rates = [success_interval(*rates_on_test(run[n])) for n in (0, *TUNED_STEPS)]
                found.setdefault(task, []).append((_names(run[0]), rates))
    return found


def fine_tuning_table() -> str:
    """Return success on the test robots before and after fine-tuning."""
    lines = []
    for task, rows in sorted(fine_tuned_runs().items()):
        lines += [[*names, *(x.as_percent() for x in rates)] for names, rates in rows]
        means = [
            mean(rate.value for rate in column)
            for column in zip(*(r for _, r in rows), strict=True)
        ]
        lines.append([f"**mean of {len(rows)}, {task}**", "", "", *(f"**{x:.1%}**" for x in means)])
    steps = [f"{number:,} steps" for number in TUNED_STEPS]
    headers = ["split", "agent", "seed", "zero-shot", *steps]
    return tabulate(lines, headers=headers, tablefmt="github", disable_numparse=True)


def pybullet_table() -> str:
    """Return scores on the test robots in MuJoCo and in PyBullet, for runs that have both."""
    lines: list[list[str]] = []
    differences: dict[str, list[float]] = {}
    stored = json.loads((ROOT / "results/pybullet.json").read_text("utf-8"))
    for run, bullet in stored.items():
        study, _, name = run.partition("/")
        split, method, seed = name.rsplit("/", 2)
        mujoco = episodes_of(study)[f"{split} {method} {seed} deterministic"]
        tests = [robot for robot in mujoco.robots if robot.side == "test"]
        rates = [100 * mean(rates_on_test(mujoco)[0]), 100 * mean(row["success"] for row in bullet)]
        differences.setdefault(tests[0].task, []).append(rates[1] - rates[0])
        names = _names(mujoco)
        if study.endswith("100m"):
            names[1] += ", 100 million"
        cells = [*names, *(f"{rate:.0f}%" for rate in rates)]
        cells.append(f"{rates[1] - rates[0]:+.0f} points")
        if tests[0].task == "reach":  # the score of push is its success
            scores = (
                mean(relative_scores(x).mean() for x in tests),
                mean(x["score"] for x in bullet),
            )
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


def law_tables() -> str:
    """Return the tables of benchmarks/scaling_law.py."""
    cells = LAW["read_cells"](ROOT / "results/scaling-law.json")
    tables = [
        LAW["report"](cells, [task], numbers, seeds) for task, (numbers, seeds) in LAW_CELLS.items()
    ]
    return "\n\n".join(tables)


def write_tables(tables: Mapping[str, str], page: Path) -> str:
    """Return the text of a page with its tables replaced.

    Raises:
        ValueError: If the page has no place for a table.
    """
    text = page.read_text("utf-8")
    for name, table in tables.items():
        pattern = rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)"
        text, count = re.subn(pattern, rf"\1\n{table}\n\n\2", text, flags=re.DOTALL)
        if count != 1:
            raise ValueError(f"{page}: {count} places for the table {name}; expected one")
    return text


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
            rows = [row for (of, _), row in found.items() if of == agent]
            if not rows:
                continue
            rate = rows[0].sides["test"].success
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
    for (split, *_), rates in fine_tuned_runs()["push"]:
        by_split.setdefault(split, []).append([100 * rate.value for rate in rates])
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


def tables() -> dict[Path, dict[str, str]]:
    """Return the tables of each page by their names."""
    return {
        PAGE: {"summary": summary_table()},
        TABLES: _all_tables(),
        FILES: {"seeds": seeds_table()},
        OLDER: {
            "shipped": shipped_table(),
            "shipped-objects": shipped_objects_table(),
            "elsewhere": elsewhere_table(),
            "tolerances": tolerance_table(),
        },
    }


def _all_tables() -> dict[str, str]:
    return {
        **{task: split_table(task) for task in TASKS},
        "ee-task": ee_task_table(),
        "objects": objects_table(),
        "fine-tuning": fine_tuning_table(),
        "pybullet": pybullet_table(),
        **{f"robots-{name}": curve_table(name) for name in CURVE["VARIANTS"]},
        "law": law_tables(),
        "similarity": TRANSFER["table"](similarity_rows()),
    }


def similarity_rows() -> list[Any]:
    """Return the rows of benchmarks/similarity_transfer.py."""
    return list(TRANSFER["read_rows"](ROOT / TRANSFER["OUT"]))


def main() -> int:
    """Write the pages and the figures."""
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    for page, found in tables().items():
        page.write_text(write_tables(found, page), "utf-8")
        print(page)
    print(save(bar_figure("reach", "jacobian"), "reach.png"))
    print(save(bar_figure("push", "scripted"), "push.png"))
    print(save(fine_tuning_figure(), "fine-tuning.png"))
    print(save(curve_figure(), "robots.png"))
    TRANSFER["draw_figure"](similarity_rows(), IMAGES / "similarity.png")
    print(IMAGES / "similarity.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
