"""Small splits that tests write in code, and requests for others."""

from morphgen.benchmark.regimes import SplitRequest, regime_findings
from morphgen.encoding.robot_hash import robot_hash
from morphgen.grammar.compose import compose
from morphgen.grammar.library import default_library
from morphgen.grammar.request import parse_words
from morphgen.grammar.syntax import parse_derivation
from morphgen.splits.split import COMPOSED, Member, Split, compose_member

LIBRARY = default_library()


def member(words, name=None, *, task="push", obstacles=False, category=COMPOSED):
    """Return a split member from compose arguments."""
    derivation, default_name = parse_words(words.split(), LIBRARY)
    text = str(derivation)
    robot = compose(parse_derivation(text), LIBRARY, name or default_name)
    return Member(robot.name, category, text, task, obstacles, robot_hash(robot))


def split(train, test, *, name="mine/some", regime="composition", **more):
    """Return a split of members or compose arguments."""
    sides = [
        tuple(m if isinstance(m, Member) else member(m) for m in side) for side in (train, test)
    ]
    return Split(name, regime, "a split of a test", *sides, **more)


TRAIN = ("base=gantry ee=plane", "base=planar ee=cube", "base=gantry ee=cylinder")
TEST = ("base=planar ee=plane",)


def combined(train=TRAIN, test=TEST, **more):
    """Return a valid composition split of robots without meshes."""
    return split(train, test, **more)


LIBRARY = default_library()


def order(*train, test=1, **changes):
    return SplitRequest("mine", train, test, **changes)


def derivations(members):
    return [parse_derivation(member.derivation) for member in members]


def names(members):
    return [member.name for member in members]


def require_sound(split):
    """Assert that the robots can be composed and that the rules of the regime hold."""
    for member in (*split.train, *split.test):
        assert compose_member(member, LIBRARY).name == member.name
    assert regime_findings(split, LIBRARY) == ()
