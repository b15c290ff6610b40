"""``morphgen split release`` and ``score``: publish a split, and rank submissions to it."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli import options as opt
from morphgen.cli.command import command, flag, number, option, repeated
from morphgen.cli.progress import bar
from morphgen.errors import BenchmarkError
from morphgen.tasks.registry import TASKS

if TYPE_CHECKING:
    from morphgen.benchmark.eval_protocol import EvalProtocol
    from morphgen.benchmark.scores.results import References
    from morphgen.benchmark.survey import BaselineResults
    from morphgen.splits.split import Split


@command(
    "release",
    "write an archive of a split that others can verify, cite and score against",
    option("split SPLIT", "name of a split, or its file"),
    # `morphgen --version` has the other name
    option("--version X.Y.Z", "version of the release", dest="release_version", default="1.0.0"),
    option("--out DIR", "folder of the archive", Path, default=Path("releases")),
    option("--date YYYY-MM-DD", "date of publication, which dataset tools recommend", default=""),
    repeated("--creator NAME", "who publishes the release"),
    option("--url", "address where the release will be", default=""),
    repeated(
        "--licence-allow LICENCE,...",
        "licences with restrictions that parts may have, such as CC-BY-NC-ND-4.0",
    ),
    option(
        "--scores PATH",
        "reference scores: submissions (morphgen eval --submission), or folders of studies",
        Path,
        nargs="+",
        default=[],
    ),
    opt.sim_option(),
    number("--episodes", "least number of episodes per robot of a submission (default: 34)"),
    flag("--light", "write the URDF and the derivation of robots only, without meshes"),
    flag("--no-goals", "ship no goal sets"),
    *opt.JOBS_LIBRARY_JSON,
    details="The archive holds the built split, goal sets, licences of all parts, a Croissant "
    "description, a dataset card, the difficulty of every robot, reference scores and SHA-256 of "
    "every file. A split that fails "
    "its audit, or with a part under a non-commercial, no-derivatives or unknown licence that is "
    "not allowed, is refused. The same inputs give the same bytes.",
    examples=(
        "split release interpolation/arm3/reach --version 1.0.0 --date 2027-01-31",
        "split release extrapolation/arms/reach --licence-allow CC-BY-NC-ND-4.0",
    ),
)
def release(args: argparse.Namespace) -> None:
    """Make a release and print where it is."""
    from morphgen.benchmark.eval_protocol import EPISODES, SIMULATOR, EvalProtocol
    from morphgen.benchmark.release import ReleaseRequest, release_split
    from morphgen.benchmark.split_folder import BuildSettings
    from morphgen.formats.files import require_writable_folder
    from morphgen.splits.split_file import read_split

    require_writable_folder(args.out)  # before the audit and the goals, which take minutes
    split, library = read_split(args.split), opt.library_of(args)
    protocol = EvalProtocol(args.sim or SIMULATOR, args.episodes or EPISODES)
    extra: dict[str, bytes] = {}
    results: BaselineResults = {}
    if args.scores:
        from morphgen.benchmark.scores.results import collect_references, reference_files

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
    with bar(args, "releasing"):
        report = release_split(
            split, args.out, library, request, extra=extra, results=results, jobs=args.jobs
        )
    notes = _notes(args, split, extra)
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
    lines += [f"  note: {note}" for note in notes]
    lines.append(f"verify it anywhere: morphgen split verify {report.archive}")
    opt.print_result(args, data, lambda: "\n".join(lines))


def _notes(args: argparse.Namespace, split: Split, extra: Mapping[str, bytes]) -> list[str]:
    """Return what the release lacks that its users may expect."""
    from morphgen.benchmark.eval_protocol import tasks_of_split
    from morphgen.benchmark.release import SUBMISSIONS_DIR

    notes = []
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
    return notes


@command(
    "score",
    "check submissions to a split, compute their scores and rank them",
    option("submissions SUBMISSION", "file that morphgen eval --submission wrote", Path, nargs="+"),
    option(
        "--split SPLIT",
        "archive or folder of a release, or name or file of a split (default: the split of "
        "morphgen that the first submission names)",
    ),
    flag("--markdown", "print the table as Markdown"),
    *opt.JOBS_LIBRARY_JSON,
    details="Every episode of every test robot must be there, with the goals, simulator and "
    "constants of the release. Scores and 95% intervals are computed from the episodes: bootstrap "
    "for scores, Wilson for successes. They are ranked beside the reference scores of the release. "
    "A submission with a fault is refused with one line, and nothing is ranked; so is a release "
    "whose files differ from its SHA256SUMS, and so are submissions that disagree about the random "
    "policy, if the release has no submission of it.",
    examples=("split score mine.json --split releases/interpolation-arm3-reach-1.0.0.zip",),
)
def score(args: argparse.Namespace) -> None:
    """Score submissions and print the ranking."""
    from morphgen.benchmark.eval_protocol import expected_robots
    from morphgen.benchmark.scores.results import (
        ranked,
        ranking_data,
        ranking_table,
        score_submission,
    )
    from morphgen.benchmark.scores.submission import (
        check_submission,
        read_submission,
        require_same_random,
    )

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
    from morphgen.splits.split_file import split_names

    if name not in split_names():
        raise BenchmarkError(
            f"{where}: split.name: {name} is not a split that comes with morphgen; name its "
            "release or file with --split"
        )
    return name


def _open(name: str, stack: ExitStack) -> tuple[Split, EvalProtocol, References, str]:
    """Return a split, its rules, reference scores, and the version of morphgen they are of."""
    from importlib.metadata import version

    from morphgen.benchmark.eval_protocol import EvalProtocol, protocol_from
    from morphgen.benchmark.release import is_release, opened_folder, read_release
    from morphgen.benchmark.scores.results import References, read_references
    from morphgen.benchmark.split_folder import SPLIT_FILE, is_archive
    from morphgen.benchmark.verify import require_unchanged
    from morphgen.splits.split_file import read_split

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
