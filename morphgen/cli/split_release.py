"""``morphgen split release`` and ``score``: publish a split, and rank submissions to it."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path

from morphgen.benchmark.eval_protocol import (
    EPISODES,
    SIMULATOR,
    EvalProtocol,
    expected_robots,
    protocol_from,
    tasks_of_split,
)
from morphgen.benchmark.release import (
    SUBMISSIONS_DIR,
    ReleaseRequest,
    archive_path,
    check_release,
    is_release,
    opened_folder,
    read_release,
    release_split,
    require_releasable,
)
from morphgen.benchmark.scores.results import (
    NOTE,
    References,
    collect_references,
    ranked,
    ranking_data,
    ranking_table,
    read_references,
    reference_files,
    result_rows,
    result_tables,
    rows_data,
    score_submission,
)
from morphgen.benchmark.scores.submission import (
    check_submission,
    read_submission,
    read_submissions,
    require_same_random,
)
from morphgen.benchmark.split_folder import SPLIT_FILE, BuildSettings, is_archive, require_unchanged
from morphgen.benchmark.survey import BaselineResults
from morphgen.cli import options as opt
from morphgen.cli.progress import bar, status
from morphgen.errors import BenchmarkError
from morphgen.formats.files import require_writable_folder
from morphgen.splits.split import Split
from morphgen.splits.split_file import read_split, split_names
from morphgen.tasks.registry import TASKS


def release(args: argparse.Namespace) -> None:
    """Make a release and print where it is."""
    require_writable_folder(args.out)  # before the audit and the goals, which take minutes
    split, library = read_split(args.split), opt.library_of(args)
    protocol = EvalProtocol(args.sim or SIMULATOR, args.episodes or EPISODES)
    extra: dict[str, bytes] = {}
    results: BaselineResults = {}
    if args.scores:
        with bar(args, "checking the scores"):
            references = collect_references(args.scores, split, protocol, library, jobs=args.jobs)
        extra, results = reference_files(references), references.results()
    request = ReleaseRequest(
        version=args.release_version,
        date=args.date,
        creators=tuple(args.creator),
        url=args.url,
        allowed_licences=tuple(
            word for text in args.licence_allow for word in text.split(",") if word
        ),
        protocol=protocol,
        goals=not args.no_goals,
        settings=BuildSettings(light=args.light),
    )
    require_releasable(split, library, request)
    notes = _notes(args, split, extra)
    if not args.json:
        print("".join(f"note: {note}\n" for note in notes), end="", flush=True)
    archive = archive_path(args.out, split, request.version)
    if args.dry_run:
        with bar(args, "checking"):
            check_release(split, library, request, jobs=args.jobs)
        data: dict[str, object] = {"archive": str(archive), "notes": notes}
        text = f"{archive} would be written: names, licences and audit are in order"
        opt.print_result(args, data, lambda: text)
        return
    with bar(args, "releasing"):
        report = release_split(
            split, args.out, library, request, extra=extra, results=results, jobs=args.jobs
        )
    data = {
        "archive": str(report.archive),
        "sha256": report.sha256,
        "content": report.content,
        "files": report.files,
        "bytes": report.size,
        "notes": notes,
    }
    lines = [
        f"{report.archive}: {report.files} files, {report.size / 1e6:.2f} MB",
        f"  sha256: {report.sha256}",
        f"  content: {report.content}",
    ]
    lines.append(f"verify it anywhere: morphgen split verify {report.archive}")
    opt.print_result(args, data, lambda: "\n".join(lines))


def _notes(args: argparse.Namespace, split: Split, extra: Mapping[str, bytes]) -> list[str]:
    """Return what the release lacks that its users may expect, and what may keep it from it."""
    notes = []
    archive = archive_path(args.out, split, args.release_version)
    if archive.exists():
        notes.append(f"{archive} exists: it stays, unless the content is the same")
    is_relative = any(TASKS[task].relative_to_random for task in tasks_of_split(split))
    if is_relative and f"{SUBMISSIONS_DIR}/random.json" not in extra:
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


def score(args: argparse.Namespace) -> None:
    """Score submissions and print the ranking."""
    submissions = [read_submission(path) for path in args.submissions]
    library = opt.library_of(args)
    name = args.split or _shipped_split(submissions[0].split.name, args.submissions[0])
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
        rows = [score_submission(each, random) for each in submissions] + references.rows()
    data = {
        "split": split.name,
        "random": "release" if random else "submission",
        "warnings": warnings,
        "rows": ranking_data(ranked(rows)),
    }
    notes = [
        "MT: train robots, ZS: test robots; 95%: bootstrap over the episodes of each robot; "
        "successes: Wilson"
    ]
    if relative:
        whose = "the release" if random else "each submission"
        notes.append(
            f"scores of {' and '.join(relative)} are relative to the random policy, by the "
            f"episodes of {whose}"
        )
    notes += [f"warning: {text}" for text in warnings]
    style = "github" if args.markdown else "simple"
    opt.print_result(args, data, lambda: "\n".join([ranking_table(rows, style), "", *notes]))


def _shipped_split(name: str, where: Path) -> str:
    """Return the name of a split that comes with morphgen; a submission cannot name other files."""
    if name not in split_names():
        raise BenchmarkError(
            f"{where}: split.name: {name} is not a split that comes with morphgen; name its "
            "release or file with --split"
        )
    return name


def _open(name: str, stack: ExitStack) -> tuple[Split, EvalProtocol, References, str]:
    """Return a split, its rules, reference scores, and the version of morphgen they are of."""
    path = Path(name)
    if not path.is_dir() and not is_archive(path):
        return read_split(name), EvalProtocol(), References(), version("morphgen")
    folder = stack.enter_context(opened_folder(path))
    require_unchanged(folder, name)
    split = read_split(folder / SPLIT_FILE)
    if not is_release(folder):
        return split, EvalProtocol(), References(), version("morphgen")
    release = read_release(folder)
    protocol = protocol_from(release.evaluation, name)
    return split, protocol, read_references(folder), release.morphgen


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
        rows = result_rows(found)
    style = "github" if args.markdown else "simple"
    opt.print_result(args, rows_data(rows), lambda: f"{result_tables(rows, style)}\n{NOTE}")
