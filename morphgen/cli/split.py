"""``morphgen split``: list, print and release splits of train and test robots."""

from __future__ import annotations

import argparse
import itertools
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from morphgen.cli import options as opt
from morphgen.cli.command import Command, Option, command, flag, number, option
from morphgen.cli.progress import bar, status
from morphgen.cli.split_new import new
from morphgen.cli.split_release import release, score
from morphgen.errors import BenchmarkError, GrammarError, PartError
from morphgen.tasks.registry import TASKS

if TYPE_CHECKING:
    from morphgen.benchmark.audit import Audit
    from morphgen.benchmark.survey import BaselineResults, PaperRow, RobotDifficulty
    from morphgen.benchmark.verify import Difference
    from morphgen.encoding.similarity import NearThresholds
    from morphgen.model.findings import Finding
    from morphgen.splits.split import Member, Split
    from morphgen.tasks.goals.split_goals import GoalResult, SplitGoals
    from morphgen.tasks.scenes.env_specs import GoalConfig


HEADERS = ("robot", "side", "task", "goals", "acceptance", "obstacles", "certified")


@command(
    "goals",
    "sample the goal sets of robots, and certify that each goal can be reached",
    option(
        "words SPLIT",
        f"name of a split, its file or built folder; with --task, a robot: {opt.ROBOT_HELP}",
        nargs="+",
    ),
    option("--task TASK", f"one robot: its task, {opt.TASK_NAMES}", choices=TASKS),
    opt.OBSTACLES,
    opt.SEED,
    flag("--certify", "verify every goal with the configuration that it was sampled from"),
    *opt.JOBS_LIBRARY_JSON,
    details="Goals of reach and starts of push are kept in the cache. The goals of reach are full "
    "poses, so the sets are the same for --goal position and --goal pose of other commands. Run "
    "the command again to continue an interrupted one. The exit code is 1 if a robot has too few "
    "goals, or if a goal fails --certify.",
    examples=("goals extrapolation/arms/reach --certify", "goals arm=ur5 ee=plane --task reach"),
)
def goals(args: argparse.Namespace) -> int:
    """Sample goal sets and print a table with the failures."""
    from morphgen.tasks.scenes.env_specs import GoalConfig

    if args.task is None:
        if args.obstacles:
            raise BenchmarkError(
                "--obstacles goes with --task; a split says which robots have obstacles"
            )
        if len(args.words) > 1:
            raise BenchmarkError(
                f"{' '.join(args.words)}: name one split, or say --task for a robot"
            )
        from morphgen.benchmark.split_folder import read_split_or_folder

        split, _ = read_split_or_folder(args.words[0])
        results = make_goals(args, split, GoalConfig(args.seed), certify=args.certify)
    else:
        results = [_robot_goals(args, GoalConfig(args.seed))]
    passed = all(result.goals is not None and not result.certificate_errors for result in results)
    data = _data(results, args.seed) | {"passed": passed}
    opt.print_result(args, data, lambda: _goals_text(results, args.seed))
    return int(not passed)


def _robot_goals(args: argparse.Namespace, config: GoalConfig) -> GoalResult:
    from morphgen.splits.split_file import split_names
    from morphgen.tasks.goals.split_goals import sample_robot_goals
    from morphgen.tasks.scenes.env_specs import load_robot

    words = " ".join(args.words)
    if words in split_names():
        raise BenchmarkError(f"--task {args.task}: is for a robot; {words} is a split")
    with status(args, f"sampling goals of {args.task} for {words}"):
        robot = load_robot(words, library=args.library)
        return sample_robot_goals(
            robot, args.task, config, obstacles=args.obstacles, certified=args.certify
        )


def make_goals(
    args: argparse.Namespace, split: Split, config: GoalConfig, *, certify: bool = False
) -> list[GoalResult]:
    """Sample the goal sets of a split's robots, or read them from the cache."""
    from morphgen.tasks.goals.split_goals import sample_split_goals

    with bar(args, "sampling goals"):
        return sample_split_goals(
            split, opt.library_of(args), config, jobs=args.jobs, certified=certify
        )


def _goals_text(results: Sequence[GoalResult], seed: int) -> str:
    lines = [opt.table([_goals_row(result) for result in results], HEADERS, disable_numparse=True)]
    for result in results:
        robot = f"{result.side} robot {result.robot}" if result.side else f"robot {result.robot}"
        if result.goals is None:
            lines.append(f"{robot}: {result.error}")
        elif result.certificate_errors:
            first, *others = result.certificate_errors
            more = f" (and {len(others)} more)" if others else ""
            lines.append(f"{robot}: {first}{more}")
    complete = sum(result.goals is not None for result in results)
    return "\n".join([*lines, f"{complete} of {len(results)} goal sets are complete, seed {seed}"])


def _goals_row(result: GoalResult) -> tuple[str, ...]:
    goals, certificate_errors = result.goals, result.certificate_errors
    certified = (
        "not tested" if certificate_errors is None else "NO" if certificate_errors else "yes"
    )
    rate = "" if result.acceptance is None else f"{result.acceptance:.3g}"
    count = "none" if goals is None else str(len(goals.q))
    boxes = str(len(goals.obstacles)) if goals else "yes" if result.obstacles else "0"
    return (result.robot, result.side or "", result.task, count, rate, boxes, certified)


def _data(results: Sequence[GoalResult], seed: int) -> dict[str, object]:
    from morphgen.tasks.goals.split_goals import goal_record

    sets = []
    for result in results:
        if result.goals:
            errors = result.certificate_errors
            certified = None if errors is None else not errors
            unproven = list(errors or ())
            sets.append({**goal_record(result), "certified": certified, "unproven": unproven})
    failures = [
        {"robot": result.robot, "side": result.side, "task": result.task, "why": result.error}
        for result in results
        if result.goals is None
    ]
    return {"seed": seed, "sets": sets, "failures": failures}


MAX_LISTED = 10
"""Largest number of findings of one code, or of differences, that are printed."""


def _goal_seed(help: str) -> Option:
    return number("--goal-seed", help, least=0)


@command(
    "audit",
    "look for leaks between train and test robots",
    option("split SPLIT", "name of a split, its file, or its built folder"),
    option(
        "--near TREE,COSINE[,WORKSPACE]",
        "robots are nearly the same if their tree distance is below, and their cosine similarity "
        "or, at one reach, their workspace overlap above (default: 0.001,0.99999,0.999)",
    ),
    flag("--strict", "fail on warnings, too"),
    flag("--goals", "audit goal sets even if the split ships none"),
    _goal_seed("seed that the goal sets must have (default: as shipped, else 0)"),
    *opt.JOBS_LIBRARY_JSON,
    details="The audit checks the rules of the split's regime, and names the nearest train robot "
    "of each test robot. If a built split ships goal sets, it also looks for goals that are on "
    "both sides, or out of reach. The exit code is 1 if there is an error that the split does not "
    "accept, or a warning with --strict.",
)
def audit(args: argparse.Namespace) -> int:
    """Audit a split and print the findings."""
    from morphgen.benchmark.audit import audit
    from morphgen.benchmark.licences import licenced_parts, restricted, restriction_line
    from morphgen.benchmark.split_folder import read_split_or_folder

    near = _near(args.near)
    split, folder = read_split_or_folder(args.split)
    library = opt.library_of(args)
    with bar(args, "auditing"):
        result = audit(split, library, near=near, jobs=args.jobs)
    result, goals = _audit_goals(args, result, split, folder)
    passed = result.passed(strict=args.strict)
    sets = {"sets": len(goals.sets), "seed": goals.config.seed} if goals else None
    try:
        parts = licenced_parts(split, library)
    except (GrammarError, PartError):  # the audit has a finding about it
        parts = ()
    limited = [part.as_dict() for part in restricted(parts)]
    data = {**result.as_dict(), "goals": sets, "restricted": limited, "passed": passed}
    line = restriction_line(parts)
    opt.print_result(args, data, lambda: _audit_text(result, passed, goals, line))
    return int(not passed)


def _near(text: str | None) -> NearThresholds:
    from morphgen.encoding.similarity import NEAR_THRESHOLDS, NearThresholds

    if text is None:
        return NEAR_THRESHOLDS
    try:
        tree, cosine, *more = map(float, text.split(","))
        near = NearThresholds(tree, cosine, *more)
    except (ValueError, TypeError) as error:
        raise BenchmarkError(
            f"--near {text}: expected a tree distance and a cosine, such as 0.001,0.99999; a third "
            "number is the workspace overlap"
        ) from error
    if not (0 <= tree <= 1 and -1 <= cosine <= 1 and 0 <= near.workspace <= 1):
        raise BenchmarkError(
            f"--near {text}: a tree distance is from 0 to 1, a cosine from -1 to 1, and a "
            "workspace overlap from 0 to 1"
        )
    return near


def _audit_goals(
    args: argparse.Namespace, result: Audit, split: Split, folder: Path | None
) -> tuple[Audit, SplitGoals | None]:
    """Add the findings about goal sets to an audit; return the goal sets, too."""
    from morphgen.benchmark.goal_audit import audit_goals, goals_to_audit, with_goal_findings

    sample = partial(make_goals, args, split) if args.goals else None
    goals = goals_to_audit(folder, args.goal_seed, sample)
    findings = None
    if goals is not None:
        with bar(args, "auditing goals"):
            library = opt.library_of(args)
            findings = audit_goals(split, goals, library, jobs=args.jobs)
    return with_goal_findings(result, split, findings), goals


def _audit_text(result: Audit, passed: bool, goals: SplitGoals | None, limits: str) -> str:
    from morphgen.encoding.similarity import MEASURES

    nearest: dict[str, list[str]] = {}
    for neighbour in result.neighbours:
        cell = f"{neighbour.train} {neighbour.value:.3f}"
        nearest.setdefault(neighbour.test, []).append(cell)
    rows = [(test, *cells) for test, cells in nearest.items()]
    headers = ("test robot", *(f"nearest by {name}" for name in MEASURES))
    lines = [opt.table(rows, headers, disable_numparse=True)] if rows else []
    for code, findings in _by_code(result.findings).items():
        lines.append(f"{findings[0].severity} {code} ({len(findings)})")
        lines += _listed(findings)
        lines.append(f"    fix: {findings[0].fix}")
    reasons = {finding.code: reason for finding, reason in result.accepted}
    for code, findings in _by_code([finding for finding, _ in result.accepted]).items():
        lines.append(f"accepted {code} ({len(findings)}): {reasons[code]}")
        lines += _listed(findings)
    if goals:
        lines.append(f"{len(goals.sets)} goal sets were audited, seed {goals.config.seed}")
    if limits:
        lines.append(limits)
    counts = ", ".join(
        f"{sum(finding.severity == severity for finding in result.findings)} {severity}"
        for severity in ("error", "warning")
    )
    verdict = "passed" if passed else "FAILED"
    lines.append(f"{result.split}: {verdict}: {counts}, {len(result.accepted)} accepted")
    return "\n".join(lines)


def _by_code(findings: Sequence[Finding]) -> dict[str, list[Finding]]:
    """Return the findings of each code, in the order of the first of each."""
    codes = dict.fromkeys(finding.code for finding in findings)
    return {code: [each for each in findings if each.code == code] for code in codes}


def _listed(findings: Sequence[Finding | Difference]) -> list[str]:
    """Return a line per finding, and how many more there are."""
    more = len(findings) - MAX_LISTED
    lines = [f"  {finding.where}: {finding.why}" for finding in findings[:MAX_LISTED]]
    return [*lines, *([f"  and {more} more (--json lists all)"] if more > 0 else [])]


@command(
    "build",
    "write every robot of a split and its tokens into a folder",
    option("split SPLIT", "name of a split, or its file"),
    option("--out DIR", "folder where the split's folder goes", Path, default=Path("data")),
    flag("--light", "write the URDF and the derivation only"),
    flag("--picture", "draw preview.png of every robot"),
    flag("--goals", "ship the goal set of every robot"),
    _goal_seed("with --goals: seed of the goal sets (default: 0)").needing("--goals"),
    *opt.JOBS_LIBRARY_JSON,
    details="The same split gives the same bytes, with any number of jobs. Run the command again "
    "to continue an interrupted one.",
    examples=("split build interpolation/panda/reach --out data --goals --jobs 4",),
)
def build(args: argparse.Namespace) -> None:
    """Build a split and print where it is."""
    from morphgen.benchmark.licences import licenced_parts, restricted, restriction_text
    from morphgen.benchmark.release import build_with_goals
    from morphgen.benchmark.split_folder import BuildSettings
    from morphgen.splits.split_file import read_split
    from morphgen.tasks.scenes.env_specs import GoalConfig

    settings = BuildSettings(light=args.light, picture=args.picture)
    split, config = read_split(args.split), GoalConfig(args.goal_seed or 0)
    goals = make_goals(args, split, config) if args.goals else []
    library = opt.library_of(args)
    with bar(args, "building"):
        report = build_with_goals(split, args.out, library, settings, goals, config, jobs=args.jobs)
    written, kept = report.num_written, report.num_kept
    data: dict[str, object] = {"folder": str(report.folder), "made": written, "kept": kept}
    lines = [f"{report.folder}: {written} robots written, {kept} already existed"]
    if args.goals:
        data["goals"] = len(goals)
        lines.append(f"{len(goals)} goal sets, seed {config.seed}")
    if limited := restricted(licenced_parts(split, library)):
        data["restricted"] = [part.as_dict() for part in limited]
        lines += [f"restricted: {restriction_text(part)}" for part in limited]
    lines.append(f"verify it anywhere: morphgen split verify {report.folder}")
    opt.print_result(args, data, lambda: "\n".join(lines))


@command(
    "verify",
    "verify that a split, its built folder or its release has the robots that it claims",
    option("path PATH", "name of a split, its file, its built folder, or the archive of a release"),
    *opt.JOBS_LIBRARY_JSON,
    details="Every robot is composed anew and compared: with the hashes of the split, or with all "
    "files of a built folder or a release. The exit code is 1 if something differs.",
)
def verify(args: argparse.Namespace) -> int:
    """Verify a split and print what differs."""
    from morphgen.benchmark.verify import verify

    with bar(args, "verifying"):
        result = verify(args.path, opt.library_of(args), jobs=args.jobs)
    differences, split = result.differences, result.split
    data = {
        "split": split.name,
        "id": result.id,
        "differences": [{"where": each.where, "why": each.why} for each in differences],
        "passed": not differences,
        **({"content": result.content} if result.content else {}),
    }

    def text() -> str:
        verdict = f"{len(differences)} difference{'' if len(differences) == 1 else 's'}"
        if not differences:
            verdict = f"all {len(split.train) + len(split.test)} robots are the same"
        lines = [f"{split.name}, id {result.id}: {verdict}", *_listed(differences)]
        if result.content and not differences:
            lines.append(f"  content: {result.content}")
        return "\n".join(lines)

    opt.print_result(args, data, text)
    return int(bool(differences))


@command(
    "difficulty",
    "print how hard each robot of splits is: size, nearest train robots, baselines",
    option("splits SPLIT", "names of splits, their files, or their built folders", nargs="+"),
    option(
        "--study FOLDER",
        "output folder of morphgen study, for score and success of the baselines",
        Path,
    ),
    option("--csv FILE", "write a row per robot", Path),
    *opt.JOBS_LIBRARY_JSON,
    details="The columns are the movable joints between root and tool, links, reach, and by each "
    "similarity measure the nearest other train robot with its value. With --study, score and "
    "success rate of each baseline of the study follow; scores of reach are relative to the random "
    "policy.",
    examples=(
        "split difficulty interpolation/arm3/reach --csv arm3.csv",
        "split difficulty extrapolation/arms/reach --study results/reach-30m",
    ),
)
def difficulty(args: argparse.Namespace) -> None:
    """Measure the robots of splits, print a table per split and write the file."""
    from morphgen.benchmark.survey import difficulty_csv, split_difficulty
    from morphgen.formats.files import require_writable_file, write_file

    if args.csv is not None:
        require_writable_file(args.csv, "--csv", ".csv")
    splits = _splits(args.splits)
    results = _results(args.study, splits)
    library = opt.library_of(args)
    rows: list[RobotDifficulty] = []
    for split, known in zip(splits, results, strict=True):
        with bar(args, split.name):
            rows += split_difficulty(split, library, results=known, jobs=args.jobs)
    baselines = _baselines(results)
    if args.csv is not None:
        write_file(args.csv, difficulty_csv(rows, baselines))
    files = [] if args.csv is None else [str(args.csv)]
    data = {"rows": [row.as_dict() for row in rows], "files": files}
    opt.print_result(args, data, lambda: _difficulty_text(rows, splits, baselines, files))


def _splits(names: Sequence[str]) -> list[Split]:
    """Return the splits; two of one name could not be told apart in the rows."""
    from morphgen.benchmark.split_folder import read_split_or_folder

    words: dict[str, str] = {}
    splits = []
    for name in names:
        split, _ = read_split_or_folder(name)
        opt.require_other_name(words, split.name, name)
        splits.append(split)
    return splits


def _results(study: Path | None, splits: Sequence[Split]) -> list[BaselineResults]:
    """Return the results of the baselines of a study on each split; none without a study."""
    if study is None:
        return [{} for _ in splits]
    from morphgen.benchmark.scores.results import study_results

    return [study_results(study, split) for split in splits]


def _baselines(results: Sequence[BaselineResults]) -> tuple[str, ...]:
    """Return the names of all baselines with results, in the order of their registry."""
    from morphgen.rl.baselines import BASELINES

    return tuple(name for name in BASELINES if any(name in known for known in results))


def _difficulty_text(
    rows: Sequence[RobotDifficulty],
    splits: Sequence[Split],
    baselines: Sequence[str],
    files: Sequence[str],
) -> str:
    """Return a table per split, each with the baselines of its tasks, and the written files."""
    from morphgen.benchmark.survey import difficulty_table

    parts = []
    for split in splits:
        own = [row for row in rows if row.split == split.name]
        columns = [name for name in baselines if any(name in row.baselines for row in own)]
        parts.append(f"{split.name}\n{difficulty_table(own, columns)}")
    notes = ["nearest: the most similar other train robot and its value by each measure"]
    if baselines:
        notes.append("baselines: score, success rate")
    return "\n".join(["\n\n".join(parts), "", *notes, *files])


SHORT_DERIVATION = 60
"""Number of characters of a derivation that ``show`` prints without ``--full``."""


@command("list", "list the splits that come with morphgen", opt.JSON)
def list_splits(args: argparse.Namespace) -> None:
    """Print a row per split."""
    from morphgen.splits.split_file import read_split, split_names

    splits = [read_split(name) for name in split_names()]
    data: list[dict[str, Any]] = [
        {
            "name": split.name,
            "regime": split.regime,
            "tasks": _tasks(split),
            "train": len(split.train),
            "test": len(split.test),
            "train_categories": _categories(split.train),
            "test_categories": _categories(split.test),
            "summary": split.summary,
            "reference": split.reference,
        }
        for split in splits
    ]
    headers = ("name", "regime", "task", "train", "test", "categories", "summary")
    rows = [
        (
            *(row["name"], row["regime"], ", ".join(row["tasks"]), row["train"], row["test"]),
            f"{', '.join(row['train_categories'])} -> {', '.join(row['test_categories'])}",
            row["summary"],
        )
        for row in data
    ]
    opt.print_result(args, data, lambda: opt.table(rows, headers))


@command(
    "show",
    "print the robots of a split",
    option("split SPLIT", "name of a split, or its file"),
    flag("--full", "print whole derivations, and how the robots were chosen"),
    *opt.LIBRARY_JSON,
    details="Names the licences of the parts, and the robots with a part under a non-commercial, "
    "no-derivatives or unknown licence.",
    examples=("split show interpolation/panda/reach",),
)
def show(args: argparse.Namespace) -> None:
    """Print a split."""
    from morphgen.benchmark.licences import licence_lines, licenced_parts
    from morphgen.splits.split import split_id
    from morphgen.splits.split_file import read_split

    split = read_split(args.split)
    try:
        parts = licenced_parts(split, opt.library_of(args))
        licences, lines = [part.as_dict() for part in parts], licence_lines(parts)
    except PartError as error:
        licences, lines = None, [f"licences: {error}; see --library"]
    data = {"id": split_id(split), **split.as_dict(), "licences": licences}
    opt.print_result(args, data, lambda: _split_text(split, lines, full=args.full))


def _split_text(split: Split, licences: Sequence[str], *, full: bool) -> str:
    from morphgen.splits.split import SIDES, split_id

    lines = [f"{split.name} ({split.regime}): {split.summary}", f"  id: {split_id(split)}"]
    if split.reference:
        lines.append(f"  reference: {split.reference}")
    for key, value in split.provenance.items():
        if full or isinstance(value, int | str):
            text = value if isinstance(value, str) else json.dumps(value).replace('"', "")
            lines.append(f"  {key}: {text}")
    lines += [f"  {line}" for line in licences]
    lines += [f"  accepted {code}: {reason}" for code, reason in split.accepted.items()]
    headers = ("name", "task", "category", "body", "derivation")
    for side in SIDES:
        members = split.side(side)
        counts = ", ".join(f"{n} {name}" for name, n in _categories(members).items())
        rows = [_row(member, full=full) for member in members]
        lines.append(f"\n{side}, {len(members)}: {counts}")
        lines.append(opt.table(rows, headers, disable_numparse=True))
    return "\n".join(lines)


def _row(member: Member, *, full: bool) -> tuple[str, ...]:
    text = member.derivation
    if not full and len(text) > SHORT_DERIVATION:
        text = f"{text[: SHORT_DERIVATION - 3]}..."
    return (member.name, _task(member), member.category, member.robot_hash[:8], text)


def _task(member: Member) -> str:
    return member.task + (" (obstacles)" if member.obstacles else "")


def _tasks(split: Split) -> list[str]:
    return sorted({_task(member) for member in (*split.train, *split.test)})


def _categories(members: Sequence[Member]) -> Counter[str]:
    return Counter(member.category for member in members)


@command(
    "stats",
    "print statistics of splits next to those of the paper",
    option("splits SPLIT", "names or files (default: all shipped splits)", nargs="*"),
    flag("--markdown", "print the table as Markdown"),
    *opt.JOBS_LIBRARY_JSON,
    details="The columns are the mean numbers of links, of movable joints and of movable joints "
    "between base and tool of the train robots, and the cosine similarity of test and train "
    "robots; the paper's numbers are in parentheses. Splits with the same robots share a row.",
)
def stats(args: argparse.Namespace) -> None:
    """Print a table with a row per set of robots."""
    from morphgen.benchmark.licences import licenced_parts, restricted, restriction_text
    from morphgen.benchmark.survey import PAPER_TABLE, paper_row, statistics
    from morphgen.splits.split_file import read_split, split_names

    library = opt.library_of(args)
    groups = _by_robots([read_split(name) for name in args.splits or split_names()])
    statistics_by_title: dict[str, dict[str, Any]] = {}
    for title, splits in groups.items():
        with bar(args, title):
            statistics_by_title[title] = statistics(splits[0], library, jobs=args.jobs)
    limits = {
        title: restricted(licenced_parts(splits[0], library)) for title, splits in groups.items()
    }
    data = [
        {
            "robots": title,
            "splits": [split.name for split in splits],
            "ours": statistics_by_title[title],
            "paper": asdict(theirs) if (theirs := paper_row(title)) else None,
            "restricted": [part.as_dict() for part in limits[title]],
        }
        for title, splits in groups.items()
    ]

    def text() -> str:
        rows = [
            _stats_row(title, ours, paper_row(title)) for title, ours in statistics_by_title.items()
        ]
        style = "github" if args.markdown else "simple"
        lines = [
            opt.table(rows, "keys", tablefmt=style, disable_numparse=True),
            "",
            "links, joints, mass: mean over the train robots; cosine: of test and train robots",
            f"in parentheses: {PAPER_TABLE}",
        ]
        for title, parts in limits.items():
            lines += [f"restricted licence in {title}: {restriction_text(part)}" for part in parts]
        return "\n".join(lines)

    opt.print_result(args, {"rows": data, "paper": PAPER_TABLE}, text)


def _by_robots(splits: Sequence[Split]) -> dict[str, list[Split]]:
    """Return splits with the same robots together, by what their names have in common."""
    from morphgen.splits.split import SIDES

    groups: dict[tuple[tuple[str, ...], ...], list[Split]] = {}
    for split in splits:
        # The robots are compared in their order.
        hashes = tuple(tuple(m.robot_hash for m in split.side(side)) for side in SIDES)
        groups.setdefault(hashes, []).append(split)
    return {_common_prefix([split.name for split in group]): group for group in groups.values()}


def _common_prefix(names: Sequence[str]) -> str:
    """Return the path segments that all names begin with, or the first name if there are none."""
    columns = zip(*(name.split("/") for name in names), strict=False)
    same = list(itertools.takewhile(lambda column: len(set(column)) == 1, columns))
    return "/".join(column[0] for column in same) or names[0]


def _stats_row(
    title: str, statistics: Mapping[str, Any], paper_row: PaperRow | None
) -> dict[str, str]:
    train, cosine = statistics["train"], statistics["cosine"]

    def with_paper(value: str, key: str) -> str:
        if paper_row is None:
            return value
        paper = getattr(paper_row, key)
        return f"{value} ({'-' if paper is None else f'{paper:g}'})"

    row = {"robots": title, "train": train["robots"], "test": statistics["test"]["robots"]}
    for key in ("links", "movable", "movable_to_tool"):
        row[key.replace("_", " ")] = with_paper(f"{train[key]:.4g}", key)
    row["cosine"] = with_paper(f"{cosine['mean']:.2f}", "cosine")
    row["least to largest"] = f"{cosine['min']:.2f} to {cosine['max']:.2f}"
    row["mass (kg)"] = f"{train['mass']['mean']:.3g}"
    row["reach (m)"] = f"{train['reach']['min']:.2f} to {train['reach']['max']:.2f}"
    return row


split = Command(
    "split",
    "list, make, audit, build, release and score splits of train and test robots",
    commands=(*(list_splits, show, new, audit, build, verify, stats, difficulty, release, score),),
    details="A split is a YAML file with the robots to train on and those to test on.",
)
