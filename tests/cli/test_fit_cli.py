"""``morphgen fit`` of parts and robots: output, written files and rejected input."""

import json
from dataclasses import fields, replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
import yaml

from helpers.parts import write_part
from helpers.robots import arm
from morphgen.checks.srdf import read_srdf
from morphgen.fitting.link_fit import Quality
from morphgen.formats.bundle import read_bundle, write_bundle
from morphgen.formats.urdf.read import read_urdf
from morphgen.grammar.library import default_library
from morphgen.grammar.part import load_part
from morphgen.model.geometry import Box, Pose, Shape, Sphere

pytestmark = pytest.mark.usefixtures("own_cache", "nothing_is_stored")


def test_part_made_of_primitives_keeps_them(run, ok):
    out = ok("fit", "plane")
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


def test_a_bundle_with_a_picture_may_have_the_name_of_its_part(ok):
    out = ok("fit", "plane", "--out", "plane")
    assert out.splitlines()[-1] == "plane"
    assert Path("plane/preview.png").is_file()
    ok("check", "plane/")


def test_user_part_is_found_in_the_given_library(ok, tmp_path):
    write_part(tmp_path / "mine")
    out = ok("fit", "pincer", "--library", "mine", "--json")
    names = {"palm", "left", "right", "disc"}
    assert {link["link"] for link in json.loads(out)["links"]} == names


def test_flat_link_is_reported_and_the_others_are_fitted(ok, box, tmp_path):
    Path("leaf.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\n")
    shape = "<collision><geometry><mesh filename='{}'/></geometry></collision>".format
    Path("robot.urdf").write_text(
        f"<robot name='r'><link name='link'>{shape(box)}</link>"
        f"<link name='leaf'>{shape('leaf.obj')}</link><joint name='j' type='fixed'>"
        "<parent link='link'/><child link='leaf'/></joint></robot>"
    )
    words = ("--out", "made", "--no-picture")
    out = ok("fit", "robot.urdf", *words)
    _, _, row, _, finding, *_, folder = out.splitlines()
    assert (row.split()[:2], folder) == (["link", "box"], "made")
    assert finding.startswith("warning no-primitive at link leaf: ")
    card = json.loads(Path("made/card.json").read_text())
    assert [link["link"] for link in card["primitives"]["links"]] == ["link"]
    (collision,) = read_bundle(tmp_path / "made").link("link").collisions
    assert isinstance(collision.geometry, Box)
    data = json.loads(ok("fit", "robot.urdf", "--json"))
    assert [link["link"] for link in data["links"]] == ["link"]
    assert [(f["code"], f["where"]) for f in data["findings"]] == [("no-primitive", "link leaf")]


@pytest.mark.parametrize("source", ["plane", "robot"])
def test_folder_that_is_not_a_bundle_is_rejected_before_fitting(
    refused, robot_urdf, tmp_path, source
):
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "thesis.txt").write_text("years of work")
    target = robot_urdf(arm()) if source == "robot" else "plane"
    words = ("--out", "made", "--no-picture")
    assert "made exists and is not a bundle" in refused("fit", target, *words)


@pytest.mark.parametrize("named", ["source", "source/", "./source", "source/robot.urdf"])
def test_bundle_is_not_overwritten_by_its_own_fit(refused, named):
    write_bundle(arm(), Path("source"), picture=False)
    assert "is the robot itself" in refused("fit", named, "--out", "source", "--no-picture")


@pytest.fixture
def angle(tmp_path):
    """``angle.stl``, an L of two boxes that touch."""
    tall, wide = trimesh.creation.box((0.1, 0.1, 0.4)), trimesh.creation.box((0.2, 0.1, 0.1))
    tall.apply_translation((0.05, 0.05, 0.2))
    wide.apply_translation((0.2, 0.05, 0.05))
    trimesh.boolean.union([tall, wide]).export(tmp_path / "angle.stl")
    return Path("angle.stl")


def test_a_mesh_file_is_a_robot_of_one_link(ok, box, tmp_path):
    data = json.loads(ok("fit", box, "--json", "--seed", "3", "--out", "made", "--no-picture"))
    (link,) = data["links"]
    assert (data["robot"], link["solid"], link["decimated_from"]) == ("link", "watertight", None)
    (primitive,) = link["primitives"]
    np.testing.assert_allclose(sorted(primitive["box"]), (0.1, 0.2, 0.3), rtol=0.02)
    np.testing.assert_allclose(primitive["xyz"], (1.0, 2.0, 3.0), atol=2e-3)
    assert np.linalg.norm(primitive["quaternion"]) == pytest.approx(1.0)
    assert set(link["quality"]) == {each.name for each in fields(Quality)}
    assert link["quality"]["iou"] > 0.97
    (collision,) = read_bundle(tmp_path / "made").root.collisions
    assert isinstance(collision.geometry, Box)
    header, rule, row, mean = ok("fit", box, "--seed", "3").splitlines()
    assert header.split()[:4] == ["link", "primitives", "solid", "IoU"]
    assert set(rule) == {"-", " "}
    assert row.split()[:3] == ["link", "box", "watertight"]
    assert mean.split()[1] == row.split()[3] == f"{link['quality']['iou']:.3f}"


def test_options_of_a_mesh_fit_are_those_of_the_fit(ok, angle):
    two = json.loads(ok("fit", angle, "--max-primitives", "3", "--iou", "0.95", "--json"))
    assert ["box" in each for each in two["links"][0]["primitives"]] == [True, True]


@pytest.fixture
def balls(tmp_path):
    """The arm with a ball on each link but the first two, which have a box and a cylinder."""
    ball = Shape(Sphere(0.02), Pose((0.0, 0.0, 0.05)))
    links = [replace(link, collisions=(ball,)) for link in arm().links[2:]]
    return write_bundle(arm().with_links(links), tmp_path / "source", picture=False)


def counts(of_first_two):
    """Number of spheres by link."""
    names = [link.name for link in arm().links]
    return dict.fromkeys(names[:2], of_first_two) | dict.fromkeys(names[2:], 1)


def spheres_of(robot):
    """Centres and radii by link; fails if there is another collision shape."""
    assert all(isinstance(s.geometry, Sphere) for link in robot.links for s in link.collisions)
    return {
        link.name: [(*s.T_link_shape.position, s.geometry.radius) for s in link.collisions]
        for link in robot.links
    }


def test_fit_writes_a_bundle_whose_urdf_and_mjcf_have_spheres_alone(ok, balls, tmp_path):
    out = tmp_path / "round"
    words = ("--spheres", "2", "--out", out, "--no-picture", "--json")
    text = ok("fit", balls, *words)
    report = json.loads(text)
    assert (report["spheres"], report["cover"]) == (2, None)
    assert {link["link"]: len(link["primitives"]) for link in report["links"]} == counts(2)
    assert all(0 < link["quality"]["protrusion_share"] < 1 for link in report["links"][:2])
    spheres = spheres_of(read_urdf(out / "robot.urdf", written_frames=True))
    assert {link: len(of_link) for link, of_link in spheres.items()} == counts(2)
    assert spheres == spheres_of(read_bundle(out))
    model = mujoco.MjModel.from_xml_path(str(out / "robot.xml"))
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    assert set(model.geom_type[collides].tolist()) == {int(mujoco.mjtGeom.mjGEOM_SPHERE)}
    assert collides.sum() == sum(counts(2).values())


def test_exports_have_the_spheres_of_the_robot(ok, balls, tmp_path):
    words = ("--spheres", "2", "--cover", "0.9", "--out", "round", "--no-picture")
    ok("fit", balls, *words)
    for name in ("urdf", "srdf", "curobo"):
        ok("export", "round", "--format", name, "--out", tmp_path)
    expected = spheres_of(read_urdf(tmp_path / "round-urdf" / "robot.urdf", written_frames=True))
    assert {link: len(of_link) for link, of_link in expected.items()} == counts(2)
    srdf = read_srdf(tmp_path / "round.srdf")
    read = {
        link.get("link"): [
            tuple(map(float, f"{s.get('center')} {s.get('radius')}".split())) for s in link
        ]
        for link in srdf.iterfind("link_sphere_approximation")
    }
    assert read == {link: spheres for link, spheres in expected.items() if spheres}
    folder = tmp_path / "round-curobo"
    kinematics = yaml.safe_load((folder / "robot.yml").read_text())["robot_cfg"]["kinematics"]
    assert expected == {
        link: [(*s["center"], s["radius"]) for s in spheres]
        for link, spheres in kinematics["collision_spheres"].items()
    }
    assert spheres_of(read_urdf(folder / kinematics["urdf_path"], written_frames=True)) == expected
