"""``morphgen fit`` of parts and robots: output, written files and rejected input."""

import json
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh

from helpers.commands import tree
from helpers.parts import write_part
from helpers.robots import arm
from morphgen.formats import bundle
from morphgen.formats.bundle import read_bundle, write_bundle
from morphgen.grammar.library import default_library
from morphgen.grammar.part import load_part
from morphgen.model.geometry import Box, Cylinder, Mesh, Pose, Shape, Sphere
from morphgen.model.inertia import with_inertia
from morphgen.model.robot import Link

pytestmark = pytest.mark.usefixtures("nothing_is_stored")


@pytest.fixture
def meshed(tmp_path):
    """A bundle in ``source``: the arm with a box's mesh on its base and on both fingers."""
    folder = tmp_path / "meshes"
    folder.mkdir()
    block, finger = trimesh.creation.box((0.1, 0.1, 0.04)), trimesh.creation.box((0.02, 0.01, 0.08))
    block.export(folder / "block.stl")
    finger.export(folder / "finger.stl")
    red = (1.0, 0.0, 0.0, 1.0)
    on_base = Shape(Mesh(folder / "block.stl"), rgba=red)
    on_finger = Shape(Mesh(folder / "finger.stl"), Pose((0.0, 0.0, 0.05)), red)
    shapes = {"base": on_base, "left": on_finger, "right": on_finger}
    links = [
        with_inertia(Link(name, visuals=(shape,), collisions=(shape,)), 2000.0)
        for name, shape in shapes.items()
    ]
    return write_bundle(arm().with_links(links), tmp_path / "source", picture=False).relative_to(
        tmp_path
    )


def meshes_of(folder, kind):
    """File names of meshes in a bundle's URDF: ``collision`` or ``visual``."""
    root = ElementTree.parse(folder / "robot.urdf").getroot()
    return [mesh.get("filename") for mesh in root.findall(f"link/{kind}/geometry/mesh")]


def assert_same_inertials(fitted, source):
    """Assert equal masses and inertias of the links, up to the digits of a URDF."""
    assert [link.name for link in fitted.links] == [link.name for link in source.links]
    for link, before in zip(fitted.links, source.links, strict=True):
        if before.inertial is None:
            assert link.inertial is None or link.inertial.mass == 0
            continue
        assert link.inertial.mass == pytest.approx(before.inertial.mass, rel=1e-9)
        np.testing.assert_allclose(link.inertial.com, before.inertial.com, atol=1e-9)
        np.testing.assert_allclose(
            link.inertial.inertia, before.inertial.inertia, rtol=1e-6, atol=1e-12
        )


def test_part_made_of_primitives_keeps_them(run):
    code, out, err = run("fit", "plane")
    assert (code, err) == (0, "")
    _, _, plate, mean = out.splitlines()
    assert plate.split()[:4] == ["plate", "box", "primitives", "1.000"]
    assert mean.split()[:2] == ["mean", "1.000"]
    data = json.loads(run("fit", "plane", "--json")[1])
    (collision,) = load_part(default_library().manifest("plane")).fragment.link("plate").collisions
    (link,) = data["links"]
    assert data["robot"] == "plane"
    assert link["primitives"][0]["box"] == list(collision.geometry.size)
    assert link["primitives"][0]["xyz"] == list(collision.T_link_shape.position)
    assert data["findings"] == []


def test_bundle_may_have_the_name_of_its_part(run, tmp_path):
    code, out, err = run("fit", "plane", "--out", "plane", "--no-picture")
    assert (code, err) == (0, "")
    assert out.splitlines()[-1] == "plane"
    assert run("check", "plane")[0] == 0


def test_user_part_is_found_in_the_given_library(run, tmp_path):
    write_part(tmp_path / "mine")
    code, out, err = run("fit", "pincer", "--library", "mine", "--json")
    assert (code, err) == (0, "")
    names = {"palm", "left", "right", "disc"}
    assert {link["link"] for link in json.loads(out)["links"]} == names


@pytest.mark.slow
def test_fitted_part_has_no_collision_meshes(run, tmp_path):
    """The Fetch gripper has a palm and two identical fingers."""
    words = ("fit", "fetch_gripper", "--out", "made/gripper", "--no-picture", "--json")
    code, out, err = run(*words, "--configurations", "50")
    assert (code, err) == (0, "")
    data = json.loads(out)
    fits = {link["link"]: link for link in data["links"]}
    assert fits["l_gripper_finger_link"]["same_as"] == "r_gripper_finger_link"
    assert all(link["quality"]["iou"] > 0.9 for link in fits.values())
    assert {"precision", "recall", "accuracy"} <= set(data["agreement"])
    folder = tmp_path / "made" / "gripper"
    assert [path.name for path in folder.parent.iterdir()] == ["gripper"]
    assert meshes_of(folder, "collision") == []
    assert meshes_of(folder, "visual") != []
    fitted, source = (
        read_bundle(folder),
        load_part(default_library().manifest("fetch_gripper")).fragment,
    )
    assert fitted.name == "gripper"
    assert_same_inertials(fitted, source)
    assert [joint.name for joint in fitted.joints] == [joint.name for joint in source.joints]
    for link in fitted.links:
        kinds = {type(shape.geometry) for shape in link.collisions}
        assert kinds <= {Box, Cylinder, Sphere}
        assert bool(kinds) == bool(source.link(link.name).collisions)
    code, out, err = run("check", folder, "--json")
    (report,) = json.loads(out).values()
    assert code == 0
    assert not [f for f in report["findings"] if f["severity"] == "error"]


@pytest.mark.slow
def test_a_bundle_is_fitted_link_by_link(run, meshed, tmp_path):
    code, out, err = run("fit", meshed, "--out", "made", "--no-picture", "--configurations", "50")
    assert (code, err) == (0, "")
    lines = out.splitlines()
    rows = {line.split()[0]: line.split() for line in lines[2:9]}
    assert list(rows) == ["base", "upper", "lower", "slider", "left", "right", "mean"]
    assert rows["base"][1:3] == ["box", "watertight"]
    assert rows["upper"][1:3] == ["cylinder", "primitives"]
    assert rows["right"][1:4] == ["box", "as", "left"]
    assert "collisions in 50 random configurations" in out
    assert lines[-1] == "made"
    fitted, source = read_bundle(tmp_path / "made"), read_bundle(tmp_path / meshed)
    assert meshes_of(tmp_path / "made", "collision") == []
    assert len(meshes_of(tmp_path / "made", "visual")) == 3
    assert_same_inertials(fitted, source)
    assert (fitted.name, fitted.home, fitted.frames) == ("made", source.home, source.frames)
    assert replace(fitted, name="x").joints == source.joints
    assert run("check", "made")[0] == 0
    assert run("check", meshed)[0] == 0
    card = json.loads((tmp_path / "made" / "card.json").read_text())
    assert {link["link"] for link in card["primitives"]["links"]} == set(rows) - {"mean"}


@pytest.mark.slow
def test_visual_option_replaces_visuals_and_keeps_their_colour(run, meshed, tmp_path):
    words = ("fit", meshed, "--visual", "--out", "made", "--no-picture", "--configurations", "1")
    assert run(*words)[0] == 0
    assert meshes_of(tmp_path / "made", "visual") == []
    assert not (tmp_path / "made" / "meshes").exists()
    base = read_bundle(tmp_path / "made").link("base")
    assert [shape.rgba for shape in base.visuals] == [(1.0, 0.0, 0.0, 1.0)]
    assert [shape.geometry for shape in base.visuals] == [
        shape.geometry for shape in base.collisions
    ]


def urdf_of(folder, *files):
    """``robot.urdf``: links with one mesh each, side by side."""
    links = "".join(
        f'<link name="{path.stem}"><collision><geometry><mesh filename="{path.name}"/></geometry>'
        "</collision></link>"
        for path in files
    )
    joints = "".join(
        f'<joint name="to_{path.stem}" type="fixed"><parent link="{files[0].stem}"/>'
        f'<child link="{path.stem}"/></joint>'
        for path in files[1:]
    )
    (folder / "robot.urdf").write_text(f'<robot name="r">{links}{joints}</robot>')
    return "robot.urdf"


@pytest.mark.slow
def test_repeated_fit_writes_the_same_bytes(run, box, tmp_path):
    urdf = urdf_of(tmp_path, box)
    words = ("--no-picture", "--configurations", "1")
    assert run("fit", urdf, "--out", "a/robot", *words)[0] == 0
    assert run("fit", urdf, "--out", "b/robot", *words)[0] == 0
    assert tree(tmp_path / "a") == tree(tmp_path / "b")


def test_picture_is_written_by_default(run, tmp_path):
    assert run("fit", "plane", "--out", "made", "--configurations", "1")[0] == 0
    assert (tmp_path / "made" / "preview.png").is_file()


def flat(path):
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\n")
    return path


@pytest.mark.parametrize("output", [(), ("--json",)])
def test_flat_link_is_reported_and_the_others_are_fitted(run, box, tmp_path, output):
    urdf = urdf_of(tmp_path, box, flat(tmp_path / "leaf.obj"))
    code, out, err = run("fit", urdf, *output)
    assert (code, err) == (0, "")
    if output:
        data = json.loads(out)
        assert [link["link"] for link in data["links"]] == ["link"]
        (flat_finding,) = data["findings"]
        assert (flat_finding["code"], flat_finding["where"]) == ("no-primitive", "link leaf")
    else:
        _, _, row, _, finding = out.splitlines()
        assert row.split()[:2] == ["link", "box"]
        assert finding.startswith("warning no-primitive at link leaf: ")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("", "name a part, a robot or a mesh file, or say --all"),
        ("plane --all", "name a part, a robot or a mesh file, or say --all"),
        ("plnae", "did you mean 'plane'?"),
        ("lost.stl", "lost.stl: no such file"),
        ("lost.urdf", "lost.urdf"),
        (".", ". holds no robot; expected a bundle"),
        ("plane --missing", "--missing: only with --all"),
        ("plane --max-primitives 0", "0 primitives: expected 1 to 32"),
        ("plane --max-primitives -1", "-1 primitives: expected 1 to 32"),
        ("plane --max-primitives 33", "33 primitives: expected 1 to 32"),
        ("plane --max-primitives 2 --iou 2", "IoU 2.0: expected more than 0, at most 1"),
        ("plane --max-primitives 2 --iou 0", "IoU 0.0: expected"),
        ("plane --max-primitives 2 --iou nan", "IoU nan: expected"),
        ("plane --iou 0.9", "--iou: only with --max-primitives"),
        ("plane --configurations 1000", "--configurations: only with --out"),
        ("plane --iou 0.9 --spheres 4", "--iou: only without --spheres"),
        ("--all --max-primitives 2 --seed 3", "--max-primitives --seed: only without --all"),
        ("--all --out made", "--out: only without --all"),
        ("--all --enclose --visual", "--enclose --visual: only without --all"),
        ("--all --no-picture --configurations 5", "--no-picture --configurations: only without"),
        ("--all --iou 0.5 --seed 1", "--iou --seed: only without --all"),
        ("plane --library nowhere", "nowhere does not exist"),
        ("plane --out ..", "name"),
        ("plane --out made/.hidden", "name '.hidden': use letters"),
    ],
)
def test_invalid_arguments_are_rejected(refused, words, message):
    assert message in refused("fit", *words.split())


def test_folder_named_like_a_part_does_not_hide_the_part(run, tmp_path):
    (tmp_path / "plane").mkdir()
    code, out, _ = run("fit", "plane", "--json")
    assert (code, [link["link"] for link in json.loads(out)["links"]]) == (0, ["plate"])


@pytest.mark.parametrize("source", ["plane", "robot"])
def test_folder_that_is_not_a_bundle_is_rejected_before_fitting(
    refused, robot_urdf, tmp_path, source
):
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "thesis.txt").write_text("years of work")
    target = robot_urdf(arm()) if source == "robot" else "plane"
    words = ("--out", "made", "--no-picture", "--configurations", "1")
    assert "made exists and is not a bundle" in refused("fit", target, *words)


@pytest.mark.parametrize("named", ["source", "source/", "./source", "source/robot.urdf"])
def test_bundle_is_not_overwritten_by_its_own_fit(refused, meshed, named):
    assert "is the robot itself" in refused("fit", named, "--out", "source", "--no-picture")


def test_robot_without_shapes_is_rejected(refused, tmp_path):
    (tmp_path / "bare.urdf").write_text('<robot name="r"><link name="a"/></robot>')
    assert "robot 'r': no link has a shape" in refused("fit", "bare.urdf")


def test_robot_with_an_invalid_mesh_is_rejected_with_the_file_name(refused, tmp_path):
    (tmp_path / "empty.stl").write_bytes(b"")
    shape = '<visual><geometry><mesh filename="empty.stl"/></geometry></visual>'
    (tmp_path / "r.urdf").write_text(f'<robot name="r"><link name="a">{shape}</link></robot>')
    assert "empty.stl" in refused("fit", "r.urdf", "--out", "made")


@pytest.mark.parametrize("step", ["urdf_text", "card_text"])
def test_interrupted_fit_leaves_no_partial_bundle(run, tmp_path, monkeypatch, step):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(bundle, step, interrupt)
    code, _, err = run("fit", "plane", "--out", "made", "--no-picture", "--configurations", "1")
    assert (code, err) == (130, "morphgen: interrupted; nothing half-written is left\n")
    assert tree(tmp_path) == {}
