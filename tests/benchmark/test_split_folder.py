"""Split folders: complete, reproducible, protected, readable, and verified."""

import hashlib
import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas
import pytest

from helpers.commands import tree
from helpers.splits import LIBRARY, TRAIN, combined, member, split
from morphgen.benchmark.release import verify
from morphgen.benchmark.split_folder import (
    build_split,
    read_records,
    read_tokens,
    require_split_folder,
)
from morphgen.encoding.tokens import GEOMETRY, ORIGIN, PARENT, pad_tokens, tokens
from morphgen.errors import BenchmarkError, FormatError, MorphgenError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats import zip_files as npz_files
from morphgen.progress import show_progress
from morphgen.splits.split import compose_member, read_split, split_id, split_text


def test_the_folder_has_the_name_of_the_split(tmp_path, example_split):
    report = build_split(example_split, tmp_path / "data", LIBRARY)
    assert report.folder == tmp_path / "data" / "mine" / "some"
    assert (report.num_written, report.num_kept) == (4, 0)
    names = ["README.md", "SHA256SUMS", "build.json", "robots", "robots.jsonl", "split.yaml"]
    assert sorted(path.name for path in report.folder.iterdir()) == [*names, "tokens.npz"]
    assert read_split(report.folder / "split.yaml") == example_split


def test_each_robot_has_one_line_of_json(bundles, example_split):
    records = [json.loads(line) for line in (bundles / "robots.jsonl").read_text().splitlines()]
    members = (*example_split.train, *example_split.test)
    assert [record["name"] for record in records] == [m.name for m in members]
    assert [record["side"] for record in records] == ["train"] * 3 + ["test"]
    assert records[0] == {
        "name": "gantry-plane",
        "side": "train",
        "task": "push",
        "obstacles": False,
        "category": "composed",
        "derivation": example_split.train[0].derivation,
        "hash": example_split.train[0].robot_hash,
        "links": 7,
        "movable": 5,
        "movable_to_tool": 5,
        "dof": 5,
        "reach": pytest.approx(1.167, abs=1e-3),
        "mass": pytest.approx(compose_member(example_split.train[0], LIBRARY).mass),
        "path": "robots/gantry-plane",
    }
    table = pandas.read_json(bundles / "robots.jsonl", lines=True)
    assert table.groupby("side").size().to_dict() == {"test": 1, "train": 3}


def test_tokens_match_the_robots(bundles, example_split):
    with np.load(bundles / "tokens.npz", allow_pickle=False) as data:
        assert data["tokens"].shape == (4, 23, 48)
        assert data["columns"].tolist()[0] == [0, 1]
        for i, one in enumerate((*example_split.train, *example_split.test)):
            robot = compose_member(one, LIBRARY)
            table, mask = pad_tokens(tokens(robot, token_shapes(robot)), 23)
            assert data["names"][i] == one.name
            np.testing.assert_array_equal(data["tokens"][i], table)
            np.testing.assert_array_equal(data["mask"][i], mask)


def test_max_links_of_a_split_pads_all_tokens(tmp_path):
    example_split = split(["chain beads=7"], ["base=gantry ee=cube"], provenance={"max_links": 25})
    narrow = replace(example_split, provenance={})
    with pytest.raises(BenchmarkError, match=r"robot 'chain-\w+' has 25 links, more than max_li"):
        build_split(narrow, tmp_path, LIBRARY)
    _, (_, table, mask) = read(build_split(example_split, tmp_path, LIBRARY).folder)
    assert table.shape == (2, 25, 48)
    assert mask[0].all()


def test_checksums_cover_every_other_file(bundles):
    files = {name: data for name, data in tree(bundles).items() if data is not None}
    text = (bundles / "SHA256SUMS").read_text()
    sums = {name: hashlib.sha256(files[name]).hexdigest() for name in files.keys() - {"SHA256SUMS"}}
    assert text == "".join(f"{sums[name]}  {name}\n" for name in sorted(sums))


def test_the_loading_example_of_the_readme_runs(bundles, monkeypatch, capsys):
    monkeypatch.chdir(bundles)
    text = Path("README.md").read_text()
    (code,) = [part.split("```")[0] for part in text.split("```python\n")[1:]]
    exec(code, {})
    first = "gantry-plane (23, 48) robots/gantry-plane/robot.urdf\n"
    assert capsys.readouterr().out.startswith(first)


def test_a_robot_listed_twice_is_written_once(tmp_path):
    twin = member("base=gantry ee=plane", "twin", task="reach")
    example_split = combined(test=[twin, *combined().test])
    report = build_split(example_split, tmp_path, LIBRARY)
    assert report.num_written == 4
    names = {path.name for path in (report.folder / "robots").iterdir()}
    assert names == {"gantry-plane", "planar-cube", "gantry-cylinder", "planar-plane"}
    robots = {robot["name"]: robot for robot in read(report.folder)[0]}
    assert robots["twin"]["path"] == "robots/gantry-plane"
    assert robots["twin"]["task"] == "reach"


@pytest.mark.slow
def test_repeated_and_parallel_builds_have_the_same_bytes(tmp_path):
    # A worker takes 8.
    cubes = [member(f"cubes cubes.size={20 + i}mm", f"cube-{i}") for i in range(9)]
    example_split = split(cubes, ["arm=ur5 ee=plane"])
    one = build_split(example_split, tmp_path / "one", LIBRARY)
    two = build_split(example_split, tmp_path / "two", LIBRARY, jobs=2)
    assert tree(one.folder) == tree(two.folder)
    again = build_split(example_split, tmp_path / "one", LIBRARY)
    assert (again.num_written, again.num_kept) == (0, 10)
    assert tree(one.folder) == tree(two.folder)


class Killed(BaseException):
    pass


@pytest.mark.parametrize("done", [1, 3, 4])
def test_files_written_before_an_interruption_are_kept(tmp_path, example_split, done):
    whole = build_split(example_split, tmp_path / "whole", LIBRARY).folder

    def stop(number, total):
        if number == done:
            raise Killed

    with pytest.raises(Killed), show_progress(stop):
        build_split(example_split, tmp_path / "own", LIBRARY)
    own = tmp_path / "own" / "mine" / "some"
    with pytest.raises(BenchmarkError, match="is not finished: it has no SHA256SUMS; build it"):
        read(own)
    report = build_split(example_split, tmp_path / "own", LIBRARY)
    assert (report.num_written, report.num_kept) == (4 - done, done)
    assert tree(own) == tree(whole)


def put(path, content):
    """Write bytes to a file, or delete it."""
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content or b"")
    if content is None:
        path.unlink()


@pytest.mark.parametrize(
    ("path", "content"),
    [
        ("robots/planar-cube/robot.urdf", b"<robot/>"),
        ("robots/planar-cube/robot.xml", None),
        ("robots/planar-cube/card.json", b"{"),
        ("robots/planar-cube/notes.txt", b"mine"),
        ("robots.jsonl", b""),
        ("tokens.npz", None),
        ("README.md", b"?"),
        ("SHA256SUMS", None),
        ("split.yaml", b""),
        ("robots/.planar-cube.x1y2/robot.urdf", b"<rob"),
    ],
)
def test_invalid_files_are_rebuilt(tmp_path, bundles, example_split, path, content):
    before = tree(bundles)
    put(bundles / path, content)
    build_split(example_split, tmp_path / "whole", LIBRARY)
    assert tree(bundles) == before


def test_changed_robots_and_those_of_another_version_are_rebuilt(tmp_path, bundles, example_split):
    before = tree(bundles)
    folder = bundles / "robots" / "planar-cube"
    text = (folder / "robot.urdf").read_text().replace('effort="', 'effort="1')
    (folder / "robot.urdf").write_text(text)
    card = json.loads((folder / "card.json").read_text())
    card["hashes"]["robot.urdf"] = hashlib.sha256(text.encode()).hexdigest()
    (folder / "card.json").write_text(json.dumps(card))
    assert build_split(example_split, tmp_path / "whole", LIBRARY).num_written == 1
    assert tree(bundles) == before
    path = folder / "card.json"
    path.write_text(path.read_text().replace('"morphgen": "', '"morphgen": "0.0.'))
    assert build_split(example_split, tmp_path / "whole", LIBRARY).num_written == 1
    assert tree(bundles) == before


def test_a_folder_of_another_build_is_an_error(tmp_path, bundles):
    before = tree(bundles)
    other = combined(test=["base=planar ee=cylinder"])
    with pytest.raises(BenchmarkError, match=r"its split is '[0-9a-f]{32}', not .*; name another"):
        build_split(other, tmp_path / "whole", LIBRARY)
    assert tree(bundles) == before


@pytest.mark.parametrize("place", ["mine", "mine/some", "mine/some/notes.txt"])
def test_other_files_in_place_of_a_build_are_errors(tmp_path, example_split, place):
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / place).write_text("mine")
    before = tree(tmp_path)
    message = r"is not a built split \(no build.json\); name another|cannot write"
    with pytest.raises(BenchmarkError, match=message):
        build_split(example_split, tmp_path, LIBRARY)
    assert tree(tmp_path) == before


@pytest.mark.parametrize("name", ["../up", "a//b", "/tmp/x", "", ".hidden"])
def test_a_name_that_is_a_path_is_an_error(tmp_path, name):
    with pytest.raises(FormatError, match="use letters, digits"):
        build_split(combined(name=name), tmp_path / "data", LIBRARY)
    assert not list(tmp_path.iterdir())


def test_a_name_shared_by_two_robots_is_an_error(tmp_path):
    example_split = combined(test=[member("base=planar ee=cylinder", "gantry-plane")])
    with pytest.raises(BenchmarkError, match="both named 'gantry-plane'; rename one"):
        build_split(example_split, tmp_path / "data", LIBRARY)
    assert not list(tmp_path.iterdir())


def test_a_concurrent_build_in_the_same_folder_is_an_error(tmp_path, example_split):
    def again(done, total):
        with pytest.raises(FormatError, match="is being written by another run"):
            build_split(example_split, tmp_path, LIBRARY)

    with show_progress(again):
        report = build_split(example_split, tmp_path, LIBRARY)
    assert len(read(report.folder)[0]) == 4


def test_a_full_disk_is_an_error_and_leaves_no_partial_file(tmp_path, example_split, monkeypatch):
    written = Path.write_text

    def full(path, *args, **options):
        if path.name == "card.json":
            raise OSError(28, "No space left on device", str(path))
        return written(path, *args, **options)

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(FormatError, match=r"cannot write .*No space left on device"):
        build_split(example_split, tmp_path, LIBRARY)
    assert not (tmp_path / "mine" / "some").exists()
    monkeypatch.undo()
    assert build_split(example_split, tmp_path, LIBRARY).num_written == 4


def read(folder):
    """Read the robots and the tokens of a split folder."""
    require_split_folder(folder)
    return read_records(folder / "robots.jsonl"), read_tokens(folder / "tokens.npz")


@pytest.mark.parametrize(
    ("path", "content", "message"),
    [
        ("build.json", None, r"is no built split: it has no build.json; morphgen split build"),
        ("SHA256SUMS", None, "is not finished: it has no SHA256SUMS; build it again"),
        ("robots.jsonl", None, "robots.jsonl: no such file"),
        ("robots.jsonl", b"{\n", "robots.jsonl:1: invalid JSON"),
        ("robots.jsonl", b"[]\n", "robots.jsonl:1: expected an object with a name and a side"),
        ("tokens.npz", None, "tokens.npz: no such file"),
        ("tokens.npz", b"PK\x03\x04 and so on", "tokens.npz: cannot be read"),
    ],
)
def test_unreadable_files_are_errors_that_name_the_file(bundles, path, content, message):
    put(bundles / path, content)
    with pytest.raises(MorphgenError, match=message):
        read(bundles)


def change_tokens(folder, change):
    """Change the arrays of the tokens and rewrite the checksums."""
    with np.load(folder / "tokens.npz") as data:
        arrays = dict(data)
    change(arrays)
    np.savez(folder / "tokens.npz", **arrays)
    rewrite_checksums(folder)


@pytest.mark.parametrize("change", ["tokens", "mask", "names"])
def test_inconsistent_token_arrays_are_errors(bundles, change):
    change_tokens(bundles, lambda arrays: arrays.update({change: arrays[change][:2]}))
    with pytest.raises(BenchmarkError, match=r"names, tokens and mask are of shapes \("):
        read(bundles)
    change_tokens(bundles, lambda arrays: arrays.pop(change))
    with pytest.raises(BenchmarkError, match=f"cannot be read: .*{change}"):
        read(bundles)


@pytest.mark.parametrize("kind", ["U4", "M8[s]", "?", "c16"])
def test_token_arrays_of_other_types_are_errors(bundles, kind):
    def change(arrays):
        arrays["tokens"] = arrays["tokens"].astype(int).astype(kind)

    change_tokens(bundles, change)
    with pytest.raises(BenchmarkError, match=r"are of types .*expected str, float64 and bool"):
        read(bundles)


def test_arrays_that_claim_or_hold_more_than_the_memory_are_errors(bundles, monkeypatch):
    header = {"descr": "<f8", "fortran_order": False, "shape": (10**9, 10**5)}
    with zipfile.ZipFile(bundles / "tokens.npz", "w") as archive:
        for name in ("names", "tokens", "mask"):
            with archive.open(f"{name}.npy", "w") as file:
                np.lib.format.write_array_header_1_0(file, header)
    with pytest.raises(BenchmarkError, match=r"tokens\.npz: cannot be read: "):
        read(bundles)
    monkeypatch.setattr(npz_files, "MAX_BYTES", 1000)
    np.savez_compressed(bundles / "tokens.npz", tokens=np.zeros(10_000))
    with pytest.raises(BenchmarkError, match="its arrays have more than"):
        read(bundles)
    with (bundles / "tokens.npz").open("wb") as file:
        np.save(file, np.zeros(3))  # one array without an archive
    with pytest.raises(BenchmarkError, match=r"tokens\.npz: cannot be read: "):
        read(bundles)


def test_loading_a_parent_folder_suggests_the_split_folder(tmp_path, bundles):
    with pytest.raises(BenchmarkError, match=r"did you mean .*whole/mine/some\?"):
        read(tmp_path / "whole")
    with pytest.raises(BenchmarkError, match="nowhere: no such folder"):
        read(tmp_path / "nowhere")


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


UNKNOWN = replace(member(TRAIN[1]), derivation="base=planar[top: ee=cubw]")
WRONG = replace(member(TRAIN[0]), robot_hash="0" * 32)


@pytest.mark.parametrize(
    ("train", "differences"),
    [
        ([TRAIN[0], UNKNOWN], {"planar-cube": "unknown part 'cubw'; did you mean 'cube'?"}),
        (
            [WRONG, replace(WRONG, name="again", task="reach")],
            {"gantry-plane": "was made with body", "again": "was made with body"},
        ),
    ],
)
def test_every_robot_with_a_wrong_derivation_is_reported(tmp_path, train, differences):
    keys = difference_keys(written(tmp_path, combined(train=train)))
    assert [where for where, _ in keys] == list(differences)
    assert all(differences[where] in why for where, why in keys)


def test_a_moved_split_folder_passes(bundles, tmp_path):
    bundles.rename(tmp_path / "elsewhere")
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
def test_a_damaged_file_is_reported(bundles, path, where, change):
    data = (bundles / path).read_bytes()
    (bundles / path).write_bytes(data + b"\n" if change == "longer" else data[: len(data) // 2])
    if change == "gone":
        (bundles / path).unlink()
    findings = difference_keys(bundles)
    why = "is missing, but SHA256SUMS names it" if change == "gone" else "is not what SHA256SUMS"
    file = path.rpartition("/")[2]
    assert (where, True) in [(place, f"file {file} {why}" in text) for place, text in findings]
    assert {place for place, _ in findings} <= {where, "gantry-plane"}


def test_an_extra_file_is_reported(bundles):
    (bundles / "robots" / "planar-cube" / "notes.txt").write_text("mine")
    (bundles / "robots" / "stranger").mkdir()
    (bundles / "robots" / "stranger" / "robot.urdf").write_text("<robot/>")
    assert difference_keys(bundles) == [
        ("planar-cube", "file notes.txt is not named by SHA256SUMS"),
        ("stranger", "file robot.urdf is not named by SHA256SUMS"),
    ]


def test_a_urdf_changed_with_its_checksum_is_reported(bundles):
    path = bundles / "robots" / "planar-cube" / "robot.urdf"
    path.write_text(path.read_text().replace('effort="', 'effort="1', 1))
    card = path.with_name("card.json")
    data = json.loads(card.read_text())
    data["hashes"]["robot.urdf"] = hashlib.sha256(path.read_bytes()).hexdigest()
    card.write_text(json.dumps(data))
    rewrite_checksums(bundles)
    assert difference_keys(bundles) == [("planar-cube", "file robot.urdf is not the robot's")]


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
    why = f"file meshes/{mesh.name} is not what SHA256SUMS was written for"
    assert difference_keys(folder) == [("ur5-plane", why)]
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
        (lambda lines: lines[0].pop("task"), "gantry-plane robots.jsonl:1: task is None, not"),
        (lambda lines: lines.pop(), "robots.jsonl it has 3 robots, not 4"),
    ],
)
def test_a_record_changed_with_its_checksum_is_reported(bundles, change, expected):
    path = bundles / "robots.jsonl"
    records = [json.loads(line) for line in path.read_text().splitlines()]
    change(records)
    path.write_text("".join(json.dumps(record) + "\n" for record in records))
    rewrite_checksums(bundles)
    ((where, why),) = difference_keys(bundles)
    assert f"{where} {why}".startswith(expected)


@pytest.mark.parametrize("field", [PARENT, ORIGIN, GEOMETRY])
def test_tokens_changed_with_their_checksum_are_reported(bundles, field):
    def change(arrays):
        arrays["tokens"][1, 2, field.start] += 0.01

    change_tokens(bundles, change)
    why = f"tokens.npz: {field.name} of link 2 is not the robot's"
    assert difference_keys(bundles) == [("planar-cube", why)]


def test_changed_masks_names_and_missing_numbers_of_tokens_are_reported(bundles):
    change_tokens(bundles, lambda arrays: arrays["tokens"].__setitem__((2, 0, 5), np.nan))
    assert [where for where, _ in difference_keys(bundles)] == ["gantry-cylinder"]
    change_tokens(bundles, lambda arrays: arrays["tokens"].__setitem__((2, 0, 5), 0))
    change_tokens(bundles, lambda arrays: arrays["mask"].__setitem__((2, 9), True))
    assert difference_keys(bundles) == [
        ("gantry-cylinder", "tokens.npz: its mask is not that of its links")
    ]
    change_tokens(bundles, lambda arrays: arrays["names"].__setitem__(0, "other"))
    assert difference_keys(bundles) == [("tokens.npz", "it is not of the 4 robots of split.yaml")]


def test_an_exchanged_split_file_is_reported(bundles):
    other = combined(test=["base=planar ee=cylinder"])
    (bundles / "split.yaml").write_text(split_text(other))
    rewrite_checksums(bundles)
    findings = difference_keys(bundles)
    assert ("build.json", f"it is of split {split_id(combined())}, not of split.yaml") in findings
    assert ("planar-cylinder", "its folder is missing") in findings


@pytest.mark.parametrize(
    ("path", "content", "message"),
    [
        ("build.json", b'{"format": 2}', "build.json: format: unknown value 2; valid: 1"),
        ("build.json", b'{"format": 1, "split": "x", "light": true}', "build.json: light: "),
        ("SHA256SUMS", b"abc\n", "SHA256SUMS:1: expected a hash, two spaces and a path"),
        ("split.yaml", None, "split.yaml: no such file"),
        ("split.yaml", b"format: 1\n", "split.yaml:1: missing key"),
    ],
)
def test_unreadable_folders_are_errors(bundles, path, content, message):
    put(bundles / path, content)
    with pytest.raises(MorphgenError, match=message):
        verify(bundles, LIBRARY)
