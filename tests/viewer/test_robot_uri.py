"""Robot URIs resolve only to files inside the served folders."""

import tempfile
from dataclasses import replace
from pathlib import Path

import pytest

from helpers.robots import arm
from morphgen.encoding.robot_hash import robot_hash
from morphgen.errors import MorphgenError
from morphgen.formats.bundle import write_bundle
from morphgen.grammar.library import default_library
from morphgen.viewer.app.app import start_address
from morphgen.viewer.robot_rows import (
    folder_rows,
    neighbour_uris,
    part_rows,
    robot_subfolders,
    split_rows,
)
from morphgen.viewer.robot_uri import (
    FileAccess,
    UriError,
    content_hash,
    read_robot_uri,
    resolve_derivation,
    resolve_split,
    with_library_meshes,
)


@pytest.fixture
def files(tmp_path, monkeypatch):
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
        (["planar-cube"], "?robot=words:base=planar%20ee=cube"),
    ],
)
def test_a_target_opens_its_page(files, words, query):
    assert start_address(words, files).query == query


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["robotz"], "no such file or folder, .*, no split and no grammar; .* are valid, such as"),
        (["planar-cubw"], "'cubw' is not a part; did you mean 'cube'"),
        (["extrapolation/arm/reach"], "did you mean 'extrapolation/arms/reach'"),
        (["arm=ur6"], "did you mean 'ur5'|nearest"),
        (["/etc"], "outside of the folders"),
    ],
)
def test_an_unknown_target_is_rejected(files, words, why):
    with pytest.raises(MorphgenError, match=why):
        start_address(words, files)


@pytest.mark.parametrize(
    ("uri", "name"),
    [
        ("robots/one", "arm"),
        ("robots/one/robot.urdf", "arm"),
        ("words:base=planar ee=cube", "planar-cube"),
        ("derivation:base=planar[top: ee=cube]", "planar-cube"),
        (f"split:{SPLIT}@test/chain-000001", "chain-000001"),
    ],
)
def test_robots_are_read(files, uri, name):
    robot = read_robot_uri(uri, files)
    assert robot.name.startswith(name)
    assert robot.dof > 0


@pytest.mark.parametrize(
    "uri",
    ["../x", "/etc/passwd", "upload:../../etc/passwd", "robots/../../x", "upload:/etc/hostname"],
)
def test_files_outside_are_not_read(files, uri):
    with pytest.raises(UriError, match="outside of the folders"):
        read_robot_uri(uri, files)


@pytest.mark.parametrize(
    ("uri", "why"),
    [
        (f"split:{SPLIT}@both/x", "expected split:NAME@train/ROBOT"),
        (f"split:{SPLIT}@test/chain-000009", "did you mean 'chain-000001'|no test robot"),
        ("split:nothing@test/x", "no such file"),
        ("words:arm", "'arm' is not a part"),
    ],
)
def test_invalid_uris_give_the_reason(files, uri, why):
    with pytest.raises(MorphgenError, match=why):
        read_robot_uri(uri, files)


def test_the_content_hash_changes_with_the_file(files):
    before = content_hash("robots/one", files)
    assert content_hash("robots/one", files) == before
    urdf = files.path("robots/one/robot.urdf")
    urdf.write_text(urdf.read_text() + "\n")
    assert content_hash("robots/one", files) != before
    words = "words:base=planar ee=cube"
    derivation = f"derivation:{resolve_derivation(words, files)}"
    assert content_hash(words, files) == content_hash(derivation, files)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{uploads}/ab/a.urdf:3: bad", "upload:ab/a.urdf:3: bad"),
        ("{uploads}: bad", "upload:: bad"),
        ("{root}/robots/a: bad", "robots/a: bad"),
        ("{root} is not a bundle", ". is not a bundle"),
        ("{temporary}/tmpa1_b2/robot/robot.urdf: bad", "robot.urdf: bad"),
        ("{temporary}/tmpa1_b2/episode.mp4: bad", "episode.mp4: bad"),
        ("{temporary}/morphgen-uploads-x/a: bad", "a: bad"),
        ("x" * 2000, "x" * 1000 + "..."),
        ("a\0b\nc", "a\\x00b\\nc"),
    ],
)
def test_errors_contain_no_absolute_paths(text, expected):
    root, temporary = Path("/home/me/work"), tempfile.gettempdir()
    files = FileAccess((), (root,), Path(temporary) / "morphgen-uploads-1")
    given = text.format(uploads=files.uploads, root=root, temporary=temporary)
    assert files.redact(given) == expected


def test_bundle_uses_library_meshes_only_if_the_robot_is_unchanged(files, tmp_path):
    made = read_robot_uri("words:arm=ur5 ee=plane", files)
    bundle = write_bundle(made, tmp_path / "robots" / "ur5", picture=False)
    read = read_robot_uri("robots/ur5", files)
    assert robot_hash(with_library_meshes(read, files.library)) == robot_hash(made)
    text = (bundle / "robot.urdf").read_text()
    (bundle / "robot.urdf").write_text(text.replace('mass value="3.7"', 'mass value="3.8"'))
    changed = read_robot_uri("robots/ur5", files)
    assert changed.mass != made.mass
    assert with_library_meshes(changed, files.library) is changed


def test_folders_are_listed(files, tmp_path):
    broken = write_bundle(arm(), tmp_path / "robots" / "two", picture=False)
    (broken / "card.json").write_text("{")
    (tmp_path / "robots" / "three.urdf").write_text("<robot/>")
    rows = folder_rows("robots", files)
    assert [(row.name, row.dof, row.findings) for row in rows] == [
        ("one", 4, ()),
        ("three.urdf", None, None),
        ("two", None, ("unreadable",)),
    ]
    assert robot_subfolders(tmp_path) == ["robots"]
    with pytest.raises(UriError, match="holds no robot"):
        folder_rows("uploads", files)


def test_a_part_without_a_licence_leaves_the_facts_of_its_card(files, tmp_path):
    parts = [{"label": "arm", "part": "a"}, {"label": "ee", "part": "b", "licence": "MIT"}]
    robot = replace(arm(), provenance={"parts": parts})
    write_bundle(robot, tmp_path / "robots" / "four", picture=False)
    row = next(row for row in folder_rows("robots", files) if row.name == "four")
    assert (row.dof, row.licence, row.findings) == (4, "MIT", ())


def test_the_folder_of_all_uploads_has_no_address(files):
    (files.uploads / "secret").mkdir(parents=True)
    assert files.path("upload:secret").name == "secret"
    for uri in ("upload:", "upload:.", "upload:secret/.."):
        with pytest.raises(UriError, match="no such file or folder"):
            files.path(uri)


def test_splits_and_parts_are_listed(files):
    rows = split_rows(SPLIT, resolve_split(SPLIT, files))
    assert [row.role for row in rows] == ["train"] * 10 + ["test"] * 2
    assert neighbour_uris(rows[1].uri, files) == (rows[0].uri, rows[2].uri)
    assert neighbour_uris(rows[0].uri, files)[0] == ""
    parts = part_rows(files.library)
    assert {row.role for row in parts} == {"arm", "ee", "body", "object"}
    assert "words:arm=ur5" in [row.uri for row in parts]
