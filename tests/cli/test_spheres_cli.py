"""Robots with spheres on the command line: ``fit``, ``compose`` and ``export``."""

import json
from dataclasses import replace

import mujoco
import pytest
import yaml

from helpers.robots import arm
from morphgen.formats.bundle import read_bundle, write_bundle
from morphgen.formats.srdf import read_srdf
from morphgen.formats.urdf.read import read_urdf
from morphgen.model.geometry import Pose, Shape, Sphere

pytestmark = pytest.mark.usefixtures("own_cache", "nothing_is_stored")


@pytest.fixture
def bundle(tmp_path):
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


def test_fit_writes_a_bundle_whose_urdf_and_mjcf_have_spheres_alone(run, bundle, tmp_path):
    out = tmp_path / "round"
    words = ("--spheres", "2", "--out", out, "--no-picture", "--configurations", "20", "--json")
    code, text, _ = run("fit", bundle, *words)
    assert code == 0
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


def test_exports_have_the_same_spheres(run, bundle, tmp_path):
    options = ("--spheres", "2", "--cover", "0.9", "--out", tmp_path)
    for name in ("urdf", "srdf", "curobo"):
        samples = () if name == "urdf" else ("--samples", "200")
        code, _, err = run("export", bundle, "--format", name, *options, *samples)
        assert code == 0, err
    expected = spheres_of(read_urdf(tmp_path / "arm-urdf" / "robot.urdf", written_frames=True))
    assert {link: len(of_link) for link, of_link in expected.items()} == counts(2)
    srdf = read_srdf(tmp_path / "arm.srdf")
    assert expected == {
        link.get("link"): [
            tuple(map(float, f"{s.get('center')} {s.get('radius')}".split())) for s in link
        ]
        for link in srdf.iterfind("link_sphere_approximation")
    }
    config = yaml.safe_load((tmp_path / "arm-curobo" / "robot.yml").read_text())
    kinematics = config["robot_cfg"]["kinematics"]
    assert expected == {
        link: [(*s["center"], s["radius"]) for s in spheres]
        for link, spheres in kinematics["collision_spheres"].items()
    }
    urdf = tmp_path / "arm-curobo" / kinematics["urdf_path"]
    assert spheres_of(read_urdf(urdf, written_frames=True)) == expected
    ignored = kinematics["self_collision_ignore"]
    for joint in arm().joints:
        a, b = sorted((joint.parent, joint.child))
        assert b in ignored[a]


def test_curobo_has_eight_spheres_for_a_link_by_default_and_keeps_those_of_a_link(
    run, bundle, tmp_path
):
    words = ("--format", "curobo", "--samples", "50", "--out", tmp_path)
    code, _, err = run("export", bundle, *words)
    assert code == 0, err
    config = yaml.safe_load((tmp_path / "arm-curobo" / "robot.yml").read_text())
    spheres = config["robot_cfg"]["kinematics"]["collision_spheres"]
    assert {link: len(of_link) for link, of_link in spheres.items()} == counts(8)
    assert spheres["left"] == [{"center": [0.0, 0.0, 0.05], "radius": 0.02}]


def test_compose_gives_all_links_spheres(run, tmp_path):
    code, _, err = run(
        "compose", "base=planar", "ee=cube", "--geometry", "sphere", "--no-picture", "--out", "."
    )
    assert code == 0, err
    spheres = spheres_of(read_bundle(tmp_path / "planar-cube"))
    assert {len(of_link) for of_link in spheres.values() if of_link} == {8}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("fit", "--cover", "0.9"), "--cover: only with --spheres"),
        (("fit", "--spheres", "4", "--enclose"), "--enclose: only without --spheres"),
        (("fit", "--spheres", "4", "--iou", "0.9"), "--iou: only without --spheres"),
        (("fit", "--spheres", "40"), "40 spheres: expected 1 to 32 per link"),
        (("fit", "--spheres", "4", "--cover", "1"), "cover 1: expected more than 0, at most"),
        (("export", "--format", "curobo", "--cover", "0.9"), "--cover: only with --spheres"),
        (("export", "--format", "curobo", "--spheres", "40"), "40 spheres: expected 1 to 32"),
        (
            ("export", "--format", "glb", "--spheres", "4"),
            "--spheres has no effect on --format glb; expected --format srdf, urdf, mjcf, sdf, "
            "curobo, usd or ros2",
        ),
    ],
)
def test_options_without_effect_and_invalid_values_are_refused(refused, bundle, words, message):
    command, *options = words
    assert message in refused(command, bundle, *options)
