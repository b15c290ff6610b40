"""Robot hashes, split ids, and robots composed from split members."""

import shutil
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
import trimesh

from helpers.faulty_robots import with_joint, with_link
from helpers.robots import arm
from helpers.splits import member
from morphgen.encoding.robot_hash import robot_hash
from morphgen.errors import BenchmarkError, GrammarError, PartError
from morphgen.grammar.compose import compose
from morphgen.grammar.library import default_library
from morphgen.grammar.request import parse_words
from morphgen.model.geometry import Box, Cylinder, Mesh, Pose, Shape
from morphgen.model.robot import Frame, Inertial, Mimic
from morphgen.model.tree import rename
from morphgen.splits.split import Member, Split, compose_member, split_id

LIBRARY = default_library()


def visual(robot):
    return robot.link("upper").visuals[0]


def with_inertial(robot, **changes):
    return with_link(robot, "upper", inertial=replace(robot.link("upper").inertial, **changes))


def jittered(value, size, rng):
    """Return a robot, or a part of one, with noise on its numbers; rotations are kept."""
    if isinstance(value, float):
        return float(value + size * rng.standard_normal() * max(1, abs(value)))
    if isinstance(value, tuple):
        return tuple(jittered(each, size, rng) for each in value)
    if not is_dataclass(value):
        return value
    noisy = {e.name: jittered(getattr(value, e.name), size, rng) for e in fields(value) if e.init}
    if isinstance(value, Inertial):  # its noise is that of the mass times a squared length
        noise = size * value.mass * rng.standard_normal(6)
        noisy["inertia"] = tuple((noise + value.inertia).tolist())
    return replace(value, **noisy)


TURNED = Pose.from_xyz_rpy((0, 0, 0.3), (0, 1e-6, 0))


def test_published_hashes_stay_what_they_are():
    assert robot_hash(arm()) == "e2219cf873e8bd79251a5f8c6a9a49a4"


@pytest.mark.parametrize(
    "changed",
    [
        lambda r: replace(r, name="other"),
        lambda r: replace(r, ignore_pairs=(("base", "lower"),)),
        lambda r: replace(r, provenance={"derivation": "x"}),
        lambda r: replace(r, frames=(*r.frames, Frame("camera", "upper"))),
        lambda r: with_link(r, "upper", visuals=(replace(visual(r), rgba=(0, 0, 1, 1)),)),
        lambda r: with_joint(r, "shoulder", axis=(0, 5, 0)),
    ],
    ids=["name", "pairs", "provenance", "frame", "colour", "length of an axis"],
)
def test_nonphysical_properties_do_not_change_the_hash(changed):
    assert robot_hash(changed(arm())) == robot_hash(arm())


def test_labels_do_not_change_the_hash():
    """The same parts under other symbols are the same robot, or it would leak into train."""
    links = {link.name: f"x_{link.name}" for link in arm().links}
    joints = {joint.name: f"x_{joint.name}" for joint in arm().joints}
    renamed = rename(arm(), links, joints)
    assert renamed.joints[0].name.startswith("x_")
    assert robot_hash(renamed) == robot_hash(arm())


@pytest.mark.parametrize(
    "changed",
    [
        lambda r: with_link(r, "upper", collisions=()),
        lambda r: with_link(r, "upper", visuals=()),
        lambda r: with_link(r, "upper", collisions=(Shape(Cylinder(0.02, 0.2401)),)),
        lambda r: with_link(r, "base", collisions=(Shape(Box((0.1, 0.1001, 0.04))),)),
        lambda r: with_inertial(r, mass=0.30001),
        lambda r: with_inertial(r, com=(1e-6, 0, 0.15)),
        lambda r: with_inertial(r, inertia=(1, 0, 0, 1, 0, 1)),
        lambda r: with_joint(r, "elbow", T_parent_joint=Pose((0, 0, 0.300001))),
        lambda r: with_joint(r, "elbow", T_parent_joint=TURNED),
        lambda r: with_joint(r, "elbow", axis=(1, 1e-6, 0)),
        lambda r: with_joint(r, "elbow", limits=(-2.0, 2.000001)),
        lambda r: with_joint(r, "elbow", limits=None),
        lambda r: with_joint(r, "elbow", kind="prismatic"),
        lambda r: with_joint(r, "elbow", effort=51.0),
        lambda r: with_joint(r, "elbow", velocity=None),
        lambda r: with_joint(r, "elbow", damping=0.1),
        lambda r: with_joint(r, "elbow", friction=0.1),
        lambda r: with_joint(r, "right", mimic=Mimic("left", -1.0, 0.001)),
        lambda r: with_joint(r, "right", mimic=Mimic("extend", -1.0, 0.0)),
        lambda r: replace(r, home=(0.4, 0.5, 0.01, 0.020001)),
        lambda r: replace(r, frames=()),
        lambda r: replace(r, frames=(replace(r.frames[0], link="lower"),)),
        lambda r: replace(r, frames=(replace(r.frames[0], T_link_frame=Pose((0, 0, 0.28))),)),
    ],
)
def test_physical_properties_change_the_hash(changed):
    assert robot_hash(changed(arm())) != robot_hash(arm())


def test_a_revolute_joint_without_limits_hashes_as_continuous():
    free = with_joint(arm(), "elbow", limits=None)
    assert robot_hash(free) == robot_hash(with_joint(free, "elbow", kind="continuous"))
    limited = with_joint(arm(), "elbow", kind="continuous", limits=(-1.0, 1.0))
    assert robot_hash(free) == robot_hash(limited)


def test_a_mesh_is_hashed_by_its_content(tmp_path):
    path, copy, other = tmp_path / "a.stl", tmp_path / "b" / "c.stl", tmp_path / "d.stl"
    trimesh.creation.box((0.1, 0.2, 0.3)).export(path)
    copy.parent.mkdir()
    shutil.copy(path, copy)
    trimesh.creation.box((0.1, 0.2, 0.31)).export(other)

    def hashed(mesh_path, **mesh):
        shape = Shape(Mesh(mesh_path, **mesh))
        return robot_hash(with_link(arm(), "base", visuals=(), collisions=(shape,)))

    same = hashed(path)
    assert hashed(copy) == same
    different = [hashed(other), hashed(path, scale=(1, 1, 1.01)), hashed(path, part=0)]
    assert len({same, *different}) == 4
    shutil.copy(other, copy)
    assert hashed(copy) == hashed(other), "a file that has changed is read again"
    with pytest.raises(Exception, match=r"no\.stl: cannot be read"):
        hashed(tmp_path / "no.stl")


@pytest.mark.parametrize(
    "words", ["arm=ur5 ee=stick", "arm=lwr ee=panda_hand", "chain beads=4", "arm=widowx"]
)
def test_the_last_bits_of_numbers_do_not_change_the_hash(words):
    derivation, _ = parse_words(words.split(), LIBRARY)
    robot = compose(derivation, LIBRARY, "r")
    rng = np.random.default_rng(0)
    hashes = {robot_hash(jittered(robot, 1e-13, rng)) for _ in range(20)}
    assert hashes == {robot_hash(robot)}
    assert robot_hash(jittered(robot, 1e-5, rng)) not in hashes


@pytest.mark.parametrize("part", [1, 2, 3, 4, 5, 6, 8, 10])
def test_round_sizes_are_far_from_the_rounding_boundaries_of_the_hash(part):
    """This includes the half, third and so on of the rounding step."""

    def hashed(z):
        return robot_hash(with_joint(arm(), "elbow", T_parent_joint=Pose((0.0, 0.0, z))))

    for steps in range(1, 60):
        z = steps * 1e-7 / part
        assert hashed(z - 5e-10) == hashed(z) == hashed(z + 5e-10)


def test_a_robot_with_another_hash_is_an_error():
    changed = replace(member("base=gantry ee=plane"), robot_hash="0" * 32)
    composed_hash = member("base=gantry ee=plane").robot_hash
    with pytest.raises(BenchmarkError, match=f"'gantry-plane'.*{'0' * 32}.*{composed_hash}"):
        compose_member(changed, LIBRARY)


def test_a_member_that_cannot_be_composed_is_an_error_with_the_reason():
    with pytest.raises(PartError, match="unknown part 'plnae'"):
        compose_member(replace(member("base=gantry ee=plane"), derivation="base=plnae"), LIBRARY)
    with pytest.raises(GrammarError, match=r"derivation of 'mine'.*invalid derivation"):
        compose_member(replace(member("base=gantry ee=plane", "mine"), derivation="base"), LIBRARY)


def split_of_two():
    a, b = (
        Member(f"r{i}", "arm3", f"arm3=arm3(length=0.{i})", "reach", False, str(i) * 32)
        for i in (1, 2)
    )
    return Split("s", "interpolation", "one", (a, b), (replace(b, name="r3"),), {"seed": 1})


def test_the_id_depends_on_regime_and_robots_only():
    split = split_of_two()
    texts = {"name": "t", "summary": "two", "reference": "a paper"}
    same = replace(split, **texts, provenance={}, accepted={"hull": "why"}, statistics={"n": 1})
    assert split_id(same) == split_id(split)
    assert len(split_id(split)) == 32
    first, second = split.train
    others = [
        replace(split, regime="extrapolation"),
        replace(split, train=(second, first)),
        replace(split, train=(first,)),
        replace(split, train=split.test, test=split.train),
        replace(split, provenance={**split.provenance, "max_links": 40}),
        replace(split, train=(first,), test=(second, *split.test)),
        *(
            replace(split, train=(replace(first, **{key: "x"}), second))
            for key in ("name", "category", "derivation", "task", "obstacles", "robot_hash")
        ),
    ]
    assert len({split_id(split), *map(split_id, others)}) == 1 + len(others)
