"""``morphgen split score``: check submissions to a split and rank them."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli import options as opt
from morphgen.cli.command import command, flag, option
from morphgen.cli.progress import bar
from morphgen.tasks.registry import TASKS

if TYPE_CHECKING:
    from morphgen.benchmark.split import Split
    from morphgen.rl.reference_scores import References
    from morphgen.tasks.eval_protocol import EvalProtocol


@command(
    "score",
    "check submissions to a split, compute their scores and rank them",
    option(
        "submissions",
        nargs="+",
        type=Path,
        metavar="SUBMISSION",
        help="file that morphgen eval --submission wrote",
    ),
    option(
        "--split",
        metavar="SPLIT",
        help="archive or folder of a release, or name or file of a split (default: the split of "
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
    from morphgen.rl.leaderboard import (
        random_scores,
        ranking_data,
        ranking_table,
        score_submission,
    )
    from morphgen.rl.submission import read_submission
    from morphgen.rl.submission_checks import check_submission, require_same_random
    from morphgen.tasks.eval_protocol import expected_robots

    submissions = [read_submission(path) for path in args.submissions]
    library = opt.library_of(args)
    name = args.split or _shipped_split(submissions[0].split.name, args.submissions[0])
    with ExitStack() as stack:
        split, protocol, references, version = _open(name, stack)
    with bar(args, "composing robots") as update:
        expected = expected_robots(split, protocol, library, jobs=args.jobs, progress=update)
    named = [
        *((f"{name}: reference {each.method}", each) for each in references.submissions),
        *zip(map(str, args.submissions), submissions, strict=True),
    ]
    for where, submission in named:
        check_submission(submission, where, split, protocol, expected, version)
    random = random_scores(references.random) if references.random else None
    tasks = sorted({each.member.task for each in expected})
    relative = [task for task in tasks if TASKS[task].relative_to_random]
    warnings = []
    if relative and random is None:
        require_same_random(named)
        warnings.append(
            "random_score was not checked: there is no reference submission of random, so that an "
            f"edited random_score changes a score of {' and '.join(relative)}; rank submissions in "
            "a release that has one (split release --scores)"
        )
    rows = [score_submission(each, random) for each in submissions] + references.all_rows()
    data = {
        "split": split.name,
        "random": "release" if random else "submission",
        "warnings": warnings,
        "rows": ranking_data(rows),
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
    from morphgen.benchmark.split_file import split_names
    from morphgen.errors import BenchmarkError

    if name not in split_names():
        raise BenchmarkError(
            f"{where}: split.name: {name} is not a split that comes with morphgen; name its "
            "release or file with --split"
        )
    return name


def _open(name: str, stack: ExitStack) -> tuple[Split, EvalProtocol, References, str]:
    """Return a split, its rules, reference scores, and the version of morphgen they are of."""
    from importlib.metadata import version

    from morphgen.benchmark.release_file import (
        is_archive,
        is_release,
        opened_folder,
        read_release,
    )
    from morphgen.benchmark.split_file import read_split
    from morphgen.benchmark.split_folder import SPLIT_FILE
    from morphgen.benchmark.verify import require_unchanged
    from morphgen.rl.reference_scores import References, read_references
    from morphgen.tasks.eval_protocol import EvalProtocol, protocol_from

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
