"""Make a release of a split: its folder with goal sets, licences, scores and descriptions, zipped.

See ``morphgen.benchmark.release`` for the files. The same inputs give the same bytes.
"""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from morphgen.benchmark.audit import Audit, audit_survey
from morphgen.benchmark.eval_protocol import EvalProtocol
from morphgen.benchmark.licences import licence_ids, licenced_parts, require_allowed
from morphgen.benchmark.release import (
    CROISSANT_FILE,
    DIFFICULTY_FILE,
    LICENCES_FILE,
    LICENCES_TEXT,
    RELEASE_FILE,
    Release,
    card_text,
    croissant_text,
    licences_json,
    licences_text,
    release_text,
)
from morphgen.benchmark.split_folder import (
    BUNDLED,
    README_FILE,
    SUMS_FILE,
    BuildReport,
    BuildSettings,
    build_split,
    read_sums,
    split_folder_path,
    sums_text,
    writing_split,
)
from morphgen.benchmark.survey import (
    DIGITS,
    BaselineResults,
    SplitSurvey,
    difficulty_csv,
    summarize_survey,
    survey_difficulty,
    survey_split,
)
from morphgen.errors import BenchmarkError
from morphgen.formats.files import (
    file_sha256,
    locked_folder,
    replacing_folder,
    write_atomic,
    writing,
)
from morphgen.formats.records import read_record
from morphgen.formats.zip_files import write_zip
from morphgen.grammar.library import Library
from morphgen.splits.split import Split, split_id
from morphgen.tasks.goals.split_goals import (
    GOALS,
    GoalResult,
    goal_files,
    has_goals,
    require_goal_sets,
    sample_split_goals,
)
from morphgen.tasks.scenes.env_specs import GoalConfig


def build_with_goals(
    split: Split,
    folder: Path,
    library: Library,
    settings: BuildSettings,
    goals: Sequence[GoalResult] = (),
    config: GoalConfig | None = None,
    *,
    jobs: int = 1,
) -> BuildReport:
    """Write a split, all its robots and, if there are any, its goal sets; see ``build_split``."""
    require_goal_sets(goals)
    built = split_folder_path(split, folder)
    if not goals and built.is_dir() and has_goals(built):
        raise BenchmarkError(
            f"{built} was built with goals: ask for goals (--goals), delete {built / GOALS}, or "
            "name another folder"
        )
    report = build_split(split, folder, library, jobs=jobs, settings=settings)
    if goals:
        write_goals(report.folder, goals, config or GoalConfig())
    return report


def write_goals(home: Path, results: Sequence[GoalResult], config: GoalConfig) -> Path:
    """Write the goal sets of a split into the folder where it is built; return their folder.

    The checksums of the split are updated, and earlier sets replaced.
    """
    require_goal_sets(results)
    folder = home / GOALS
    files = dict(goal_files(results, config))
    read_sums(home / SUMS_FILE)  # refuses a folder that is not built, before anything is locked
    with writing_split(home), locked_folder(home):
        sums = read_sums(home / SUMS_FILE)
        (home / SUMS_FILE).unlink()  # until all is written, the build is not finished
        for leftover in home.glob(f".{GOALS}.*"):
            shutil.rmtree(leftover, ignore_errors=True)
        with replacing_folder(folder) as partial:
            for name, content in files.items():
                (partial / name).parent.mkdir(exist_ok=True)
                (partial / name).write_bytes(content)
        sums = {k: digest for k, digest in sums.items() if not k.startswith(f"{GOALS}/")}
        sums |= {
            f"{GOALS}/{name}": hashlib.sha256(content).hexdigest()
            for name, content in files.items()
        }
        write_atomic(home / SUMS_FILE, sums_text(sums))
    return folder


@dataclass(frozen=True)
class ReleaseRequest:
    """Request for a release."""

    version: str  # such as `1.0.0`
    date: str = ""  # date of publication, such as `2027-01-31`
    creators: tuple[str, ...] = ()
    url: str = ""  # address where the release will be
    allowed_licences: tuple[str, ...] = ()  # licences with restrictions that parts may have
    protocol: EvalProtocol = field(default_factory=EvalProtocol)  # rules of the evaluation
    goals: bool = True  # ship the goal set of every robot
    settings: BuildSettings = BUNDLED  # settings of the build


@dataclass(frozen=True)
class ReleaseReport:
    """Result of a release."""

    archive: Path
    sha256: str  # SHA-256 of the archive, hexadecimal
    content: str
    """SHA-256 of ``SHA256SUMS``: the same for the same files, however they are compressed."""
    files: int  # number of files in the archive
    size: int  # size of the archive [bytes]
    release: Release


def release_split(
    split: Split,
    out: Path,
    library: Library,
    request: ReleaseRequest,
    *,
    extra: Mapping[str, bytes] | None = None,
    results: BaselineResults | None = None,
    jobs: int = 1,
) -> ReleaseReport:
    """Write the archive of a release into a folder."""
    parts = licenced_parts(split, library)
    require_allowed(split, parts, request.allowed_licences)
    release = _release(split, request, {})
    survey = survey_split(split, library, pairs="train", jobs=jobs)
    audited = audit_survey(survey, library)
    require_passed(audited)
    rows = survey_difficulty(survey, results)
    release = _release(split, request, _difficulty(survey, audited))
    goals: list[GoalResult] = []
    if request.goals:
        goals = sample_split_goals(split, library, request.protocol.goals, jobs=jobs)
        require_goal_sets(goals)
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".release-", dir=out) as temporary:
        report = build_with_goals(
            split,
            Path(temporary),
            library,
            request.settings,
            goals,
            request.protocol.goals,
            jobs=jobs,
        )
        texts = {
            RELEASE_FILE: release_text(release),
            LICENCES_FILE: licences_json(parts),
            LICENCES_TEXT: licences_text(parts),
            DIFFICULTY_FILE: difficulty_csv(rows, tuple(results or ())),
        }
        files = {name: text.encode() for name, text in texts.items()} | dict(extra or {})
        known = [*read_sums(report.folder / SUMS_FILE), *files]
        files[README_FILE] = card_text(split, release, parts, known, rows).encode()
        _add_files(report.folder, files)
        sums = read_sums(report.folder / SUMS_FILE)
        croissant = croissant_text(split, release, licence_ids(parts), sums)
        _add_files(report.folder, {CROISSANT_FILE: croissant.encode()})
        return _write_archive(report.folder, out, release)


def require_passed(result: Audit) -> None:
    """Require that a split has passed its audit."""
    if not result.passed():
        first = next(each for each in result.findings if each.severity == "error")
        raise BenchmarkError(
            f"{result.split} fails its audit: {first.code} at {first.where}: {first.why}; see "
            "morphgen split audit"
        )


def _release(split: Split, request: ReleaseRequest, difficulty: Mapping[str, Any]) -> Release:
    data = {
        "name": split.name,
        "id": split_id(split),
        "version": request.version,
        "morphgen": version("morphgen"),
        "date": request.date,
        "creators": list(request.creators),
        "url": request.url,
        "evaluation": request.protocol.as_data(split),
        "difficulty": dict(difficulty),
    }
    return read_record(data, Release, "release", BenchmarkError)


def _difficulty(survey: SplitSurvey, audited: Audit) -> dict[str, Any]:
    """Return the similarity of test and train robots as JSON data."""
    nearest: dict[str, dict[str, object]] = {}
    for neighbour in audited.neighbours:
        nearest.setdefault(neighbour.test, {})[neighbour.measure] = {
            "train": neighbour.train,
            "value": round(neighbour.value, DIGITS),
        }
    return {"cosine": summarize_survey(survey)["cosine"], "nearest": nearest}


def _add_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files into a split folder and list them in its checksums."""
    sums = read_sums(folder / SUMS_FILE)
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_atomic(folder / name, content)
        sums[name] = hashlib.sha256(content).hexdigest()
    write_atomic(folder / SUMS_FILE, sums_text(sums))


def _write_archive(folder: Path, out: Path, release: Release) -> ReleaseReport:
    """Zip a folder; an archive of this version with another content is kept and refused."""
    names = [*read_sums(folder / SUMS_FILE), SUMS_FILE]
    files = {f"{release.stem}/{name}": folder / name for name in names}
    made, archive = folder.parent / "archive.zip", out / f"{release.stem}.zip"
    write_zip(made, files)
    digest = file_sha256(made)
    if archive.is_file() and file_sha256(archive) != digest:
        raise BenchmarkError(
            f"{archive} exists with another content; a release does not change: name another "
            "--version or --out"
        )
    with writing(archive):
        made.replace(archive)
    content = file_sha256(folder / SUMS_FILE)
    return ReleaseReport(archive, digest, content, len(files), archive.stat().st_size, release)
