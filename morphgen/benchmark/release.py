"""Releases: making, describing, reading and verifying them, and access to their archives.

A release is a split folder (see ``split_folder``) with further files:

release.json       version of the release, evaluation
licences.json      every part with its licence and robots
croissant.json     description of the dataset for tools (https://docs.mlcommons.org/croissant)
scores.json        reference scores, if there are any
submissions/       the reference submissions that the scores were computed from
goals/             goal sets, see ``morphgen.tasks.split_goals``

An archive is a zip of this folder. The same inputs give the same bytes.
"""

from __future__ import annotations

import datetime
import hashlib
import json
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec

from morphgen.benchmark import licences, read_text
from morphgen.benchmark.scores.submission import EvalProtocol, tasks_of_split
from morphgen.benchmark.split_folder import (
    README_FILE,
    ROBOTS_FILE,
    SPLIT_FILE,
    SUMS_FILE,
    BuildReport,
    Difference,
    build_split,
    compare_folder,
    compare_robots,
    is_archive,
    read_sums,
    require_split_folder,
    split_folder_path,
    sums_text,
    writing_split,
)
from morphgen.benchmark.survey import audit
from morphgen.errors import BenchmarkError, MorphgenError
from morphgen.files import file_sha256, write_atomic
from morphgen.formats.data_files import read_json
from morphgen.formats.files import locked_folder, writing
from morphgen.formats.records import Record, read_record
from morphgen.formats.zip_files import ZipLimits, unpack_zip, write_zip
from morphgen.grammar.library import Library
from morphgen.processes import parallel_map
from morphgen.progress import stage
from morphgen.splits.split import (
    Member,
    Side,
    Split,
    find_split,
    is_split_name,
    read_split_file,
    sided_members,
    split_id,
)
from morphgen.tasks.scenes.env_specs import GoalConfig, member_spec
from morphgen.tasks.split_goals import (
    GOALS,
    GoalResult,
    SplitGoals,
    certify_goal_set,
    goal_files,
    has_goals,
    read_split_goals,
    require_goal_sets,
    sample_split_goals,
)

RELEASE_FILE = "release.json"
SCORES_FILE = "scores.json"
SUBMISSIONS_DIR = "submissions"

FORMAT = 1
LIMITS = ZipLimits(max_bytes=4 * 2**30, max_files=100_000)
"""Bounds on an archive: a split of 1,000 robots with meshes has 2 GB and 20,000 files."""

_VERSION = re.compile(r"\d{1,6}\.\d{1,6}\.\d{1,6}(?:[-+.]?[0-9A-Za-z]{1,20})?", re.ASCII)
_DATE = re.compile(r"\d{4}-\d{2}-\d{2}", re.ASCII)
_URL = re.compile(r"https?://[^\s\"<>]{1,500}")


class Release(Record, frozen=True):
    """The content of ``release.json``."""

    name: str  # name of the split
    id: str  # id of the split, see `morphgen.splits.split.split_id`
    version: str  # version of the release, such as `1.0.0`
    morphgen: str  # version of morphgen that made it
    evaluation: dict[str, Any]
    """How submissions are evaluated, see ``morphgen.benchmark.scores.submission``."""
    format: int = FORMAT
    date: str = ""  # date of publication, such as `2027-01-31`; empty if it is not given
    creators: tuple[str, ...] = ()
    url: str = ""  # address of the release; empty if it is not given
    difficulty: dict[str, Any] = msgspec.field(default_factory=dict)
    """Similarity of test and train robots, in releases of version 0.3 and earlier."""

    def __post_init__(self) -> None:
        if self.format != FORMAT:
            raise ValueError(f"format {self.format}; this version reads {FORMAT}")
        if not is_split_name(self.name):
            raise ValueError(f"name {self.name!r}; expected the name of a split")
        if not _VERSION.fullmatch(self.version):
            raise ValueError(f"version {self.version!r}; expected one such as 1.0.0")
        if self.date and not _is_date(self.date):
            raise ValueError(f"date {self.date!r}; expected one such as 2027-01-31")
        for creator in self.creators:
            if not creator or not creator.isprintable():
                raise ValueError(f"creator {creator!r}; expected printable characters")
        if self.url and not _URL.fullmatch(self.url):
            raise ValueError(f"url {self.url!r}; expected an address such as https://example.org")

    @property
    def stem(self) -> str:
        """Name of the archive without its suffix, and of the folder in it."""
        return f"{self.name.replace('/', '-')}-{self.version}"


def _is_date(text: str) -> bool:
    """Return whether a text is a day of the calendar, such as ``2027-01-31``."""
    try:
        return bool(_DATE.fullmatch(text) and datetime.date.fromisoformat(text))
    except ValueError:
        return False


def is_release(folder: Path) -> bool:
    """Return whether a folder is a release."""
    return (folder / RELEASE_FILE).is_file()


def read_release(folder: Path) -> Release:
    """Read the description of a release."""
    path = folder / RELEASE_FILE
    if not is_release(folder):
        raise BenchmarkError(
            f"{folder} is no release: it has no {RELEASE_FILE}; morphgen split release makes one"
        )
    return read_record(read_json(path), Release, str(path), BenchmarkError)


@contextmanager
def opened_folder(path: Path) -> Iterator[Path]:
    """Yield a split folder: the one at a path, or that of an archive in a temporary folder."""
    if not is_archive(path):
        require_split_folder(path)
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="morphgen-") as temporary:
        unpack_zip(path, Path(temporary), LIMITS)
        folders = list(Path(temporary).iterdir())
        if len(folders) != 1 or not folders[0].is_dir():
            raise BenchmarkError(
                f"{path}: {len(folders)} files and folders at its top; expected the one folder of "
                "a release"
            )
        try:
            require_split_folder(folders[0])
        except BenchmarkError as error:
            raise BenchmarkError(f"{path}: {str(error).replace(temporary, '')}") from error
        yield folders[0]


def croissant_text(
    split: Split, release: Release, parts: Sequence[licences.LicencedPart], sums: Mapping[str, str]
) -> str:
    """Return the text of ``croissant.json``."""
    data = licences.croissant_head() | {
        "name": release.stem,
        "description": f"{split.summary}. A split of robots for cross-embodiment learning: "
        f"{len(split.train)} robots to train on, {len(split.test)} to test on.",
        "version": release.version,
        "license": licences.licence_addresses(parts),
        "citeAs": citation(split, release),
    }
    if release.date:
        data["datePublished"] = release.date
    if release.url:
        data["url"] = release.url
    if release.creators:
        people = [{"@type": "sc:Organization", "name": name} for name in release.creators]
        data["creator"] = people
    data |= licences.croissant_contents("release_croissant.json", sums)
    return json.dumps(data, indent=2, ensure_ascii=False) + "\n"


def citation(split: Split, release: Release) -> str:
    """Return the sentence to cite a release with."""
    who = f"{', '.join(release.creators)}: " if release.creators else ""
    year = f", {release.date[:4]}" if release.date else ""
    after = f"; after {split.reference}" if split.reference else ""
    where = f", {release.url}" if release.url else ""
    return (
        f"{who}{release.name}, version {release.version}{year}. A split of robots, id "
        f"{release.id}, made with morphgen {release.morphgen}{after}{where}"
    )


_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"))
"""Size categories of Hugging Face by their upper bound."""


def card_text(
    split: Split,
    release: Release,
    parts: Sequence[licences.LicencedPart],
    names: Iterable[str],
) -> str:
    """Return the dataset card; ``names`` are the paths of the files of the release."""
    present = {name.partition("/")[0] for name in names}
    # Every release has the other files of the table.
    absent = {"goals", SCORES_FILE, SUBMISSIONS_DIR} - present
    template = "".join(
        line
        for line in read_text("release_card.md").splitlines(keepends=True)
        if not line.startswith(tuple(f"| `{name}` |" for name in absent))
    )
    robots, tasks = len(split.train) + len(split.test), sorted(tasks_of_split(split))
    front = {
        "task_categories": ["robotics", "reinforcement-learning"],
        "tags": ["morphgen", "cross-embodiment", "croissant", split.regime, *tasks],
        "size_categories": [next((name for n, name in _SIZES if robots < n), "n>100K")],
        "configs": [
            {"config_name": "robots", "data_files": [{"split": "robots", "path": ROBOTS_FILE}]}
        ],
    }
    return licences.dataset_card(
        f"{release.name} {release.version}",
        parts,
        front,
        template,
        **release.evaluation,
        name=release.name,
        version=release.version,
        summary=split.summary or "(no summary)",
        regime=split.regime,
        train=len(split.train),
        test=len(split.test),
        morphgen=release.morphgen,
        id=release.id,
        folder=release.stem,
        citation=citation(split, release),
    )


def build_with_goals(
    split: Split,
    folder: Path,
    library: Library,
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
    report = build_split(split, folder, library, jobs=jobs)
    if goals:
        write_goals(report.folder, goals, config or GoalConfig())
    return report


def write_goals(home: Path, results: Sequence[GoalResult], config: GoalConfig) -> Path:
    """Write goal sets into a split's folder in place of earlier ones; return their folder."""
    files = {f"{GOALS}/{name}": content for name, content in goal_files(results, config)}
    with writing_split(home), locked_folder(home):
        sums = read_sums(home / SUMS_FILE)
        (home / SUMS_FILE).unlink()  # until all is written, the build is not finished
        if has_goals(home):
            shutil.rmtree(home / GOALS)
        others = {k: digest for k, digest in sums.items() if not k.startswith(f"{GOALS}/")}
        _add_files(home, files, others)
    return home / GOALS


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


@dataclass(frozen=True)
class ReleaseReport:
    """Result of a release."""

    archive: Path
    sha256: str  # SHA-256 of the archive, hexadecimal
    content: str
    """SHA-256 of ``SHA256SUMS``: the same for the same files, however they are compressed."""
    files: int  # number of files in the archive
    bytes: int  # size of the archive


def check_release(
    split: Split, library: Library, request: ReleaseRequest, *, jobs: int = 1
) -> tuple[Release, tuple[licences.LicencedPart, ...]]:
    """Require sound names, licences and audit; return the release's description and the parts."""
    parts = licences.licenced_parts(split, library)
    licences.require_allowed(split, parts, request.allowed_licences)
    release = _release(split, request)
    audited = audit(split, library, jobs=jobs)
    if not audited.passed():
        first = next(each for each in audited.findings if each.severity == "error")
        raise BenchmarkError(
            f"{split.name} fails its audit: {first.code} at {first.where}: {first.why}; see "
            "morphgen split audit"
        )
    return release, parts


def release_split(
    split: Split,
    out: Path,
    library: Library,
    request: ReleaseRequest,
    *,
    extra: Mapping[str, bytes] | None = None,
    jobs: int = 1,
    checked: tuple[Release, tuple[licences.LicencedPart, ...]] | None = None,
) -> ReleaseReport:
    """Write the archive of a release into a folder; ``checked`` is from ``check_release``."""
    release, parts = checked or check_release(split, library, request, jobs=jobs)
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
            goals,
            request.protocol.goals,
            jobs=jobs,
        )
        data = msgspec.to_builtins(release)
        data = {key: value for key, value in data.items() if value not in ("", [], (), {})}
        texts = {
            RELEASE_FILE: json.dumps({"format": release.format, **data}, indent=2) + "\n",
            licences.LICENCES_FILE: licences.licences_json(parts),
        }
        files = {name: text.encode() for name, text in texts.items()} | dict(extra or {})
        known = [*read_sums(report.folder / SUMS_FILE), *files]
        files[README_FILE] = card_text(split, release, parts, known).encode()
        _add_files(report.folder, files, read_sums(report.folder / SUMS_FILE))
        sums = read_sums(report.folder / SUMS_FILE)
        croissant = croissant_text(split, release, parts, sums)
        _add_files(report.folder, {licences.CROISSANT_FILE: croissant.encode()}, sums)
        return _write_archive(report.folder, out, release)


def _release(split: Split, request: ReleaseRequest) -> Release:
    data = {
        "name": split.name,
        "id": split_id(split),
        "version": request.version,
        "morphgen": version("morphgen"),
        "date": request.date,
        "creators": list(request.creators),
        "url": request.url,
        "evaluation": request.protocol.as_data(split),
    }
    return read_record(data, Release, "release", BenchmarkError)


def _add_files(folder: Path, files: Mapping[str, bytes], known: Mapping[str, str]) -> None:
    """Write files, and their hashes with those of the files that are there."""
    sums = dict(known)
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
    return ReleaseReport(archive, digest, content, len(files), archive.stat().st_size)


def _release_differences(folder: Path, split: Split, library: Library) -> Iterator[Difference]:
    """Yield what a release states otherwise than its split."""
    try:
        release = read_release(folder)
        if (release.name, release.id) != (split.name, split_id(split)):
            why = f"it is of split {release.name}, id {release.id}, not of {SPLIT_FILE}"
            yield Difference(RELEASE_FILE, why)
        expected = [part.as_dict() for part in licences.licenced_parts(split, library)]
        if _without_sources(read_json(folder / licences.LICENCES_FILE)) != _without_sources(
            expected
        ):
            yield Difference(licences.LICENCES_FILE, "its licences are not those of the parts")
    except MorphgenError as error:
        yield Difference(RELEASE_FILE, str(error))


def _without_sources(parts: Any) -> list[Any]:  # noqa: ANN401
    """Return the content of ``licences.json`` without texts that a new version may word anew."""
    entries = parts if isinstance(parts, list) else [parts]
    return [
        {key: entry[key] for key in entry if key != "source"} if isinstance(entry, dict) else entry
        for entry in entries
    ]


def _goal_differences(
    folder: Path, split: Split, library: Library, *, jobs: int
) -> Iterator[Difference]:
    """Yield members whose goal sets are not those of their robots, or fail their certificates."""
    try:
        goals = read_split_goals(folder)
    except MorphgenError as error:
        yield Difference(GOALS, str(error))
        return
    members = sided_members(split)
    with stage("certifying goals"):
        faults = list(parallel_map(partial(_goal_fault, goals, library), members, jobs))
    for (side, member), fault in zip(members, faults, strict=True):
        if fault:
            yield Difference(member.name, f"its goal set on side {side}: {fault}")


def _goal_fault(goals: SplitGoals, library: Library, sided_member: tuple[Side, Member]) -> str:
    """Return what is wrong with the goal set of a member, or nothing; runs in worker processes."""
    side, member = sided_member
    result = goals.sets.get((side, member.name))
    if result is None or result.goals is None:
        return "there is none"
    if bool(result.goals.obstacles) != member.obstacles:
        return f"it is for a robot {'with' if result.goals.obstacles else 'without'} obstacles"
    try:
        spec = member_spec(member, library, goals.config, shipped=result.goals)
        return next(iter(certify_goal_set(result.goals, spec)), "")
    except (MorphgenError, ValueError) as error:  # such as a quaternion of zeros
        return str(error)


@dataclass(frozen=True)
class Verification:
    """Result of a verification."""

    split: Split
    id: str  # id of the split, computed from its robots
    differences: tuple[Difference, ...]
    content: str = ""  # for a release: SHA-256 of `SHA256SUMS`, which lists all files


def verify(name_or_path: str | Path, library: Library, *, jobs: int = 1) -> Verification:
    """Compare a split with the robots that its derivations give today, by its id and their hashes.

    In a folder every file is compared with ``SHA256SUMS`` and with the robot of its derivation, and
    every goal is certified; in a release also its description and its licences are compared.
    """
    folder = Path(name_or_path)
    if is_archive(folder):
        with opened_folder(folder) as unpacked:
            return verify(unpacked, library, jobs=jobs)
    is_built = folder.is_dir()
    if is_built:
        require_split_folder(folder)
    path = folder / SPLIT_FILE if is_built else find_split(name_or_path)
    split_file = read_split_file(path)
    split, computed_id = split_file.split, split_id(split_file.split)
    differences = []
    if split_file.id != computed_id:
        why = f"its id is {split_file.id}, but that of its robots is {computed_id}"
        differences.append(Difference(str(path), why))
    if not is_built:
        differences += compare_robots(split, library, jobs=jobs)
        return Verification(split, computed_id, tuple(differences))
    differences += compare_folder(folder, split, library, jobs=jobs)
    if has_goals(folder) and not differences:  # what is changed explains faults of goals
        differences += _goal_differences(folder, split, library, jobs=jobs)
    if not is_release(folder):
        return Verification(split, computed_id, tuple(differences))
    differences += _release_differences(folder, split, library)
    content = file_sha256(folder / SUMS_FILE)
    return Verification(split, computed_id, tuple(differences), content)
