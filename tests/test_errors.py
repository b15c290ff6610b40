"""The hint for an unknown name: near names only, else what is valid."""

import pytest

from morphgen.errors import nearest

ARMS = ["jaco2", "jaco2_6dof", "kinova_gen3", "mico", "panda", "ur10", "ur3", "ur5"]
MANY = [*ARMS, *(f"z{number:02}" for number in range(30))]


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("UR5", "; did you mean 'ur5'? nearest of 38: ur10, ur3, ur5"),
        ("pnada", "; did you mean 'panda'?"),
        ("jaco", "; did you mean 'jaco2'? nearest of 38: jaco2, jaco2_6dof"),
        ("gen3", "; did you mean 'kinova_gen3'?"),
        ("NONSENSE", f"; 38 are valid, such as {', '.join(ARMS)}"),
        ("x" * 201, "; 38 are valid"),
    ],
)
def test_a_long_list_shows_only_near_names(name, hint):
    assert nearest(name, MANY) == hint


@pytest.mark.parametrize(
    ("name", "valid", "hint"),
    [
        ("nonsense", ["tongs", "prims"], "; valid: prims, tongs"),
        ("gltf", ["usd", "glb"], "; did you mean 'glb'? valid: glb, usd"),
        ("ur5-plne", ["cartpole"], "; valid: cartpole"),
        ("any", [], "; valid: (none)"),
    ],
)
def test_a_short_list_is_complete(name, valid, hint):
    assert nearest(name, valid) == hint


def test_the_closest_name_may_be_unlisted():
    assert (
        nearest("ee_size", ["arm", "ee"], ["ee.size"]) == "; did you mean 'ee.size'? valid: arm, ee"
    )
