"""Grammar files: syntax, values, includes, and what the analysis finds."""

import json
import math
import re
import statistics
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.grammars import CATEGORIES, LIBRARY, grammar, shipped, unphysical
from helpers.robots import arm
from morphgen.errors import GrammarError
from morphgen.grammar.analysis import (
    check_grammar,
    count_structures,
)
from morphgen.grammar.compose import join
from morphgen.grammar.derive import Chooser, RandomChooser, derive
from morphgen.grammar.grammar_file import (
    find_grammar,
    grammar_from_text,
    grammar_names,
    grammar_text,
    load_grammar,
)
from morphgen.grammar.manifest import UNITS
from morphgen.grammar.request import parse_request, pin
from morphgen.grammar.sampling import SetConfig, make_set, sample_robots
from morphgen.grammar.syntax import (
    Expression,
    Include,
    Let,
    Production,
    SourceLocation,
    Where,
    parse_condition,
    parse_grammar,
)
from morphgen.grammar.values import (
    DISTRIBUTIONS,
    PROPERTIES,
    RobotProperties,
    Scope,
    evaluate,
    holds,
    require_condition,
    typical_value,
)


def only(text):
    (statement,) = parse_grammar(text, "g")
    return statement


def argument(text):
    """Return the expression of a parameter of a part."""
    return only(f"robot -> part(x={text})").alternatives[0].items[0].arguments[0][1]


def names(production):
    return [[item.name for item in alternative.items] for alternative in production.alternatives]


def test_every_kind_of_statement():
    text = 'include nlink\ninclude "a/b c.grammar"\nlet r = 2\nwhere mass < 4\nrobot -> fixed\n'
    kinds = [type(statement) for statement in parse_grammar(text, "g")]
    assert kinds == [Include, Include, Let, Where, Production]
    assert parse_grammar(text, "g")[1].target == "a/b c.grammar"


def test_comments_blank_lines_and_windows_line_ends_are_ignored():
    plain = parse_grammar("a -> b\nc -> d", "g")
    noisy = parse_grammar("# x -> y\r\n\r\na -> b # e\r\n\r\n  # f\r\nc -> d\r\n\r\n", "g")
    assert [names(p) for p in noisy] == [names(p) for p in plain]
    assert parse_grammar("", "g") == parse_grammar("# nothing\n", "g") == ()


@pytest.mark.parametrize(
    "text",
    [
        "a -> b(x=1, y=2) c | d",
        "a -> b(x=1,\n  y=2)\n  c\n  | d",
        "a -> b(\n\tx=1, # one\n\ty=2\n\t) c\n| d",
        "a ->\n  b(x=1, y=2)\n\n# between\n\n  c | d\n",
    ],
)
def test_indented_lines_and_lines_with_a_bar_continue_a_statement(text):
    assert names(only(text)) == [["b", "c"], ["d"]]


@pytest.mark.parametrize(
    ("text", "read"),
    [
        ("1 + 2 * 3", "(1 + (2 * 3))"),
        ("(1 + 2) * 3", "((1 + 2) * 3)"),
        ("8 - 4 - 2", "((8 - 4) - 2)"),
        ("8 / 4 / 2", "((8 / 4) / 2)"),
        ("-2 * 3", "(-2 * 3)"),
        ("2 - -1", "(2 - -1)"),
        ("+5", "5"),
        ("2*uniform(1cm, r/2)", "(2 * uniform(1cm, (r / 2)))"),
        ("1e-3m", "0.001m"),
        (".5", "0.5"),
        ("5.", "5"),
        ("android + nothing + orbit + including", "(((android + nothing) + orbit) + including)"),
        ("mass < 4 or dof > 2 and reach > 1", "((mass < 4) or ((dof > 2) and (reach > 1)))"),
        ("not mass < 4 and dof > 2", "(not (mass < 4) and (dof > 2))"),
        ("not (mass < 4 and dof > 2)", "not ((mass < 4) and (dof > 2))"),
        ("(mass < 4 or dof > 2) and links == 3", "(((mass < 4) or (dof > 2)) and (links == 3))"),
        ("0.4 < reach <= 1.5m", "((0.4 < reach) and (reach <= 1.5m))"),
        ("reach + 1 > 2 * height", "((reach + 1) > (2 * height))"),
        ("(reach) != 3", "(reach != 3)"),
    ],
)
def test_operators_have_the_usual_precedence_and_comparisons_chain(text, read):
    assert str(parse_condition(text)) == read


def test_a_number_keeps_its_unit_and_its_text():
    assert argument("45deg") == Expression("number", (), SourceLocation("g", 1, 17), "deg", 45.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("robot -> base arm(", "1:19: found the end, expected ')' or a name"),
        ("robot ->", "1:9: found the end, expected '@weight' or a name"),
        ("robot > base", "1:7: found '>', expected '->'"),
        ("robot -> a{2.5}", "1:12: found '2.5', expected a whole number"),
        ("robot -> a{3,2}", "1:12: repetition {3,2} needs 1 <= m <= n"),
        ("robot -> a;", "1:11: found ';', expected '('"),
        ("robot -> where", "1:10: found 'where', expected '@weight' or a name"),
        ("robot -> a(x=1, x=2)", "1:17: x is given twice"),
        ("robot -> a(x=3 mm)", "1:16: found 'mm', expected ')'"),
        ("robot -> a(x=1.2.3)", "1:17: found '.3', expected ')'"),
        ("robot -> @weight 2 a", "1:18: found '2', expected '('"),
        ("\n\n  robot -> a left:\n\n", "3:19: found the end, expected a name"),
        ("let x 5\nrobot -> a", "1:7: found '5', expected '='"),
        ("robot -> a\nwhere mass < 3 or", "2:18: found the end, expected '('"),
        ('include "a\nrobot -> a', '1:9: found \'"\', expected a "path" or a name'),
    ],
)
def test_syntax_errors_have_a_position_and_the_expected_tokens(text, message):
    with pytest.raises(GrammarError, match=r"^[^\n]*$") as caught:
        parse_grammar(text, "my.grammar")
    assert str(caught.value).startswith(f"my.grammar:{message}")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "--where:1:1: found the end, expected '('"),
        ("reach > 1 2", "--where:1:11: found '2', expected '*' or '/' or '+' or '-' or 'and'"),
    ],
)
def test_invalid_conditions_are_errors(text, message):
    with pytest.raises(GrammarError) as caught:
        parse_condition(text)
    assert str(caught.value).startswith(message)


AT = SourceLocation("x", 1, 1)
NUMBERS = st.builds(
    lambda value, unit: Expression("number", (), AT, unit, value),
    st.floats(0, 1e12),
    st.sampled_from(["", "m", "mm", "deg", "kg"]),
)
NAMES = st.sampled_from(["r", "mass"]).map(lambda name: Expression("name", (), AT, name))


def combined(below):
    pairs = st.tuples(below, below)
    return st.one_of(
        st.builds(lambda s, ab: Expression(s, ab, AT), st.sampled_from("+-*/"), pairs),
        pairs.map(lambda ab: Expression("call", ab, AT, "uniform")),
        below.map(lambda a: Expression("negative", (a,), AT)),
    )


@given(st.recursive(NUMBERS | NAMES, combined, max_leaves=8))
def test_random_expressions_round_trip_through_printing(expression):
    assert str(argument(str(expression))) == str(expression)


LOG_MEAN = 99 / math.log(100)
NAMED_VALUES = {"r": (0.02, "m"), "k": (3.0, ""), "turn": (1.0, "rad")}


def value(text):
    return evaluate(parse_condition(text, "g"), Scope(NAMED_VALUES, typical_value, ""))


def drawn(text, n=4000):
    """Return reproducible values of a distribution."""
    rng = np.random.default_rng(0)
    expression = parse_condition(text, "g")
    scope = Scope({}, lambda _, d: d.draw(rng.random, rng.standard_normal), "")
    return [evaluate(expression, scope)[0] for _ in range(n)]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("30mm", (0.03, "m")),
        ("3cm + 5mm", (0.035, "m")),
        ("200g", (0.2, "kg")),
        ("2*r - 1cm", (0.03, "m")),
        ("r / 1mm", (20.0, "")),
        ("1 / k", (1 / 3, "")),
        ("-(r + r)", (-0.04, "m")),
        ("k * turn", (3.0, "rad")),
        ("1 + 2 * k", (7.0, "")),
    ],
)
def test_arithmetic_keeps_units(text, expected):
    number, unit = value(text)
    assert (number, unit) == (pytest.approx(expected[0]), expected[1])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1m + 1kg", "1:4: (1m + 1kg) mixes units m and kg"),
        ("1m * 2m", "1:4: (1m * 2m) multiplies m by m"),
        ("1 / 2m", "1:3: (1 / 2m) divides a pure number by m"),
        ("r - turn", "1:3: (r - turn) mixes units m and rad"),
        ("uniform(1m, 2kg)", "1:1: uniform(1m, 2kg) mixes units kg and m"),
        ("3inch", "1:1: unknown unit 'inch'; valid: N, cm, deg, g, kg, m, mm, rad"),
        ("q + 1", "1:1: unknown value 'q'; valid: k, r, turn"),
        ("1 / 0", "1:3: (1 / 0) divides by zero"),
        ("1e300 * 1e300", "1:7: (1e+300 * 1e+300) is not finite"),
        ("(1 < 2) + 1", "1:4: (1 < 2) is a condition, not a value"),
        ("uniforn(1, 2)", "1:1: unknown distribution 'uniforn'; did you mean 'uniform'?"),
        ("uniform(1)", "1:1: uniform(1) does not fit uniform(low, high)"),
        ("uniform(2, 1)", "1:1: uniform(2, 1): low is above high in uniform(low, high)"),
        ("loguniform(0, 1)", "1:1: loguniform(0, 1): low must be above zero"),
        ("normal(1, 2)", "does not fit normal(mean, deviation, low, high)"),
        ("normal(1, -1, 0, 2)", "the deviation is negative"),
        ("choice()", "1:1: choice() does not fit choice(value, ...)"),
        ("randint(1, 2.5)", "randint needs whole numbers"),
    ],
)
def test_invalid_arithmetic_is_an_error_with_a_position(text, message):
    with pytest.raises(GrammarError, match=r"^g:[^\n]*$") as caught:
        value(text)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("text", "low", "high", "mean", "deviation"),
    [
        ("uniform(1, 3)", 1, 3, 2, 2 / math.sqrt(12)),
        ("loguniform(1, 100)", 1, 100, LOG_MEAN, math.sqrt(9999 / math.log(1e4) - LOG_MEAN**2)),
        ("normal(5, 2, -1, 11)", -1, 11, 5, 2),
        ("randint(1, 6)", 1, 6, 3.5, math.sqrt(35 / 12)),
        ("choice(7, 1, 4, 1)", 1, 7, 3.25, math.sqrt(6.1875)),
        ("uniform(2, 2)", 2, 2, 2, 0),
    ],
)
def test_values_have_the_bounds_mean_and_deviation_of_their_distribution(
    text, low, high, mean, deviation
):
    values = drawn(text)
    assert low <= min(values) <= low + 0.02 * (high - low)
    assert high >= max(values) >= high - 0.02 * (high - low)
    assert statistics.fmean(values) == pytest.approx(mean, abs=4 * deviation / math.sqrt(4000))
    assert statistics.pstdev(values) == pytest.approx(deviation, rel=0.05)


def test_a_normal_is_clipped_not_redrawn():
    values = drawn("normal(0, 1, 0, 1)")
    assert values.count(0.0) / len(values) == pytest.approx(0.5, abs=0.03)
    assert values.count(1.0) / len(values) == pytest.approx(0.159, abs=0.03)


@pytest.mark.parametrize(
    ("text", "typical"),
    [
        ("uniform(1, 3)", 2),
        ("loguniform(1, 100)", 10),
        ("normal(9, 1, 0, 5)", 5),
        ("choice(7, 1)", 7),
        ("randint(2, 5)", 2),
    ],
)
def test_the_typical_value_is_the_middle_or_the_first(text, typical):
    assert value(text)[0] == pytest.approx(typical)


def true_of(text, robot):
    condition = parse_condition(text)
    require_condition(condition)
    return holds(condition, RobotProperties(robot))


@pytest.fixture(scope="module")
def gantry():
    return join(parse_request(["base=gantry", "ee=cube"], LIBRARY), LIBRARY, "robot")


def test_properties_of_a_robot(gantry):
    properties = RobotProperties(gantry)
    assert (properties.links, properties.dof, properties.movable) == (7, 5, 5)
    assert properties.movable_to_tool == 5
    assert properties.mass == pytest.approx(gantry.mass)
    properties = RobotProperties(arm())  # a mimic joint moves and is not independent
    assert (properties.links, properties.dof, properties.movable) == (6, 4, 5)
    assert properties.movable_to_tool == 3


def test_height_is_measured_at_the_highest_point_at_home():
    straight = replace(arm(), home=(0.0, 0.0, 0.0, 0.0))
    assert RobotProperties(straight).height == pytest.approx(0.05 + 0.3 + 0.3 + 0.2 + 0.1 - 0.03)
    lying = replace(arm(), home=(np.pi / 2, 0.0, 0.0, 0.0))
    assert RobotProperties(lying).height == pytest.approx(0.05 + 0.02, abs=1e-3)


def test_reach_is_measured_from_the_first_joint_or_the_root_and_is_zero_without_a_tool():
    properties, toolless = RobotProperties(arm()), RobotProperties(replace(arm(), frames=()))
    assert properties.reach == pytest.approx(0.3 + 0.3 + 0.04 + 0.28, abs=0.02)
    assert properties.reach_from_root == pytest.approx(0.05 + properties.reach, abs=0.02)
    assert (toolless.reach, toolless.reach_from_root, toolless.movable_to_tool) == (0, 0, 0)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("dof == 5", True),
        ("links >= 7 and links <= 7", True),
        ("links > 7 or links < 7", False),
        ("not links > 7", True),
        ("4 < dof < 6", True),
        ("mass > 0g", True),
        ("movable_to_tool + 2 == links", True),
        ("reach / height > 0 and reach < 100m", True),
        ("dof * 2 == 10 and not (dof == 4 or dof == 6)", True),
        *((f"{name} >= 0", True) for name in PROPERTIES),
    ],
)
def test_a_condition_evaluates_to_true_or_false(gantry, text, expected):
    assert true_of(text, gantry) is expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mas < 3", "1:1: unknown property 'mas'; did you mean 'mass'? valid: dof, height"),
        ("mass", "1:1: mass is a value; a condition compares, such as mass < 40"),
        ("reach < 3kg", "1:7: (reach < 3kg) compares kg with m"),
        ("reach + mass < 3", "mixes units m and kg"),
        ("mass < uniform(1, 2)", "1:8: a condition cannot draw values: uniform(1, 2)"),
    ],
)
def test_conditions_without_a_value_are_errors(text, message):
    with pytest.raises(GrammarError) as caught:
        require_condition(parse_condition(text, "g"))
    assert str(caught.value).startswith("g:")
    assert message in str(caught.value)


@pytest.fixture
def write(tmp_path):
    """Write a grammar file of some lines; return its path."""

    def written(name, *lines):
        path = tmp_path / f"{name}.grammar"
        path.parent.mkdir(exist_ok=True)
        path.write_text("\n".join(lines) + "\n")
        return path

    return written


def first(grammar):
    return str(derive(grammar, LIBRARY, Chooser()))


def test_there_is_a_grammar_for_each_category_and_one_for_serial_arms():
    assert " ".join(grammar_names()) == (
        "arm3 arm5 arm_ed cartpole chain cubes multi_finger nlink panda_variations planar_arm "
        "prims serial stick tongs"
    )


@pytest.mark.parametrize("name", CATEGORIES)
def test_shipped_grammars_round_trip_through_printing(name):
    text = grammar_text(shipped(name))
    again = grammar_from_text(text, name)
    assert grammar_text(again) == text
    assert again.start == shipped(name).start
    assert first(again) == first(shipped(name))


def test_printing_preserves_every_language_feature():
    lines = [
        "let r = (0.1 * uniform(3.141592653589793mm, 1e-05m))",
        "robot -> a | base left:limb right:limb | @weight((r / 2)) body(size=-(r + 1), x=r){2,7}",
        "limb -> ur5",
        "where not ((mass < 3kg) or (dof == 2))",
        "where ((0.3 < reach) and (reach <= 1))",
    ]
    assert grammar_text(grammar(*lines)).splitlines() == lines
    spaced = [line.replace(":", " : ").replace(",", ", ") for line in lines]
    assert grammar_text(grammar(*spaced)).splitlines() == lines


def test_the_start_symbol_is_the_first_symbol_of_the_main_file(write):
    write("limbs", "limb -> arm plane", "arm -> ur5 | panda")
    path = write("mine", "include limbs", "include limbs", "robot -> fixed limb")
    grammar = load_grammar(path, [path.parent])
    assert (grammar.name, grammar.start) == ("mine", "robot")
    assert grammar_text(grammar).startswith("robot -> ")
    assert "arm=ur5" in first(grammar)


def test_a_file_of_includes_only_has_the_start_symbol_of_the_included_file(write):
    write("body", "robot -> gantry ee", "ee -> plane")
    assert load_grammar(write("mine", 'include "body.grammar"', "let r = 1")).start == "robot"


def test_a_file_overrides_included_definitions(write):
    write("body", "let r = 5cm", "robot -> gantry ee", "ee -> plane(size=r)", "where dof > 2")
    path = write("mine", 'include "body.grammar"', "let r = 8cm", "ee -> cube(size=r)")
    expected = ["let r = 8cm", "ee -> cube(size=r)", "robot -> gantry ee", "where (dof > 2)"]
    assert grammar_text(load_grammar(path)).splitlines() == expected


def test_shipped_grammars_can_be_included_by_name(write):
    path = write("mine", "include nlink", "robot -> post links jaw")
    assert "end: jaw=jaw" in first(load_grammar(path))


def test_user_libraries_take_precedence_over_shipped_grammars(write, tmp_path):
    user_grammar = write("cubes", "robot -> cartpole")
    assert find_grammar("cubes", [tmp_path]) == user_grammar
    assert find_grammar("cubes") != user_grammar
    with pytest.raises(GrammarError, match="unknown grammar 'kubes'; did you mean 'cubes'"):
        find_grammar("kubes", [tmp_path])


@pytest.mark.parametrize("target", ["a.grammar", "../{}/a.grammar", "./a.grammar"])
def test_include_cycles_are_errors(write, tmp_path, target):
    target = target.format(tmp_path.name)
    path = write("a", 'include "b.grammar"', "robot -> cubes")
    write("b", f'include "{target}"', "x -> cubes")
    with pytest.raises(GrammarError, match=r"include each other: a\.grammar -> b\.grammar -> a"):
        load_grammar(path)


def test_two_files_may_include_the_same_third(write):
    write("ends", "ee -> plane")
    write("a", 'include "ends.grammar"', "x -> cubes")
    write("b", 'include "ends.grammar"', "y -> cubes")
    path = write("c", 'include "a.grammar"', 'include "b.grammar"', "robot -> gantry ee")
    assert "plane" in first(load_grammar(path))


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["robot -> a", "robot -> b"], "2:1: 'robot' is already defined at g:1:1"),
        (["let r = 1", "let r = 2", "robot -> a"], "2:5: 'r' is already defined at g:1:5"),
        (["let r = 1"], "g: no production, such as: robot -> base arm ee"),
        ([""], "g: no production"),
        (["robot -> a", "where size > 3"], "2:7: unknown property 'size'"),
        (["include nlink", "robot -> a"], "1:9: a grammar given as text cannot include others"),
    ],
)
def test_contradictory_grammars_are_errors(lines, message):
    with pytest.raises(GrammarError) as caught:
        grammar(*lines)
    assert message in str(caught.value)


def test_a_missing_include_is_reported_with_its_position(write):
    path = write("mine", "robot -> cubes", "include nlnk")
    with pytest.raises(GrammarError) as caught:
        load_grammar(path)
    assert str(caught.value).startswith(f"{path}:2:9: unknown grammar 'nlnk'; did you mean 'nlink'")
    with pytest.raises(GrammarError, match="no such file"):
        find_grammar(str(path.with_name("other.grammar")))


def test_the_digest_covers_all_included_files(write):
    write("body", "ee -> plane")
    path = write("mine", 'include "body.grammar"', "robot -> gantry ee")
    before = load_grammar(path).digest
    assert load_grammar(path).digest == before
    write("body", "ee -> cube")
    assert load_grammar(path).digest != before


PAGE = (Path(__file__).parents[2] / "docs" / "grammar.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```grammar\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture
def load(tmp_path, monkeypatch):
    """Read lines as the file ``my.grammar``."""
    monkeypatch.chdir(tmp_path)

    def loaded(text):
        Path("my.grammar").write_text(text)
        return load_grammar(find_grammar("my.grammar"))

    return loaded


@pytest.mark.parametrize("text", EXAMPLES)
def test_examples_have_no_faults_and_can_be_sampled(load, text):
    grammar = load(text)
    assert check_grammar(grammar, LIBRARY) == []
    for drawn in sample_robots(grammar, LIBRARY, 3):
        assert unphysical(drawn.robot) == []
        assert any(frame.name == "tool" for frame in drawn.robot.frames)


def test_all_units_distributions_and_properties_are_documented():
    for name in (*(f"`{d}(" for d in DISTRIBUTIONS), *(f"`{p}`" for p in PROPERTIES)):
        assert name in PAGE
    (units,) = re.findall(r"\*\*Units\*\* are (.*?)\.", PAGE)
    assert set(units.split(", ")) == set(UNITS)
    assert len(EXAMPLES) == 2
    assert pin(shipped("chain"), ["beads=5", "bead.rod=3cm", "radius=2cm"], LIBRARY)


def test_the_index_has_the_documented_fields(tmp_path):
    (row,) = re.findall(r"\| `index\.jsonl` \| one line per robot: (.*?) \|", PAGE)
    named = set(row.replace("rejected draws", "rejected").split(", "))
    plan = SetConfig(tmp_path / "s", "g", "robot -> cubes\n", 0, (), True, False, ())
    make_set(plan, 1)
    record = json.loads((tmp_path / "s" / "index.jsonl").read_text())
    assert set(record) - {"index"} == named


@pytest.mark.parametrize("name", CATEGORIES)
def test_shipped_grammars_are_sound(name):
    assert check_grammar(shipped(name), LIBRARY) == []


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["robot -> fixed urr5"], "g:1:16: 'urr5' is neither a symbol nor a part; did you mean"),
        (["robot -> fixed my_arm"], "your own parts need --library DIR"),
        (["robot -> fixed a(x=1)", "a -> ur5"], "g:1:16: 'a' is a symbol and takes no parameters"),
        (["robot -> gantry plane(sise=1)"], "g:1:28: 'plane' has no parameter 'sise'"),
        (["robot -> gantry plane(size=1kg)"], "g:1:28: size is in m, 1kg in kg"),
        (["robot -> gantry plane(size=uniform(0.1, 2))"], "g:1:28: plane.size=2: out of range"),
        (["let s = uniform(1, 4)", "robot -> gantry plane(size=s/2)"], "plane.size=2: out of"),
        (["robot -> slides hand(palm=0, fingers=uniform(2, 4))"], "hand.fingers=2.76393: not a wh"),
        (["let s = uniform(2, 1)", "robot -> cubes(size=s)"], "g:1:9: uniform(2, 1): low is above"),
        (["robot -> slides bead robot"], "g:1:1: 'robot' never ends: it always holds itself"),
        (["robot -> gantry a", "a -> plane | a"], "g:2:1: 'a' can be rewritten to itself alone"),
        (["robot -> cubes", "a -> cubes"], "g:2:1: 'a' cannot be reached from 'robot'"),
        (["let r = 1", "robot -> cubes"], "g:1:5: 'r' is never used"),
        (["robot -> pedestal up:ur5"], "g:1:22: 'pedestal' has no port 'up'"),
        (["robot -> gantry plane cube"], "g:1:23: nothing can be attached to 'plane': it has no"),
        (["robot -> cubes | ur5(mount_yaw=1)"], "'ur5' is not attached to a port: it has no"),
        (["robot -> yumi_gripper"], "g:1:1: 'yumi_gripper' needs a base: its mount"),
        (["robot -> @weight(0) cubes"], "g:1:1: all weights of 'robot' are zero"),
    ],
)
def test_a_fault_is_reported_with_line_and_column(lines, message):
    faults = check_grammar(grammar(*lines), LIBRARY)
    assert faults
    assert any(message in fault for fault in faults)
    assert all(fault.startswith("g:") and "\n" not in fault for fault in faults)


def test_all_faults_are_reported_together():
    wrong = grammar("let r = 1", "robot -> gantri plane(sise=1)", "a -> ur55")
    faults = [fault.split(": ")[0] for fault in check_grammar(wrong, LIBRARY)]
    assert faults == ["g:2:10", "g:2:28", "g:3:6", "g:3:1", "g:1:5"]


def test_values_that_weights_or_values_name_are_used_and_a_recursion_may_end():
    used = grammar("let a = 1", "let b = a", "robot -> @weight(b) cubes | cartpole")
    ends = grammar("robot -> slides tail", "tail -> bead tail | bead")
    assert check_grammar(used, LIBRARY) == check_grammar(ends, LIBRARY) == []


@pytest.mark.parametrize(
    ("lines", "number"),
    [
        (["robot -> cubes"], 1),
        (["robot -> cubes | cartpole | post"], 3),
        (["robot -> post beam{2,5}"], 4),
        (["robot -> post beam{3}"], 1),
        (["robot -> post link{1,3}", "link -> beam | bead"], 2 + 4 + 8),
        (["robot -> post link{1,2} ee", "link -> beam{1,2} | bead", "ee -> jaw | claw"], 24),
        (["robot -> base arm jaw", "base -> fixed | post", "arm -> ur5 | ur3 | beam"], 6),
        (["robot -> pedestal left:l right:l", "l -> a e", "a -> ur5 | ur3", "e -> jaw | claw"], 16),
        (["robot -> gantry ee", "ee -> @weight(0) plane | cube | jaw"], 2),
    ],
)
def test_the_structure_count_is_that_of_the_structures_that_are_drawn(lines, number):
    robot_grammar, rng = grammar(*lines), np.random.default_rng(0)
    drawn = {derive(robot_grammar, LIBRARY, RandomChooser(rng)).digest for _ in range(25 * number)}
    assert count_structures(robot_grammar) == number == len(drawn)


def test_a_recursive_grammar_has_infinitely_many_structures():
    assert math.isinf(count_structures(grammar("robot -> slides tail", "tail -> bead | beam tail")))


def test_shipped_grammars_have_the_documented_number_of_structures():
    expected = {"chain": 6, "nlink": 4, "planar_arm": 8, "prims": 4, "arm3": 1}
    assert {name: count_structures(shipped(name)) for name in expected} == expected
