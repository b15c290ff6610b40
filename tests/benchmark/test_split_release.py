"""Releases: contents, determinism, verification, and archives of strangers."""

import hashlib
import json
import zipfile
from dataclasses import replace

import pytest
import yaml

from helpers.commands import tree
from helpers.splits import TEST, TRAIN, combined, member
from morphgen.benchmark import release as release_module
from morphgen.benchmark.licences import CROISSANT_FILE, LICENCES_FILE
from morphgen.benchmark.release import (
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
    read_split_or_folder,
    read_sums,
    sums_text,
)
from morphgen.errors import BenchmarkError, MorphgenError
from morphgen.formats.zip_files import ZipLimits, unpack_zip
from morphgen.grammar.library import default_library
from morphgen.splits.split import split_id

LIBRARY = default_library()
REQUEST = ReleaseRequest(
    "1.2.0",
    date="2027-01-31",
    creators=("A Lab",),
    url="https://example.org/some",
    goals=False,
)
LIMITS = ZipLimits(2**30, 10_000)


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """The release of a small split."""
    return release_split(combined(), tmp_path_factory.mktemp("out"), LIBRARY, REQUEST)


@pytest.fixture
def folder(report, tmp_path):
    """The unpacked release."""
    unpack_zip(report.archive, tmp_path, LIMITS)
    return tmp_path / "mine-some-1.2.0"


def test_a_release_gives_the_same_bytes_again(report, tmp_path):
    again = release_split(combined(), tmp_path / "new", LIBRARY, REQUEST, jobs=2)
    assert again.archive.read_bytes() == report.archive.read_bytes()
    assert (again.sha256, again.content) == (report.sha256, report.content)
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["mine-some-1.2.0.zip"]


def test_a_release_holds_its_descriptions_and_hashes(report, folder):
    sums = read_sums(folder / SUMS_FILE)
    assert {path.partition("/")[0] for path in sums} == {
        *("README.md", "build.json", "croissant.json", "licences.json"),
        *("release.json", "robots", "robots.jsonl", "split.yaml", "tokens.npz"),
    }
    release = read_release(folder)
    assert (release.name, release.version) == ("mine/some", "1.2.0")
    assert release.id == split_id(combined())
    assert release.evaluation == EvalProtocol().as_data(combined())
    _, front, text = (folder / "README.md").read_text().split("---\n", 2)
    card = yaml.safe_load(front)
    assert (card["license"], card["size_categories"]) == ("mit", ["n<1K"])
    assert card["configs"][0]["data_files"] == [{"split": "robots", "path": "robots.jsonl"}]
    assert "A Lab: mine/some, version 1.2.0, 2027" in text
    assert {each["part"] for each in json.loads((folder / LICENCES_FILE).read_text())} == {
        *("gantry", "planar", "plane", "cube", "cylinder")
    }


def test_releases_of_version_0_3_with_difficulty_pass_verify(folder):
    data = json.loads((folder / RELEASE_FILE).read_text())
    added = {RELEASE_FILE: json.dumps(data | {"difficulty": {}}), "difficulty.csv": "split,side\n"}
    sums = read_sums(folder / SUMS_FILE)
    for name, text in added.items():
        (folder / name).write_text(text)
        sums[name] = hashlib.sha256(text.encode()).hexdigest()
    (folder / SUMS_FILE).write_text(sums_text(sums))
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
    sets = [each["@id"] for each in data["distribution"] if each["@type"] == "cr:FileSet"]
    assert sets == ["urdf", "mjcf"]  # the goals are left out


def test_another_content_of_the_same_version_is_refused(tmp_path):
    first = release_split(combined(), tmp_path, LIBRARY, REQUEST)
    before = tree(tmp_path)
    with pytest.raises(BenchmarkError, match="exists with another content"):
        release_split(combined(), tmp_path, LIBRARY, replace(REQUEST, date="2027-02-01"))
    assert tree(tmp_path) == before
    assert release_split(combined(), tmp_path, LIBRARY, REQUEST) == first


def test_leaky_splits_and_restricted_parts_are_not_released(tmp_path):
    leaky = combined(test=[*TEST, member(TRAIN[0], "twin")])
    with pytest.raises(BenchmarkError, match="fails its audit: body-shared at test robot"):
        release_split(leaky, tmp_path / "out", LIBRARY, REQUEST)
    limited = combined(train=[*TRAIN, "base=gantry ee=sake_ez"])
    with pytest.raises(BenchmarkError, match=r"sake_ez .*--licence-allow CC-BY-NC-ND-4.0"):
        release_split(limited, tmp_path / "out", LIBRARY, REQUEST)
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
        release_split(combined(), tmp_path / "out", LIBRARY, replace(REQUEST, **change))
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
