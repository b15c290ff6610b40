"""Conformance: all loaders agree on our bundles, and disagreements are reported."""

import re
from dataclasses import replace
from importlib.util import find_spec

import mujoco
import pytest
import trimesh

from helpers.faulty_robots import hinge, with_end, with_joint, with_link
from helpers.robots import arm, rod
from morphgen.checks import conformance as module
from morphgen.checks.conformance import compare, compare_file, conformance
from morphgen.errors import FormatError
from morphgen.formats.bundle import write_bundle
from morphgen.formats.resolve import default_finder
from morphgen.formats.urdf import read as urdf
from morphgen.model.geometry import Capsule, Mesh, Pose, Shape
from morphgen.model.robot import Frame, Inertial, Joint, Link, Mimic, Robot
from morphgen.model.tree import rename

LOADERS = ["yourdfpy", "pybullet", "mujoco (urdf)", "mujoco (mjcf)", "pinocchio"]


def massless_tree():
    """A robot with a massless root, massless links and every kind of joint."""
    strength = {"effort": 10.0, "velocity": 1.0}
    links = (
        Link("root"),
        Link("x"),
        Link("turn", collisions=(Shape(Capsule(0.02, 0.1)),)),
        rod("heavy"),
        Link("bracket"),
        rod("follower", 0.2),
    )
    joints = (
        Joint("x", "prismatic", "root", "x", axis=(0.6, 0.8, 0), limits=(-0.5, 0.5), **strength),
        Joint("turn", "continuous", "x", "turn", Pose.from_xyz_rpy((0, 0, 0.1), (0.3, 0.4, 0.5))),
        Joint("swing", "revolute", "turn", "heavy", axis=(0, 1, 0), limits=(-1.0, 2.0), **strength),
        Joint("fix", "fixed", "heavy", "bracket", Pose.from_xyz_rpy((0.1, 0, 0.3), (1.5, 0, 3))),
        Joint("follow", "revolute", "bracket", "follower", limits=(-3.0, 3.0), **strength),
    )
    follow = replace(joints[-1], mimic=Mimic("swing", -0.5, 0.2))
    tool = Frame("tool", "follower", Pose.from_xyz_rpy((0.01, 0.02, 0.2), (0.1, 0.2, 0.3)))
    return Robot("massless", links, (*joints[:-1], follow), (tool,), home=(0.0, 0.1, 0.2))


def bundle(robot, tmp_path):
    return write_bundle(robot, tmp_path / "bundle", picture=False)


def rough():
    return with_joint(arm(), "shoulder", damping=0.3, friction=0.2)


@pytest.mark.parametrize("make", [rough, massless_tree])
def test_all_loaders_agree(make, tmp_path):
    report = conformance(bundle(make(), tmp_path), samples=20)
    assert [row.loader for row in report.rows] == LOADERS
    assert report.passed
    assert report.frame == "tool"
    for row in report.rows:
        if row.loader == "pybullet" and find_spec("pybullet") is None:
            assert row.message == "not installed"
            continue
        assert row.passed, row
        assert row.joints
        assert row.message == ""
        assert row.mass == pytest.approx(make().mass, rel=1e-6)
        assert row.position_error < 1e-5
        assert row.rotation_error < 1e-5
        mimic = None if row.loader == "pybullet" else True
        gains = True if row.loader == "mujoco (mjcf)" else None
        assert (row.mimic, row.gains) == (mimic, gains)


@pytest.mark.parametrize("robot", [arm(), Robot("block", (rod("block"),))])
def test_robots_without_tool_or_joints_are_compared_at_their_last_link(robot, tmp_path):
    report = conformance(bundle(replace(robot, frames=()), tmp_path), samples=3)
    assert report.passed
    assert report.frame == robot.links[-1].name


def rows_of(robot, folder):
    report = compare(robot, folder, samples=5)
    assert not report.passed
    return {row.loader: row for row in report.rows if row.passed is not None}


def moved(robot):
    T = robot.joints[0].T_parent_joint
    return with_joint(robot, "shoulder", T_parent_joint=Pose((0.0, 2e-5, 0.0)) @ T)


def turned_tool(robot):
    (tool,) = robot.frames
    T = tool.T_link_frame @ Pose.from_xyz_rpy(rpy=(0, 0, 3e-5))
    return replace(robot, frames=(replace(tool, T_link_frame=T),))


def with_mass(robot, name, mass):
    return with_link(robot, name, inertial=replace(robot.link(name).inertial, mass=mass))


@pytest.mark.parametrize(
    ("change", "message", "readers"),
    [
        (moved, "^tool is 2e-05 m off$", LOADERS),
        (turned_tool, r"^tool is (3|2\.9\d|3\.0\d)e-05 rad off$", LOADERS),
        (lambda robot: with_mass(robot, "base", 1.0), "weighs", LOADERS),
        (lambda robot: rename(robot, {}, {"shoulder": "hip"}), "lacks joints hip; has", LOADERS),
        (
            lambda robot: with_joint(robot, "right", mimic=Mimic("left", -0.5, 0.1)),
            "joint right: -1 left [+]0, not -0.5 left [+]0.1",
            [name for name in LOADERS if name != "pybullet"],
        ),
    ],
)
def test_each_loader_that_reads_it_notices_another_robot(change, message, readers, tmp_path):
    rows = rows_of(change(arm()), bundle(arm(), tmp_path))
    assert all(re.search(message, rows[name].message) for name in rows.keys() & {*readers})


def test_a_missing_tool_is_noticed(tmp_path):
    rows = rows_of(arm(), bundle(replace(arm(), frames=()), tmp_path))
    assert all("'tool'" in row.message for row in rows.values())


def test_a_rejected_file_fails_the_row_of_its_loader(tmp_path):
    robot = arm()
    folder = bundle(robot, tmp_path)
    (folder / "robot.xml").write_text("<mujoco><nonsense/></mujoco>")
    rows = rows_of(robot, folder)
    assert rows["mujoco (mjcf)"].message.startswith("MuJoCo: ")
    assert [name for name, row in rows.items() if not row.passed] == ["mujoco (mjcf)"]


def test_a_missing_loader_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "find_spec", lambda n: None if n == "pinocchio" else find_spec(n))
    report = conformance(bundle(arm(), tmp_path), samples=2)
    row = next(row for row in report.rows if row.loader == "pinocchio")
    assert (row.passed, row.message) == (None, "not installed")
    assert report.passed


def test_mujoco_keeps_no_meshes_of_the_copies_that_it_read(tmp_path):
    mesh = tmp_path / "cube.stl"
    trimesh.creation.box((0.1, 0.1, 0.1)).export(mesh)
    robot = with_link(arm(), "upper", visuals=(Shape(Mesh(mesh)),), collisions=())
    assert conformance(bundle(robot, tmp_path), samples=2).passed
    assert mujoco.mj_getCacheSize(mujoco.mj_getCache()) == 0


def test_a_folder_that_is_not_a_bundle_is_an_error(tmp_path):
    with pytest.raises(FormatError, match="is not a bundle"):
        conformance(tmp_path)


@pytest.mark.parametrize(
    ("changes", "column", "message", "readers"),
    [
        ({"limits": (-2.0, 1.9)}, "limits", "upper limit 2, not 1.9", LOADERS),
        ({"effort": 40.0}, "limits", "effort 50, not 40", LOADERS),
        ({"velocity": 3.0}, "limits", "velocity 2, not 3", ["yourdfpy", "pybullet", "pinocchio"]),
        ({"damping": 0.5}, "damping", "damping 0, not 0.5", LOADERS),
        ({"friction": 0.1}, "damping", "friction 0, not 0.1", LOADERS),
    ],
)
def test_each_loader_that_reads_a_value_notices_another_one(
    changes, column, message, readers, tmp_path
):
    other = with_joint(arm(), "shoulder", **changes)
    for name, row in rows_of(other, bundle(arm(), tmp_path)).items():
        assert row.passed is (name not in readers)
        assert getattr(row, column) is (name not in readers)
        assert row.message == (f"joint shoulder: {message}" if name in readers else "")


def test_a_chain_of_mimic_joints_counts_as_its_product(tmp_path):
    robot = massless_tree()
    last = Joint("last", "revolute", "follower", "end", limits=(-9.0, 9.0), effort=1, velocity=1)
    chained = replace(last, mimic=Mimic("follow", 2.0, 0.1))
    robot = replace(robot, links=(*robot.links, rod("end")), joints=(*robot.joints, chained))
    folder = bundle(robot, tmp_path)
    rows = {row.loader: row for row in conformance(folder, 2).rows}
    assert all(rows[name].mimic for name in ("yourdfpy", "mujoco (urdf)", "mujoco (mjcf)"))
    assert rows["pinocchio"].mimic is None  # it refuses chains
    direct = replace(last, mimic=Mimic("swing", -1.0, 0.5))
    same = replace(robot, joints=(*robot.joints[:-1], direct))
    rows = {row.loader: row for row in compare(same, folder, 2).rows}
    assert rows["mujoco (mjcf)"].mimic


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('kp="', 'kp="1', "stiffness"),
        ('kv="', 'kv="1', "derivative gain"),
        ('<joint name="shoulder"', '<joint name="shoulder" armature="0.1"', "armature"),
        ("<position [^>]*/>", "", "stiffness nan,"),
    ],
)
def test_other_gains_are_noticed(old, new, message, tmp_path):
    folder = bundle(arm(), tmp_path)
    text = re.sub(old, new, (folder / "robot.xml").read_text(), count=1)
    if not new:  # without its actuator, the keyframe has no place for its control
        text = re.sub(' ctrl="[^"]*"', "", text)
    (folder / "robot.xml").write_text(text)
    row = next(row for row in conformance(folder, 2).rows if row.loader == "mujoco (mjcf)")
    assert (row.passed, row.gains, row.limits) == (False, False, True)
    assert row.message.startswith(f"joint shoulder: {message} ")


def heavy(factor, turn):
    """An arm whose links weigh tonnes, with principal axes that are those of no frame."""
    R = Pose.from_xyz_rpy(rpy=turn).matrix[:3, :3]
    links = []
    for link in arm().links:
        mass, com = factor * link.inertial.mass, link.inertial.com
        inertia = R @ (factor * link.inertial.matrix) @ R.T
        links.append(replace(link, inertial=Inertial.from_matrix(mass, com, inertia)))
    return arm().with_links(links)


def carrying_nothing(kind, **axis):
    """An arm with a joint that carries a link without mass, and a frame on it."""
    joint = hinge("end", kind=kind, T_parent_joint=Pose((0.1, 0.2, 0.3)), **axis)
    tool = Frame("tool", "end", Pose((0.3, 0.0, 0.1)))
    return replace(with_end(Link("end"), joint), frames=(tool,))


def wheel(kind, axis):
    """A body that turns about its centre, whose inertia MuJoCo computes only once."""
    inertial = Inertial(0.5, inertia=(1e-3, 0.0, 0.0, 1e-3, 0.0, 2e-3))
    strength = {"limits": None if kind == "continuous" else (-1, 1), "effort": 1.0, "velocity": 1.0}
    joint = Joint("turn", kind, "frame", "wheel", axis=axis, **strength)
    links = (rod("frame"), Link("wheel", inertial))
    return Robot("wheel", links, (joint,), (Frame("tool", "wheel"),), home=(0.0,))


@pytest.mark.parametrize(
    "robot",
    [
        heavy(5e5, (1.0, -0.5, 2.0)),
        heavy(1e6, (0.1, 0.0, 0.7)),
        carrying_nothing("revolute"),
        carrying_nothing("prismatic", axis=(0.6, 0.0, 0.8)),
        wheel("continuous", (0.0, 0.0, 1.0)),
        wheel("revolute", (0.0, 1.0, 0.0)),
    ],
)
def test_what_libraries_round_is_no_disagreement(robot, tmp_path):
    """PyBullet refuses rounded inertia, MuJoCo adds 1e-12 kg."""
    report = conformance(bundle(robot, tmp_path), samples=5)
    assert report.passed, [row.message for row in report.rows]
    for row in report.rows:
        assert row.rotation_error is None or row.rotation_error < 1e-6


BOX = '<geometry><box size="0.1 0.1 0.1"/></geometry>'
INERTIA = '<inertia ixx="0.01" iyy="0.02" izz="0.025" ixy="0" ixz="0" iyz="0"/>'
TIP = f'<inertial><mass value="0.1"/>{INERTIA}</inertial>'


def pendulum(tmp_path, *, base=INERTIA, bar=INERTIA, tip=TIP):
    """Write a bar on a base, with a tip that is fixed to it; return the file."""

    def link(name, inertia):
        mass = f'<inertial><origin xyz="0.1 0 0.2"/><mass value="2"/>{inertia}</inertial>'
        return f'<link name="{name}">{mass if inertia else ""}<collision>{BOX}</collision></link>'

    path = tmp_path / "pendulum.urdf"
    path.write_text(
        f"""<robot name="pendulum">{link("base", base)}{link("bar", bar)}
        <link name="tip">{tip}</link>
        <joint name="swing" type="revolute"><parent link="base"/><child link="bar"/>
          <origin xyz="0 0 0.1"/><axis xyz="0 1 0"/>
          <limit lower="-1" upper="1" effort="5" velocity="1"/></joint>
        <joint name="end" type="fixed"><parent link="bar"/><child link="tip"/>
          <origin xyz="0.05 0 0.3"/></joint></robot>"""
    )
    return path


def file_rows(path):
    rows = compare_file(path, default_finder(), samples=20)
    assert all(row.source == "file" for row in rows)
    return {row.loader: row for row in rows if row.passed is not None}


IMPOSSIBLE = '<inertia ixx="0.01" iyy="0.02" izz="0.05" ixy="0" ixz="0" iyz="0"/>'


def test_what_loaders_do_with_a_file_of_others_is_shown(tmp_path):
    rows = file_rows(pendulum(tmp_path, bar=IMPOSSIBLE, tip=""))
    for name in {"pybullet", "mujoco (urdf)"} & rows.keys():
        assert rows[name].passed is False
        assert rows[name].message
    assert rows["yourdfpy"].passed


@pytest.mark.parametrize(
    "wrong",
    [
        {"com": (0.101, 0.0, 0.2)},
        {"mass": 2.001},
        {"inertia": (0.01, 0.0, 0.0, 0.025, 0.0, 0.02)},
    ],
)
def test_a_fault_of_our_reader_is_seen(wrong, tmp_path, monkeypatch):
    """Loaders that compute forces and inertia see it; a bundle of the fault would hide it."""
    read = urdf._inertial

    def misread(element):
        inertial = read(element)
        return replace(inertial, **wrong) if inertial and inertial.mass == 2 else inertial

    monkeypatch.setattr(urdf, "_inertial", misread)
    rows = file_rows(pendulum(tmp_path))
    for name in {"pybullet", "pinocchio"} & rows.keys():
        assert not rows[name].passed, rows[name]


def test_a_mjcf_of_others_is_compared_as_it_is(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(
        """<mujoco model="arm"><compiler angle="degree"/><option gravity="0 0 0"/>
        <worldbody><body name="base" pos="0 0 1"><freejoint/><geom size="0.1"/>
          <body name="bar" pos="0.1 0 0" euler="0 30 0"><joint name="swing" axis="0 1 0"
            pos="0 0 0.02" range="-90 90" armature="0.3"/><geom size="0.05" pos="0.2 0 0"/>
            <body name="tip" pos="0.3 0 0"><joint type="slide" axis="1 0 0" range="0 0.1"/>
            <geom type="capsule" size="0.02 0.1"/></body></body></body></worldbody></mujoco>"""
    )
    (row,) = file_rows(path).values()
    assert (row.loader, row.passed, row.message) == ("mujoco (mjcf)", True, "")
    assert row.gravity_error < 1e-9
    assert row.inertia_error < 1e-9


def test_a_xacro_is_expanded_for_the_loaders(tmp_path):
    path = pendulum(tmp_path, base="").rename(tmp_path / "pendulum.xacro")
    text = path.read_text().replace('value="2"', 'value="${1 + 1}"')
    path.write_text(text.replace("<robot ", '<robot xmlns:xacro="http://ros.org/xacro" ', 1))
    assert file_rows(path)["mujoco (urdf)"].passed
