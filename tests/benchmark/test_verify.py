"""Verifying split files and split folders against the robots that they describe."""

import hashlib
import io
import json
from dataclasses import replace

import numpy as np
import pytest

from helpers.splits import LIBRARY, TRAIN, combined, member, split
from morphgen.benchmark.release import verify
from morphgen.benchmark.split_folder import build_split
from morphgen.encoding.tokens import GEOMETRY, ORIGIN, PARENT
from morphgen.errors import BenchmarkError, MorphgenError
from morphgen.progress import show_progress
from morphgen.splits.split import split_id
from morphgen.splits.split_file import split_text


def difference_keys(path, **options):
    """Return location and reason of every difference."""
    return [(each.where, each.why) for each in verify(path, LIBRARY, **options).differences]


def written(folder, example_split):
    path = folder / "some.yaml"
    path.write_text(split_text(example_split))
    return path


def rewrite_checksums(folder):
    """Rewrite the checksums so that they match the changed files."""
    lines = (folder / "SHA256SUMS").read_text().splitlines()
    names = [line[66:] for line in lines]
    sums = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names}
    text = "".join(f"{value}  {name}\n" for name, value in sums.items())
    (folder / "SHA256SUMS").write_text(text)


def test_an_unchanged_file_passes(tmp_path):
    example_split = combined()
    seen = verify(written(tmp_path, example_split), LIBRARY)
    assert (seen.split, seen.id, seen.differences) == (example_split, split_id(example_split), ())
    path = tmp_path / "some.yaml"
    path.write_text(path.read_text().replace("a split of a test", "another summary"))
    assert difference_keys(path) == []
    assert difference_keys("composition/ee-task") == []
    with pytest.raises(BenchmarkError, match="split of this name; did you"):
        verify("interpolation/arm4/reach", LIBRARY)


def test_a_changed_line_is_reported_for_the_robot_and_the_id(tmp_path):
    path = written(tmp_path, combined())
    path.write_text(path.read_text().replace("cube(size=0.1)", "cube(size=0.11)"))
    (file, id_), (robot, why) = difference_keys(path)
    assert file == str(path)
    assert id_.startswith(f"its id is {split_id(combined())}, but that of")
    assert robot == "planar-cube"
    assert "was made with body" in why


def test_a_robot_that_cannot_be_composed_is_reported(tmp_path):
    wrong = replace(member(TRAIN[1]), derivation="base=planar[top: ee=cubw]")
    path = written(tmp_path, combined(train=[TRAIN[0], wrong]))
    ((where, told),) = difference_keys(path)
    assert (where, "unknown part 'cubw'; did you mean 'cube'?" in told) == ("planar-cube", True)


def test_every_member_with_a_wrong_derivation_is_reported(tmp_path):
    wrong = replace(member(TRAIN[0]), robot_hash="0" * 32)
    path = written(tmp_path, combined(train=[wrong, replace(wrong, name="again", task="reach")]))
    assert [where for where, _ in difference_keys(path)] == ["gantry-plane", "again"]


def test_a_moved_split_folder_passes(either, tmp_path):
    either.rename(tmp_path / "elsewhere")
    seen = []
    with show_progress(lambda *counts: seen.append(counts)):
        assert difference_keys(tmp_path / "elsewhere") == []
    assert seen == [(i, 4) for i in (1, 2, 3, 4)]


@pytest.mark.parametrize(
    ("path", "where"),
    [
        ("robots/planar-cube/robot.urdf", "planar-cube"),
        ("robots.jsonl", "robots.jsonl"),
        ("tokens.npz", "tokens.npz"),
        ("README.md", "README.md"),
    ],
)
@pytest.mark.parametrize("change", ["cut", "longer", "gone"])
def test_a_damaged_file_is_reported(either, path, where, change):
    data = (either / path).read_bytes()
    (either / path).write_bytes(data + b"\n" if change == "longer" else data[: len(data) // 2])
    if change == "gone":
        (either / path).unlink()
    findings = difference_keys(either)
    why = "is missing, but SHA256SUMS names it" if change == "gone" else "is not what SHA256SUMS"
    file = path.rpartition("/")[2]
    assert (where, True) in [(place, f"file {file} {why}" in text) for place, text in findings]
    assert {place for place, _ in findings} <= {where, "gantry-plane"}


def test_an_extra_file_is_reported(either):
    (either / "robots" / "planar-cube" / "notes.txt").write_text("mine")
    (either / "robots" / "stranger").mkdir()
    (either / "robots" / "stranger" / "robot.urdf").write_text("<robot/>")
    assert difference_keys(either) == [
        ("planar-cube", "file notes.txt is not named by SHA256SUMS"),
        ("stranger", "file robot.urdf is not named by SHA256SUMS"),
    ]


def test_a_urdf_changed_with_its_checksum_is_reported(either):
    path = either / "robots" / "planar-cube" / "robot.urdf"
    path.write_text(path.read_text().replace('effort="', 'effort="1', 1))
    card = path.with_name("card.json")
    if card.is_file():
        data = json.loads(card.read_text())
        data["hashes"]["robot.urdf"] = hashlib.sha256(path.read_bytes()).hexdigest()
        card.write_text(json.dumps(data))
    rewrite_checksums(either)
    assert difference_keys(either) == [("planar-cube", "file robot.urdf is not the robot's")]


@pytest.mark.parametrize(
    ("key", "value"), [("mass", 3.0), ("home", {}), ("ignore_pairs", [["a", "b"]]), ("dof", 4)]
)
def test_a_card_changed_with_its_checksum_is_reported(bundles, key, value):
    path = bundles / "robots" / "planar-cube" / "card.json"
    card = json.loads(path.read_text())
    last_digits = {"reach": card["reach"] * (1 + 1e-9)}  # may differ
    path.write_text(json.dumps(card | last_digits | {key: value}))
    rewrite_checksums(bundles)
    assert difference_keys(bundles) == [
        ("planar-cube", f"file card.json: its {key!r} is not the robot's")
    ]


def test_meshes_are_verified(tmp_path):
    example_split = split(["arm=ur5 ee=plane"], ["base=planar ee=plane"])
    folder = build_split(example_split, tmp_path / "data", LIBRARY).folder
    assert difference_keys(folder) == []
    mesh = next((folder / "robots" / "ur5-plane" / "meshes").iterdir())
    mesh.write_bytes(mesh.read_bytes()[:-1] + b"\x01")
    ((where, why),) = difference_keys(folder)
    assert (where, why) == (
        "ur5-plane",
        f"file meshes/{mesh.name} is not what SHA256SUMS was written for",
    )
    rewrite_checksums(folder)
    ((where, why),) = difference_keys(folder)
    assert (where, f"file meshes/{mesh.name}: its content differs" in why) == ("ur5-plane", True)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda lines: lines[1].update(mass=1.5), "planar-cube robots.jsonl:2: mass is 1.5, not"),
        (
            lambda lines: lines[3].update(side="train"),
            "planar-plane robots.jsonl:4: side is 'train', not 'test'",
        ),
        (
            lambda lines: lines[0].pop("task"),
            "gantry-plane robots.jsonl:1: task is None, not 'push'",
        ),
        (lambda lines: lines.pop(), "robots.jsonl it has 3 robots, not 4"),
    ],
)
def test_a_record_changed_with_its_checksum_is_reported(either, change, expected):
    path = either / "robots.jsonl"
    records = [json.loads(line) for line in path.read_text().splitlines()]
    change(records)
    path.write_text("".join(json.dumps(record) + "\n" for record in records))
    rewrite_checksums(either)
    ((where, why),) = difference_keys(either)
    assert f"{where} {why}".startswith(expected)


def changed_tokens(folder, change):
    with np.load(folder / "tokens.npz") as data:
        arrays = dict(data)
    change(arrays)
    content = io.BytesIO()
    np.savez(content, **arrays)
    (folder / "tokens.npz").write_bytes(content.getvalue())
    rewrite_checksums(folder)


@pytest.mark.parametrize("field", [PARENT, ORIGIN, GEOMETRY])
def test_tokens_changed_with_their_checksum_are_reported(either, field):
    def change(arrays):
        arrays["tokens"][1, 2, field.start] += 0.01

    changed_tokens(either, change)
    why = f"tokens.npz: {field.name} of link 2 is not the robot's"
    assert difference_keys(either) == [("planar-cube", why)]


def test_changed_masks_names_and_missing_numbers_of_tokens_are_reported(either):
    changed_tokens(either, lambda arrays: arrays["tokens"].__setitem__((2, 0, 5), np.nan))
    assert [where for where, _ in difference_keys(either)] == ["gantry-cylinder"]
    changed_tokens(either, lambda arrays: arrays["tokens"].__setitem__((2, 0, 5), 0))
    changed_tokens(either, lambda arrays: arrays["mask"].__setitem__((2, 9), True))
    assert difference_keys(either) == [
        ("gantry-cylinder", "tokens.npz: its mask is not that of its links")
    ]
    changed_tokens(either, lambda arrays: arrays["names"].__setitem__(0, "other"))
    assert difference_keys(either) == [("tokens.npz", "it is not of the 4 robots of split.yaml")]


def test_an_exchanged_split_file_is_reported(either):
    other = combined(test=["base=planar ee=cylinder"])
    (either / "split.yaml").write_text(split_text(other))
    rewrite_checksums(either)
    findings = difference_keys(either)
    assert ("build.json", f"it is of split {split_id(combined())}, not of split.yaml") in findings
    assert ("planar-cylinder", "its folder is missing") in findings


@pytest.mark.parametrize(
    ("path", "content", "message"),
    [
        ("build.json", b'{"format": 2}', "build.json: format: unknown value 2; valid: 1"),
        ("SHA256SUMS", b"abc\n", "SHA256SUMS:1: expected a hash, two spaces and a path"),
        ("split.yaml", None, "split.yaml: no such file"),
        ("split.yaml", b"format: 1\n", "split.yaml:1: missing key"),
    ],
)
def test_unreadable_folders_are_errors(bundles, path, content, message):
    if content is None:
        (bundles / path).unlink()
    else:
        (bundles / path).write_bytes(content)
    with pytest.raises(MorphgenError, match=message):
        verify(bundles, LIBRARY)
