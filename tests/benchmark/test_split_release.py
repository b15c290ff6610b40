"""Releases: contents, determinism, verification, and archives of strangers."""

import hashlib
import json
import re
import zipfile
from dataclasses import replace

import pytest
import yaml

from helpers.commands import tree
from helpers.splits import TEST, TRAIN, combined, member
from morphgen.benchmark import release as release_module
from morphgen.benchmark.licences import CROISSANT_FILE, LICENCES_FILE
from morphgen.benchmark.release import (
    DIFFICULTY_FILE,
    RELEASE_FILE,
    ReleaseRequest,
    opened_folder,
    read_release,
    release_split,
    verify,
)
from morphgen.benchmark.scores.submission import EvalProtocol
from morphgen.benchmark.split_folder import (
    SUMS_FILE,
    BuildSettings,
    read_split_or_folder,
    read_sums,
    sums_text,
)
from morphgen.benchmark.survey import BaselineResult, difficulty_csv, split_difficulty
from morphgen.errors import BenchmarkError, MorphgenError
from morphgen.formats.zip_files import ZipLimits, unpack_zip
from morphgen.grammar.library import default_library
from morphgen.splits.split import split_id

LIBRARY = default_library()
LIGHT = ReleaseRequest(
    "1.2.0",
    date="2027-01-31",
    creators=("A Lab",),
    url="https://example.org/some",
    goals=False,
    settings=BuildSettings(light=True),
)
LIMITS = ZipLimits(2**30, 10_000)


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """The release of a small split."""
    return release_split(combined(), tmp_path_factory.mktemp("out"), LIBRARY, LIGHT)


@pytest.fixture
def folder(report, tmp_path):
    """The unpacked release."""
    unpack_zip(report.archive, tmp_path, LIMITS)
    return tmp_path / "mine-some-1.2.0"


def test_a_release_gives_the_same_bytes_again(report, tmp_path):
    again = release_split(combined(), tmp_path / "new", LIBRARY, LIGHT, jobs=2)
    assert again.archive.read_bytes() == report.archive.read_bytes()
    assert (again.sha256, again.content) == (report.sha256, report.content)
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["mine-some-1.2.0.zip"]


def test_a_release_holds_its_descriptions_and_hashes(report, folder):
    sums = read_sums(folder / SUMS_FILE)
    assert {path.partition("/")[0] for path in sums} == {
        *("README.md", "LICENCES.md", "build.json", "croissant.json", "licences.json"),
        *("release.json", "robots", "robots.jsonl", "split.yaml", "tokens.npz", "difficulty.csv"),
    }
    release = read_release(folder)
    assert (release.name, release.version) == ("mine/some", "1.2.0")
    assert release.id == split_id(combined())
    assert release.evaluation == EvalProtocol().as_data(combined())
    assert set(release.difficulty["nearest"]) == {"planar-plane"}
    _, front, text = (folder / "README.md").read_text().split("---\n", 2)
    card = yaml.safe_load(front)
    assert (card["license"], card["size_categories"]) == ("mit", ["n<1K"])
    assert card["configs"][0]["data_files"] == [{"split": "robots", "path": "robots.jsonl"}]
    assert "A Lab: mine/some, version 1.2.0, 2027" in text
    assert "train: gantry-plane; test: planar-plane" in (folder / "LICENCES.md").read_text()
    assert {each["part"] for each in json.loads((folder / LICENCES_FILE).read_text())} == {
        *("gantry", "planar", "plane", "cube", "cylinder")
    }


def test_a_release_has_the_difficulty_of_every_robot(tmp_path, report, folder):
    text = difficulty_csv(split_difficulty(combined(), LIBRARY))
    assert (folder / DIFFICULTY_FILE).read_text() == text
    card = (folder / "README.md").read_text()
    assert re.search(r"\| planar-plane +\| test +\| push +\| 3 +\| ", card)
    assert "gantry-plane " not in card.partition("## Difficulty")[2].partition("planar-plane")[0]
    assert re.search(r"^morphgen train .*--sim mujoco\b", card, re.MULTILINE)
    results = {"random": {("test", "planar-plane"): BaselineResult(1.5, 0.25)}}
    request = replace(LIGHT, protocol=EvalProtocol("pybullet"))
    more = release_split(combined(), tmp_path / "out", LIBRARY, request, results=results)
    unpack_zip(more.archive, tmp_path / "out", LIMITS)
    folder = tmp_path / "out" / "mine-some-1.2.0"
    header, *_, last = (folder / DIFFICULTY_FILE).read_text().splitlines()
    assert header == f"{text.splitlines()[0]},random_score,random_success"
    assert last == f"{text.splitlines()[-1]},1.500000,0.250000"
    card = (folder / "README.md").read_text()
    assert "| 1.5, 25% " in card
    for command in ("train", "eval"):  # in the simulator of the evaluation
        assert re.search(rf"^morphgen {command} .*--sim pybullet\b", card, re.MULTILINE)
    assert verify(folder, LIBRARY).differences == ()


def test_the_card_lists_a_bounded_number_of_test_robots(report, folder, monkeypatch):
    monkeypatch.setattr(release_module, "MAX_ROWS", 1)
    rows = split_difficulty(combined(), LIBRARY)
    more = (*rows, replace(rows[-1], robot="another"))
    text = release_module.card_text(combined(), read_release(folder), [], [], more)
    assert "The table has 1 of 2 test robots." in text
    assert "another" not in text


def change_difficulty(folder, change):
    """Replace the text of ``difficulty.csv`` and its checksum; None deletes both."""
    path, sums = folder / DIFFICULTY_FILE, read_sums(folder / SUMS_FILE)
    text = change(path.read_text())
    if text is None:
        path.unlink()
        del sums[DIFFICULTY_FILE]
    else:
        path.write_text(text)
        sums[DIFFICULTY_FILE] = hashlib.sha256(text.encode()).hexdigest()
    (folder / SUMS_FILE).write_text(sums_text(sums))


def test_releases_of_earlier_versions_have_no_difficulty_and_pass_verify(folder):
    change_difficulty(folder, lambda text: None)
    assert verify(folder, LIBRARY).differences == ()


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("planar-cube,push,false,3", "planar-cube,push,false,2", "line 3: movable_to_tool of "),
        (r"(plane,push,[^c]*cube,)[\d.]+", r"\1nan", "cosine of planar-plane is 'nan', not '0."),
        (r"(planar-plane,push,.*)planar-cube", r"\1gantry-plane", "workspace_nearest of planar-"),
        (r"(planar-plane,push,.*)planar-cube", r"\1x" + "y" * 999, "planar-plane is 'xyyy"),
        ("planar-cube,push,false", "planar-cube,push", "line 3 has 13 cells, not 14"),
        (r"\n[^\n]*\n\Z", r"\n", "it has 3 robots, not 4"),
        ("cosine_nearest", "cosine_farthest", "it has other columns; expected split, side, robot"),
        (r"\A", "x" * 200_000, "cannot be read: field larger than field limit"),
    ],
)
def test_verify_compares_the_difficulty(folder, old, new, why):
    change_difficulty(folder, lambda text: re.sub(old, new, text, count=1, flags=re.MULTILINE))
    first, *_ = verify(folder, LIBRARY).differences
    assert first.where == DIFFICULTY_FILE
    assert why in first.why
    assert len(first.why) < 300


def test_verify_accepts_another_nearest_robot_that_is_as_near_up_to_rounding(folder, monkeypatch):
    pattern = r"(planar-plane,push,.*)planar-cube,[\d.]+$"
    change_difficulty(folder, lambda text: re.sub(pattern, r"\1gantry-cylinder,0.75", text))
    assert len(verify(folder, LIBRARY).differences) == 2
    monkeypatch.setattr(release_module, "FITTED_TOLERANCE", 1.0)
    assert verify(folder, LIBRARY).differences == ()


def test_the_archive_and_its_folder_pass_verify(report, folder):
    for path in (report.archive, folder):
        result = verify(path, LIBRARY)
        assert result.differences == ()
        assert result.content == report.content
    with pytest.raises(BenchmarkError, match=r"the archive of a release; unpack it"):
        read_split_or_folder(report.archive)


def test_changed_files_fail_verify(folder):
    (folder / LICENCES_FILE).write_text("[]\n")
    data = json.loads((folder / RELEASE_FILE).read_text())
    (folder / RELEASE_FILE).write_text(json.dumps({**data, "name": "other"}))
    lines = [f"{each.where}: {each.why}" for each in verify(folder, LIBRARY).differences]
    assert f"{LICENCES_FILE}: its licences are not those of the parts" in lines
    assert any(line.startswith(f"{RELEASE_FILE}: it is of split other") for line in lines)
    assert sum("is not what SHA256SUMS was written for" in line for line in lines) == 2
    target = folder / "robots" / "planar-cube" / "robot.urdf"
    target.unlink()
    target.symlink_to(folder / RELEASE_FILE)
    assert len(verify(folder, LIBRARY).differences) > len(lines)


def test_croissant_is_valid(folder):
    mlcroissant = pytest.importorskip("mlcroissant")
    dataset = mlcroissant.Dataset(jsonld=folder / CROISSANT_FILE)
    assert dataset.metadata.ctx.issues.report() == ""
    robots = list(dataset.records("robots"))
    names = [b"gantry-plane", b"planar-cube", b"gantry-cylinder", b"planar-plane"]
    assert [each["robots/name"] for each in robots] == names
    assert [each["robots/side"] for each in robots] == [b"train"] * 3 + [b"test"]
    assert [each["sides/name"] for each in dataset.records("sides")] == ["train", "test"]


def test_croissant_lists_the_files_that_are_there(folder):
    data = json.loads((folder / CROISSANT_FILE).read_text())
    sums = read_sums(folder / SUMS_FILE)
    assert data["conformsTo"] == "http://mlcommons.org/croissant/1.1"
    assert data["license"] == ["https://spdx.org/licenses/MIT.html"]
    files = [each for each in data["distribution"] if each["@type"] == "cr:FileObject"]
    assert all(sums[each["contentUrl"]] == each["sha256"] for each in files)
    assert DIFFICULTY_FILE in {each["@id"] for each in files}
    sets = [each["@id"] for each in data["distribution"] if each["@type"] == "cr:FileSet"]
    assert sets == ["urdf"]  # a light build has no MJCF


def test_another_content_of_the_same_version_is_refused(tmp_path):
    first = release_split(combined(), tmp_path, LIBRARY, LIGHT)
    before = tree(tmp_path)
    with pytest.raises(BenchmarkError, match="exists with another content"):
        release_split(combined(), tmp_path, LIBRARY, replace(LIGHT, date="2027-02-01"))
    assert tree(tmp_path) == before
    assert release_split(combined(), tmp_path, LIBRARY, LIGHT) == first


def test_leaky_splits_and_restricted_parts_are_not_released(tmp_path):
    leaky = combined(test=[*TEST, member(TRAIN[0], "twin")])
    with pytest.raises(BenchmarkError, match="fails its audit: body-shared at test robot"):
        release_split(leaky, tmp_path / "out", LIBRARY, LIGHT)
    limited = combined(train=[*TRAIN, "base=gantry ee=sake_ez"])
    with pytest.raises(BenchmarkError, match=r"sake_ez .*--licence-allow CC-BY-NC-ND-4.0"):
        release_split(limited, tmp_path / "out", LIBRARY, LIGHT)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"version": "one"}, "release: version 'one'; expected one such as 1.0.0"),
        ({"date": "2027-02-30"}, "release: date '2027-02-30'; expected one such as 2027-01-31"),
        ({"date": "31.1.2027"}, "release: date '31.1.2027'; expected one such as 2027-01-31"),
        ({"creators": ("a\nb",)}, "release: creator 'a\\nb'; expected printable characters"),
        ({"url": "nowhere"}, "release: url 'nowhere'; expected an address"),
    ],
)
def test_invalid_requests_are_refused(tmp_path, change, why):
    with pytest.raises(BenchmarkError) as caught:
        release_split(combined(), tmp_path / "out", LIBRARY, replace(LIGHT, **change))
    assert str(caught.value).startswith(why)
    assert not (tmp_path / "out").exists()


def test_archives_that_are_no_release_are_refused(tmp_path, monkeypatch):
    for name, entries in {
        "two": ["a/split.yaml", "b/split.yaml"],
        "flat": ["split.yaml"],
        "empty": ["a/other"],
        "out": ["../out"],
    }.items():
        path = tmp_path / f"{name}.zip"
        with zipfile.ZipFile(path, "w") as archive:
            for entry in entries:
                archive.writestr(entry, "x")
        with pytest.raises(MorphgenError, match=rf"{name}.zip: ") as caught:
            verify(path, LIBRARY)
        assert "morphgen-" not in str(caught.value)  # the temporary folder
    monkeypatch.setattr(release_module, "LIMITS", ZipLimits(10, 10))
    with pytest.raises(MorphgenError, match="more than 0 MB"), opened_folder(tmp_path / "two.zip"):
        raise AssertionError
