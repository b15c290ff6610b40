"""Stored fits in bundles: carried over, validated, and ignored when shapes change."""

import json
import shutil

import pytest
import trimesh

import morphgen
from morphgen.errors import FormatError
from morphgen.fitting import token_shapes as module
from morphgen.fitting.replace_collision import as_primitives
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.bundle import read_bundle, write_bundle
from morphgen.formats.fits import FITS

WORDS = "arm=ur5 ee=plane"
ROBOT = morphgen.compose(WORDS)


@pytest.fixture(autouse=True)
def no_search(monkeypatch, tmp_path):
    monkeypatch.setattr(module, "user_cache_path", lambda name: tmp_path / "cache" / name)
    monkeypatch.setattr(
        module, "fit_primitive", lambda shapes: pytest.fail("a fit was searched for")
    )


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Return the folder of a bundle of the UR5."""
    return write_bundle(ROBOT, tmp_path_factory.mktemp("r") / "ur5", picture=False)


@pytest.fixture
def folder(written, tmp_path):
    return shutil.copytree(written, tmp_path / "ur5")


def test_a_bundle_contains_the_fits_of_its_parts(folder):
    back = read_bundle(folder)
    assert token_shapes(back) == token_shapes(ROBOT)
    ours, theirs = (
        [link.collisions for link in as_primitives(each, ()).links] for each in (ROBOT, back)
    )
    assert ours == theirs


def test_token_shapes_do_not_depend_on_the_collision_geometry(tmp_path):
    primitive_robot = morphgen.compose(WORDS, geometry="primitive")
    back = read_bundle(write_bundle(primitive_robot, tmp_path / "prims", picture=False))
    assert token_shapes(primitive_robot) == token_shapes(back) == token_shapes(ROBOT)
    assert token_shapes(ROBOT)["arm_upper_arm_link"].geometry.radius == pytest.approx(
        0.0545, abs=1e-4
    )


def test_fits_are_kept_when_a_bundle_is_rewritten(folder, tmp_path):
    again = write_bundle(read_bundle(folder), tmp_path / "again", picture=False)
    assert (again / FITS).read_bytes() == (folder / FITS).read_bytes()


def test_a_robot_without_meshes_has_no_fits_file(tmp_path):
    folder = write_bundle(morphgen.compose("prims"), tmp_path / "prims", picture=False)
    assert not (folder / FITS).exists()


def test_an_edited_mesh_does_not_use_the_fit_of_the_original(folder):
    link = read_bundle(folder).link("arm_forearm_link")
    path = link.collisions[0].geometry.path
    trimesh.creation.box((0.1, 0.2, 0.3)).export(path)
    with pytest.raises(pytest.fail.Exception, match="searched"):
        token_shapes(read_bundle(folder))


def test_fits_of_another_fitter_version_are_ignored(folder):
    data = json.loads((folder / FITS).read_text())
    (folder / FITS).write_text(json.dumps(data | {"fitter": 1}))
    assert read_bundle(folder).fits == {}


def test_links_to_fits_outside_the_bundle_are_not_followed(folder, tmp_path):
    (folder / FITS).rename(tmp_path / "elsewhere.json")
    (folder / FITS).symlink_to(tmp_path / "elsewhere.json")
    with pytest.raises(FormatError, match="leaves its folder"):
        read_bundle(folder)


def test_invalid_fits_are_an_error_that_names_the_file(folder):
    data = json.loads((folder / FITS).read_text())
    data["links"][0]["token_iou"] = 7
    (folder / FITS).write_text(json.dumps(data))
    with pytest.raises(FormatError, match=rf"{FITS}.*invalid value 7"):
        read_bundle(folder)
