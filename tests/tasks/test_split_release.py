"""Releases: contents, determinism, verification, and archives of strangers."""

import json
import re
import zipfile
from dataclasses import replace

import pytest
import yaml

from helpers.commands import tree
from helpers.splits import TEST, TRAIN, combined, member
from morphgen.benchmark import release_file
from morphgen.benchmark.croissant import CONFORMS_TO
from morphgen.benchmark.release_file import (
    CROISSANT_FILE,
    LICENCES_FILE,
    RELEASE_FILE,
    opened_folder,
    read_release,
)
from morphgen.benchmark.split import split_id
from morphgen.benchmark.split_folder import SUMS_FILE, read_sums
from morphgen.benchmark.split_folder_files import BuildSettings
from morphgen.benchmark.split_source import read_split_or_folder
from morphgen.benchmark.verify import verify
from morphgen.errors import BenchmarkError
from morphgen.formats.zip_files import ZipLimits, unpack_zip
from morphgen.grammar.library import default_library
from morphgen.tasks.eval_protocol import EvalProtocol
from morphgen.tasks.split_release import ReleaseRequest, release_split

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
        *("release.json", "robots", "robots.jsonl", "split.yaml", "tokens.npz"),
    }
    release = read_release(folder)
    assert (release.name, release.id, release.version) == (
        "mine/some",
        split_id(combined()),
        "1.2.0",
    )
    assert release.evaluation == EvalProtocol().as_data(combined())
    assert set(release.difficulty["nearest"]) == {"planar-plane"}
    assert release.private_test is None
    _, front, text = (folder / "README.md").read_text().split("---\n", 2)
    card = yaml.safe_load(front)
    assert (card["license"], card["size_categories"]) == ("mit", ["n<1K"])
    assert card["configs"][0]["data_files"] == [{"split": "robots", "path": "robots.jsonl"}]
    assert "A Lab: mine/some, version 1.2.0, 2027" in text
    assert "train: gantry-plane; test: planar-plane" in (folder / "LICENCES.md").read_text()
    assert {each["part"] for each in json.loads((folder / LICENCES_FILE).read_text())} == {
        *("gantry", "planar", "plane", "cube", "cylinder")
    }


@pytest.mark.parametrize("simulator", ["mujoco", "pybullet"])
def test_the_commands_of_the_card_name_the_simulator_of_the_evaluation(tmp_path, simulator):
    request = replace(LIGHT, protocol=EvalProtocol(simulator))
    report = release_split(combined(), tmp_path, LIBRARY, request)
    unpack_zip(report.archive, tmp_path, LIMITS)
    text = (tmp_path / "mine-some-1.2.0" / "README.md").read_text()
    for command in ("train", "eval"):
        assert re.search(rf"^morphgen {command} .*--sim {simulator}\b", text, re.MULTILINE)


def test_the_archive_and_its_folder_pass_verify(report, folder):
    for path in (report.archive, folder):
        result = verify(path, LIBRARY)
        assert result.differences == ()
        assert result.content == report.content


def test_changed_files_fail_verify(folder):
    (folder / LICENCES_FILE).write_text("[]\n")
    data = json.loads((folder / RELEASE_FILE).read_text())
    (folder / RELEASE_FILE).write_text(json.dumps({**data, "name": "other"}))
    lines = [f"{each.where}: {each.why}" for each in verify(folder, LIBRARY).differences]
    assert f"{LICENCES_FILE}: its licences are not those of the parts" in lines
    assert any(line.startswith(f"{RELEASE_FILE}: it is of split other") for line in lines)
    assert sum("is not what SHA256SUMS was written for" in line for line in lines) == 2


def test_croissant_is_valid(folder):
    mlcroissant = pytest.importorskip("mlcroissant")
    dataset = mlcroissant.Dataset(jsonld=folder / CROISSANT_FILE)
    assert dataset.metadata.ctx.issues.report() == ""
    robots = list(dataset.records("robots"))
    assert [each["robots/name"].decode() for each in robots] == [
        *("gantry-plane", "planar-cube", "gantry-cylinder", "planar-plane")
    ]
    assert [each["robots/side"] for each in robots] == [b"train"] * 3 + [b"test"]
    assert [each["sides/name"] for each in dataset.records("sides")] == ["train", "test"]


def test_croissant_lists_the_files_that_are_there(folder):
    data = json.loads((folder / CROISSANT_FILE).read_text())
    sums = read_sums(folder / SUMS_FILE)
    assert data["conformsTo"] == CONFORMS_TO
    assert data["license"] == ["https://spdx.org/licenses/MIT.html"]
    files = [each for each in data["distribution"] if each["@type"] == "cr:FileObject"]
    assert all(sums[each["contentUrl"]] == each["sha256"] for each in files)
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
    with pytest.raises(
        BenchmarkError, match="mine/some fails its audit: body-shared at test robot"
    ):
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


def test_an_archive_must_be_unpacked_for_training(report):
    with pytest.raises(BenchmarkError, match=r"the archive of a release; unpack it"):
        read_split_or_folder(report.archive)


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
        with pytest.raises(BenchmarkError, match=rf"{name}.zip: ") as caught:
            verify(path, LIBRARY)
        assert "morphgen-" not in str(caught.value)  # the temporary folder
    monkeypatch.setattr(release_file, "LIMITS", ZipLimits(10, 10))
    with pytest.raises(BenchmarkError, match="more than 0 MB"), opened_folder(tmp_path / "two.zip"):
        raise AssertionError


def test_links_in_an_unpacked_release_are_differences(folder, tmp_path):
    (tmp_path / "secret").write_text("secret")
    target = folder / "robots" / "planar-cube" / "robot.urdf"
    target.unlink()
    target.symlink_to(tmp_path / "secret")
    assert verify(folder, LIBRARY).differences
