"""Robots are found at their places, and nowhere else."""

import tempfile
from pathlib import Path

import pytest

from helpers.robots import arm
from morphgen.benchmark.robot_hash import robot_hash
from morphgen.errors import MorphgenError
from morphgen.formats.bundle import write_bundle
from morphgen.grammar.library import default_library
from morphgen.viewer.robot_rows import (
    folder_entries,
    neighbours,
    part_entries,
    split_entries,
    subfolders,
)
from morphgen.viewer.robot_uri import (
    FileAccess,
    UriError,
    content_hash,
    read_robot_uri,
    resolve_split,
    with_library_meshes,
)
from morphgen.viewer.targets import target_address


@pytest.fixture
def places(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_bundle(arm(), tmp_path / "robots" / "one", picture=False)
    (tmp_path / "uploads").mkdir()
    return FileAccess(
        default_library().folders, (tmp_path.resolve(),), (tmp_path / "uploads").resolve()
    )


SPLIT = "extrapolation/primitives/reach"


@pytest.mark.parametrize(
    ("words", "query"),
    [
        ([], "?library="),
        (["robots"], "?gallery=robots"),
        (["robots/one"], "?robot=robots/one"),
        (["robots/one/robot.urdf"], "?robot=robots/one/robot.urdf"),
        ([SPLIT], f"?split={SPLIT}"),
        (["multi_finger"], "?compose=multi_finger"),
        (["base=planar", "ee=cube"], "?robot=words:base=planar%20ee=cube"),
    ],
)
def test_a_target_is_what_it_is(places, words, query):
    assert target_address(words, places).query == query


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["robotz"], "no such file or folder, no split and no grammar"),
        (["extrapolation/arm/reach"], "did you mean 'extrapolation/arms/reach'"),
        (["arm=ur6"], "did you mean 'ur5'|nearest"),
        (["/etc"], "outside of the folders"),
    ],
)
def test_an_unknown_target_is_refused(places, words, why):
    with pytest.raises(MorphgenError, match=why):
        target_address(words, places)


@pytest.mark.parametrize(
    ("place", "name"),
    [
        ("robots/one", "arm"),
        ("robots/one/robot.urdf", "arm"),
        ("words:base=planar ee=cube", "planar-cube"),
        ("derivation:base=planar[top: ee=cube]", "planar-cube"),
        (f"split:{SPLIT}@test/chain-000001", "chain-000001"),
    ],
)
def test_robots_are_read(places, place, name):
    robot = read_robot_uri(place, places)
    assert robot.name.startswith(name)
    assert robot.dof > 0


@pytest.mark.parametrize(
    "place",
    ["../x", "/etc/passwd", "upload:../../etc/passwd", "robots/../../x", "upload:/etc/hostname"],
)
def test_nothing_outside_is_read(places, place):
    with pytest.raises(UriError, match="outside of the folders"):
        read_robot_uri(place, places)


@pytest.mark.parametrize(
    ("place", "why"),
    [
        (f"split:{SPLIT}@both/x", "expected split:NAME@train/ROBOT"),
        (f"split:{SPLIT}@test/chain-000009", "did you mean 'chain-000001'|no test robot"),
        ("split:nothing@test/x", "no such file"),
        ("words:arm", "'arm' is no part"),
    ],
)
def test_bad_places_say_why(places, place, why):
    with pytest.raises(MorphgenError, match=why):
        read_robot_uri(place, places)


def test_a_key_changes_with_the_file(places):
    before = content_hash("robots/one", places)
    assert content_hash("robots/one", places) == before
    urdf = places.path("robots/one/robot.urdf")
    urdf.write_text(urdf.read_text() + "\n")
    assert content_hash("robots/one", places) != before
    words = content_hash("words:base=planar ee=cube", places)
    assert words == content_hash("derivation:" + str(_derivation(places)), places)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("{uploads}/ab/a.urdf:3: bad", "upload:ab/a.urdf:3: bad"),
        ("{uploads}: bad", "upload:: bad"),
        ("{root}/robots/a: bad", "robots/a: bad"),
        ("{root} is no bundle", ". is no bundle"),
        ("{temporary}/tmpa1_b2/robot/robot.urdf: bad", "robot.urdf: bad"),
        ("{temporary}/tmpa1_b2/episode.mp4: bad", "episode.mp4: bad"),
        ("{temporary}/morphgen-uploads-x/a: bad", "a: bad"),
        ("x" * 2000, "x" * 1000 + "..."),
        ("a\0b\nc", "a\\x00b\\nc"),
    ],
)
def test_a_page_tells_no_folder_of_the_machine(text, told):
    root, temporary = Path("/home/me/work"), tempfile.gettempdir()
    places = FileAccess((), (root,), Path(temporary) / "morphgen-uploads-1")
    given = text.format(uploads=places.uploads, root=root, temporary=temporary)
    assert places.told(given) == told


def _derivation(places):
    from morphgen.viewer.robot_uri import resolve_derivation

    return resolve_derivation("words:base=planar ee=cube", places)


def test_a_bundle_takes_the_librarys_meshes_only_if_it_is_the_same(places, tmp_path):
    made = read_robot_uri("words:arm=ur5 ee=plane", places)
    bundle = write_bundle(made, tmp_path / "robots" / "ur5", picture=False)
    read = read_robot_uri("robots/ur5", places)
    assert robot_hash(with_library_meshes(read, places.library)) == robot_hash(made)
    text = (bundle / "robot.urdf").read_text()
    (bundle / "robot.urdf").write_text(text.replace('mass value="3.7"', 'mass value="3.8"'))
    changed = read_robot_uri("robots/ur5", places)
    assert changed.mass != made.mass
    assert with_library_meshes(changed, places.library) is changed


def test_folders_are_listed(places, tmp_path):
    broken = write_bundle(arm(), tmp_path / "robots" / "two", picture=False)
    (broken / "card.json").write_text("{")
    (tmp_path / "robots" / "three.urdf").write_text("<robot/>")
    rows = folder_entries("robots", places)
    assert [(row.name, row.dof, row.findings) for row in rows] == [
        ("one", 4, ()),
        ("three.urdf", None, None),
        ("two", None, ("unreadable",)),
    ]
    assert subfolders(tmp_path) == ["robots"]
    with pytest.raises(UriError, match="holds no robot"):
        folder_entries("uploads", places)


def test_splits_and_parts_are_listed(places):
    rows = split_entries(SPLIT, resolve_split(SPLIT, places))
    assert [row.role for row in rows] == ["train"] * 10 + ["test"] * 2
    assert neighbours(rows[1].place, places) == (rows[0].place, rows[2].place)
    assert neighbours(rows[0].place, places)[0] == ""
    parts = part_entries(places.library)
    assert {row.role for row in parts} == {"arm", "ee", "body"}
    assert "words:arm=ur5" in [row.place for row in parts]
