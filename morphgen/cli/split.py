"""``morphgen split``: make, audit, build, release and score splits of train and test robots."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from typing import Any

from morphgen.api.splits import DEFAULT_TRAIN, NewSplit
from morphgen.api.splits import goals as sample_goals
from morphgen.api.splits import split as open_split
from morphgen.benchmark import release as releases
from morphgen.benchmark import split_folder
from morphgen.benchmark.scores import results as scores
from morphgen.benchmark.scores.submission import (
    DEFAULT_EPISODES,
    EvalProtocol,
    Submission,
    check_submission,
    expected_robots,
    protocol_from,
    read_submission,
    read_submissions,
    require_same_random,
    tasks_of_split,
)
from morphgen.benchmark.survey import Audit, statistics
from morphgen.cli import options as opt
from morphgen.cli.progress import bar, status
from morphgen.encoding.similarity import MEASURES
from morphgen.errors import BenchmarkError
from morphgen.formats.files import require_writable_folder
from morphgen.model.findings import Finding
from morphgen.rl.scores import POWER
from morphgen.splits.split import (
    HOLD_OUT,
    SIDES,
    Split,
    read_split,
    split_id,
    split_names,
    split_paths,
    write_new_splits,
)
from morphgen.tables import table
from morphgen.tasks.registry import DEFAULT_SIMULATOR, TASKS
from morphgen.tasks.scenes.env_specs import GoalConfig
from morphgen.tasks.split_goals import GoalResult, sample_split_goals


def goals(args: argparse.Namespace) -> int:
    """Sample goal sets and print a table with the failures."""
    with bar(args, "sampling goals"):
        sets = sample_goals(" ".join(args.words), **opt.arguments(args, sample_goals))
    opt.print_result(args, sets.as_dict(), lambda: str(sets))
    return int(not sets.passed)


MAX_LISTED = 10  # largest number of findings of one code, or of differences, that are printed


def audit(args: argparse.Namespace) -> int:
    """Audit a split and print the findings."""
    split = open_split(args.split, library=args.library)
    with bar(args, "auditing"):
        result = split.audit(jobs=args.jobs)
    passed = result.passed(strict=args.strict)
    data = {**result.as_dict(), "passed": passed}
    opt.print_result(args, data, lambda: _audit_text(result, passed))
    return int(not passed)


def _audit_text(result: Audit, passed: bool) -> str:
    rows = [
        (test, *(f"{found.train} {found.value:.3f}" for found in trains.values()))
        for test, trains in result.nearest.items()
    ]
    headers = ("test robot", *(f"nearest by {name}" for name in MEASURES))
    lines = [table(rows, headers)] if rows else []
    reasons = {finding.code: reason for finding, reason in result.accepted}
    for code, findings in _by_code(result.findings).items():
        lines.append(f"{findings[0].severity} {code} ({len(findings)})")
        lines += [*_listed(findings), f"    fix: {findings[0].fix}"]
    for code, findings in _by_code([finding for finding, _ in result.accepted]).items():
        lines.append(f"accepted {code} ({len(findings)}): {reasons[code]}")
        lines += _listed(findings)
    counts = opt.severity_counts(result.findings, ("error", "warning"))
    verdict = "passed" if passed else "FAILED"
    lines.append(f"{result.split}: {verdict}: {counts}, {len(result.accepted)} accepted")
    return "\n".join(lines)


def _by_code(findings: Sequence[Finding]) -> dict[str, list[Finding]]:
    """Return the findings of each code, in the order of the first of each."""
    codes = dict.fromkeys(finding.code for finding in findings)
    return {code: [each for each in findings if each.code == code] for code in codes}


def _listed(findings: Sequence[Finding | split_folder.Difference]) -> list[str]:
    """Return a line per finding, and how many more there are."""
    more = len(findings) - MAX_LISTED
    lines = [f"  {finding.where}: {finding.why}" for finding in findings[:MAX_LISTED]]
    return [*lines, *([f"  and {more} more (--json lists all)"] if more > 0 else [])]


def build(args: argparse.Namespace) -> None:
    """Build a split and print where it is."""
    split, config = read_split(args.split), GoalConfig(args.goal_seed or 0)
    library, goals = opt.library_of(args), list[GoalResult]()
    if args.goals:
        with bar(args, "sampling goals"):
            goals = sample_split_goals(split, library, config, jobs=args.jobs)
    with bar(args, "building"):
        report = releases.build_with_goals(split, args.out, library, goals, config, jobs=args.jobs)
    written, kept = report.num_written, report.num_kept
    data: dict[str, object] = {"folder": str(report.folder), "made": written, "kept": kept}
    lines = [f"{report.folder}: {written} robots written, {kept} already existed"]
    if args.goals:
        data["goals"] = len(goals)
        lines.append(f"{len(goals)} goal sets, seed {config.seed}")
    lines.append(f"verify it anywhere: morphgen split verify {report.folder}")
    opt.print_result(args, data, lambda: "\n".join(lines))


def verify(args: argparse.Namespace) -> int:
    """Verify a split and print what differs."""
    with bar(args, "verifying"):
        result = releases.verify(args.path, opt.library_of(args), jobs=args.jobs)
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


def stats(args: argparse.Namespace) -> None:
    """Print a table with a row per set of robots, which the splits of a folder may share."""
    library = opt.library_of(args)
    groups: dict[object, list[Split]] = {}
    for split in map(read_split, args.splits or split_names()):
        # The robots are compared in their order.
        hashes = [tuple(member.robot_hash for member in split.side(side)) for side in SIDES]
        groups.setdefault((split.name.rpartition("/")[0], *hashes), []).append(split)
    data: list[dict[str, Any]] = []
    for splits in groups.values():
        names = [split.name for split in splits]
        title = names[0].rpartition("/")[0] if names[1:] else names[0]
        with bar(args, title):
            found = statistics(splits[0], library, jobs=args.jobs)
        data.append({"robots": title or names[0], "splits": names, "statistics": found})

    def text() -> str:
        rows = [_stats_row(each["robots"], each["statistics"]) for each in data]
        means = "links, joints, mass: mean over the train robots; cosine: of test and train robots"
        return f"{table([list(row.values()) for row in rows], list(rows[0]))}\n\n{means}"

    opt.print_result(args, {"rows": data}, text)


def _stats_row(title: str, statistics: Mapping[str, Any]) -> dict[str, str]:
    train, cosine = statistics["train"], statistics["cosine"]
    row = {"robots": title, "train": train["robots"], "test": statistics["test"]["robots"]}
    for key in ("links", "movable", "movable_to_tool"):
        row[key.replace("_", " ")] = f"{train[key]:.4g}"
    row["cosine"] = f"{cosine['mean']:.2f}"
    row["least to largest"] = f"{cosine['min']:.2f} to {cosine['max']:.2f}"
    row["mass (kg)"] = f"{train['mass']['mean']:.3g}"
    row["reach (m)"] = f"{train['reach']['min']:.2f} to {train['reach']['max']:.2f}"
    return row


def new(args: argparse.Namespace) -> None:
    """Choose the robots, write the splits and print what they are."""
    if args.subcommand is None and not args.hold_out:
        args.parser.error(
            "name what to hold out, such as --hold-out 'arm=kinova*', or a regime: interpolation, "
            "composition, extrapolation"
        )
    choice = opt.given(args, NewSplit.__annotations__)
    choice["regime"] = args.subcommand or HOLD_OUT
    train = (DEFAULT_TRAIN,) if args.train is None else args.train
    # Smaller splits are parts of the largest.
    with bar(args, "sampling", total=max(train, default=0) + args.test):
        loaded = open_split(args.name or "", train=train, library=args.library, **choice)
    splits = [each.definition for each in loaded]
    paths = split_paths(args.out, splits)
    write_new_splits(splits, paths)
    data = [
        {
            "file": str(path),
            "name": split.name,
            "id": split_id(split),
            "train": len(split.train),
            "test": len(split.test),
        }
        for split, path in zip(splits, paths, strict=True)
    ]
    lines = [line for pair in zip(splits, paths, strict=True) for line in _summary(*pair)]
    folders = [word for folder in args.library for word in ("--library", str(folder))]
    lines.append(f"next: {shlex.join(['morphgen', 'split', 'audit', str(paths[-1]), *folders])}")
    opt.print_result(args, data, lambda: "\n".join(lines))


def _summary(split: Split, path: Path) -> list[str]:
    lines = [
        f"{path}: {split.summary}",
        f"  test: {', '.join(member.name for member in split.test)}",
    ]
    if isinstance(left_out := split.provenance.get("left_out"), Mapping):
        reasons = ", ".join(f"{count} with {reason}" for reason, count in left_out.items())
        lines.append(f"  robots that were left out: {reasons}")
    return lines


def release(args: argparse.Namespace) -> None:
    """Make a release and print where it is."""
    require_writable_folder(args.out)  # before the audit and the goals, which take minutes
    split, library = read_split(args.split), opt.library_of(args)
    protocol = EvalProtocol(args.sim or DEFAULT_SIMULATOR, args.episodes or DEFAULT_EPISODES)
    extra: dict[str, bytes] = {}
    if args.scores:
        with bar(args, "checking the scores"):
            references = scores.collect_references(
                args.scores, split, protocol, library, jobs=args.jobs
            )
        extra = scores.reference_files(references)
    request = releases.ReleaseRequest(
        version=args.release_version,
        date=args.date,
        creators=tuple(args.creator),
        url=args.url,
        allowed_licences=tuple(
            word for text in args.licence_allow for word in text.split(",") if word
        ),
        protocol=protocol,
        goals=not args.no_goals,
    )
    with bar(args, "checking"):
        checked = releases.check_release(split, library, request, jobs=args.jobs)
    archive = args.out / f"{checked[0].stem}.zip"
    notes = _notes(args, archive, split, extra)
    if not args.json:
        print("".join(f"note: {note}\n" for note in notes), end="", flush=True)
    if args.dry_run:
        text = f"{archive} would be written: names, licences and audit are in order"
        opt.print_result(args, {"archive": str(archive), "notes": notes}, lambda: text)
        return
    with bar(args, "releasing"):
        report = releases.release_split(
            split, args.out, library, request, extra=extra, jobs=args.jobs, checked=checked
        )
    lines = [
        f"{report.archive}: {report.files} files, {report.bytes / 1e6:.2f} MB",
        f"  sha256: {report.sha256}",
        f"  content: {report.content}",
        f"verify it anywhere: morphgen split verify {report.archive}",
    ]
    opt.print_result(args, {**vars(report), "notes": notes}, lambda: "\n".join(lines))


def _notes(
    args: argparse.Namespace, archive: Path, split: Split, extra: Mapping[str, bytes]
) -> list[str]:
    """Return what the release lacks that its users may expect, and what may keep it from it."""
    notes = []
    if archive.exists():
        notes.append(f"{archive} exists: it stays, unless the content is the same")
    is_relative = any(TASKS[task].relative_to_random for task in tasks_of_split(split))
    if is_relative and f"{releases.SUBMISSIONS_DIR}/random.json" not in extra:
        missing = "submission of random among --scores" if extra else "reference scores"
        notes.append(
            f"no {missing}: split score cannot check the random_score of submissions; add one of "
            "morphgen eval random --submission with --scores"
        )
    elif not extra:
        notes.append("no reference scores: add submissions or studies with --scores")
    if not args.date:
        notes.append("no --date: dataset tools recommend a date of publication")
    if not args.creator:
        notes.append("no --creator: the citation will name nobody")
    return notes


def score(args: argparse.Namespace) -> int:
    """Score submissions, run episodes again if asked to, and print the ranking."""
    submissions = [read_submission(path) for path in args.submissions]
    library = opt.library_of(args)
    name = args.split or submissions[0].split.name
    if not args.split and name not in split_names():  # a submission cannot name other files
        raise BenchmarkError(
            f"{args.submissions[0]}: split.name: {name} is not a split that comes with morphgen; "
            "name its release or file with --split"
        )
    with ExitStack() as stack:
        split, protocol, references, version = _open(name, stack)
    with bar(args, "composing robots"):
        expected = expected_robots(split, protocol, library, jobs=args.jobs)
    named = [
        *((f"{name}: reference {each.method}", each) for each in references.submissions),
        *zip(map(str, args.submissions), submissions, strict=True),
    ]
    for where, submission in named:
        check_submission(submission, where, split, protocol, expected, version)
    random = references.random
    tasks = sorted({each.member.task for each in expected})
    relative = [task for task in tasks if TASKS[task].relative_to_random]
    warnings = []
    if relative and random is None:  # edited scores of random would lift all others
        require_same_random(named)
        warnings.append(
            "random_score was not checked: there is no reference submission of random, so that an "
            f"edited random_score changes a score of {' and '.join(relative)}; rank submissions in "
            "a release that has one (split release --scores)"
        )
    with status(args, "scoring"):
        own = dict(zip(map(str, args.submissions), submissions, strict=True))
        rows = scores.ranked([*scores.scored_rows(own, random), *references.rows()])
    smallest, lowest = scores.smallest_differences(rows), scores.floor([each for _, each in named])
    data: dict[str, Any] = {
        "split": split.name,
        "random": "release" if random else "submission",
        "warnings": warnings,
        "rows": scores.rows_data(rows),
        "smallest_differences": smallest,
        "floor": lowest,
    }
    replays = _replays(args, submissions, split) if args.replay else []
    if args.replay:
        data["replays"] = [{"episode": line, "agrees": agrees} for line, agrees in replays]
    notes = [scores.NOTE, *map(_smallest_text, smallest)]
    for task, rates in lowest.items():
        names = ", ".join(f"{name} {rate:.0%}" for name, rate in rates.items())
        notes.append(f"floor of success of {task} (ZS): {names}")
    if relative:
        whose = "the release" if random else "each submission"
        notes.append(
            f"scores of {' and '.join(relative)} are relative to the random policy, by the "
            f"episodes of {whose}"
        )
    notes += [f"warning: {text}" for text in warnings]
    notes += [line for line, _ in replays]
    style = "github" if args.markdown else "simple"
    opt.print_result(args, data, lambda: "\n".join([scores.result_tables(rows, style), *notes]))
    return int(not all(agrees for _, agrees in replays))


def _replays(
    args: argparse.Namespace, submissions: Sequence[Submission], split: Split
) -> list[tuple[str, bool]]:
    """Run episodes of submissions again; return a line for each, and whether it agrees."""
    # Other commands of splits need no torch.
    from morphgen.benchmark.scores.study import needs_checkpoint, replay_submission

    named = list(zip(args.submissions, submissions, strict=True))
    unnamed = [path for path, each in named if needs_checkpoint(each)]
    if len(unnamed) != (args.checkpoint is not None):
        files = ", ".join(map(str, unnamed)) or "none"
        raise BenchmarkError(
            f"--replay: submissions of policies that do not come with morphgen: {files}; expected "
            "one with --checkpoint RUN, or none without it"
        )
    found = []
    for path, each in named:
        checkpoint = args.checkpoint if path in unnamed else None
        with bar(args, f"running episodes of {path} again", "episode"):
            for episode in replay_submission(
                each,
                str(path),
                split,
                count=args.replay,
                seed=args.seed,
                checkpoint=checkpoint,
                library=tuple(args.library),
            ):
                found.append((f"{path}: {episode}", episode.agrees))
    return found


def _smallest_text(values: Mapping[str, Any]) -> str:
    score = f", {values['score']:.3g} of scores" if values["score"] is not None else ""
    return (
        f"smallest difference of {values['task']} (ZS) that shows with {POWER:.0%} power: "
        f"{values['success']:.1%} of success around 50% in {values['episodes']} episodes{score}"
    )


def _open(name: str, stack: ExitStack) -> tuple[Split, EvalProtocol, scores.References, str]:
    """Return a split, its rules, reference scores, and the version of morphgen they are of."""
    path = Path(name)
    if not path.is_dir() and not split_folder.is_archive(path):
        return read_split(name), EvalProtocol(), scores.References(), version("morphgen")
    folder = stack.enter_context(releases.opened_folder(path))
    split_folder.require_unchanged(folder, name)
    split = read_split(folder / split_folder.SPLIT_FILE)
    if not releases.is_release(folder):
        return split, EvalProtocol(), scores.References(), version("morphgen")
    release = releases.read_release(folder)
    protocol = protocol_from(release.evaluation, name)
    return split, protocol, scores.read_references(folder), release.morphgen


MODES = ("deterministic", "stochastic", "all")


def tables(args: argparse.Namespace) -> None:
    """Print a table for every split and task."""
    with status(args, "reading the episodes"):
        submissions = read_submissions(args.files)
    modes = {"", args.mode} if args.mode != "all" else {each.mode for each in submissions.values()}
    found = {where: each for where, each in submissions.items() if each.mode in modes}
    if not found:
        raise BenchmarkError(
            f"--mode {args.mode}: none of the {len(submissions)} submissions acts so; expected "
            f"--mode {' or '.join(mode for mode in MODES if mode != args.mode)}"
        )
    with status(args, "scoring"):
        rows = scores.result_rows(found)
    style = "github" if args.markdown else "simple"
    opt.print_result(
        args, scores.rows_data(rows), lambda: f"{scores.result_tables(rows, style)}\n{scores.NOTE}"
    )
