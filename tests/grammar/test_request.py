"""``key=value`` words are parsed to a derivation, or are an error."""

import pytest

from morphgen.errors import MorphgenError
from morphgen.grammar.library import default_library
from morphgen.grammar.request import default_name, parse_request


@pytest.fixture(scope="module")
def library():
    return default_library()


def derive(library, text):
    return parse_request(text.split(), library)


def test_an_arm_has_a_fixed_base_and_no_end_effector_by_default(library):
    assert (
        str(derive(library, "arm=ur5")) == "base=fixed(spread=0.6)[top: arm=ur5[flange: ee=none]]"
    )


def test_order_of_words_does_not_matter(library):
    a = derive(library, "arm=ur5 ee=plane ee.size=80mm")
    assert a == derive(library, "ee.size=0.08 ee=plane arm=ur5")
    assert a.digest == derive(library, "ee.size=80mm ee=plane base=fixed arm=ur5").digest


def test_limbs_attach_to_named_ports(library):
    text = "base=pedestal left.arm=ur5 left.ee=stick right.arm=xarm7 right.ee=panda_hand"
    derivation = derive(library, text)
    assert [port for port, _ in derivation.children] == ["left", "right"]
    labels = [node.label for node in derivation.walk()]
    assert labels == ["base", "left_arm", "left_ee", "right_arm", "right_ee"]
    assert default_name(derivation, library) == "pedestal-left-ur5-stick-right-xarm7-panda_hand"


def test_an_arm_with_two_ports_takes_an_end_effector_on_each(library):
    derivation = derive(library, "arm=yumi left.ee=yumi_gripper")
    assert [node.label for node in derivation.walk()] == ["base", "arm", "left_ee", "right_ee"]
    assert [node.part for node in derivation.walk()][2:] == ["yumi_gripper", "none"]


def test_an_end_effector_may_attach_to_the_base(library):
    assert default_name(derive(library, "base=gantry ee=plane"), library) == "gantry-plane"


def test_different_robots_have_different_names(library):
    texts = ("arm=yumi left.ee=stick", "arm=yumi right.ee=stick")
    texts += (
        "base=pedestal left.ee=stick",
        "base=pedestal right.ee=stick",
        "base=pedestal ee=stick",
    )
    assert len({default_name(derive(library, text), library) for text in texts}) == len(texts)


def test_the_name_marks_changed_parameters(library):
    plain = default_name(derive(library, "arm=ur5 ee=plane"), library)
    small = default_name(derive(library, "arm=ur5 ee=plane ee.size=80mm"), library)
    turned = default_name(derive(library, "arm=ur5 ee=plane ee.mount_yaw=90deg"), library)
    assert plain == "ur5-plane"
    assert small.startswith("ur5-plane-")
    assert len({plain, small, turned}) == 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("arm=ur55", "unknown arm 'ur55'; did you mean 'ur5'"),
        ("arm=plane", "'plane' is of kind ee, not arm"),
        ("arm=ur5 ee=plan", "did you mean 'plane'"),
        ("arm=ur5 ee=plane ee.sise=1", "no parameter 'sise'; did you mean 'size'"),
        ("arm=ur5 ee=plane ee.size=45deg", "wrong unit 'deg'"),
        ("arm=ur5 ee=plane ee.size=9", "out of range"),
        ("arm=ur5 arm=ur3", "arm is given twice"),
        ("arm=ur5 ee.size=1", "no part is chosen for 'ee'"),
        ("arm=ur5 legs=4", "legs=4: unknown key 'legs'; expected base, arm, ee"),
        ("arm", "not of the form key=value"),
        ("base=fixed", "nothing to compose"),
        ("up.arm=ur5", "'fixed' has no port 'up'"),
        ("a.b.arm=ur5", "PORT.arm"),
        ("arm=yumi ee=plane", "'yumi' has no port 'flange'"),
    ],
)
def test_invalid_requests_are_errors(library, text, message):
    with pytest.raises(MorphgenError, match=r"^[^\n]*$") as caught:
        derive(library, text)
    assert message in str(caught.value)
