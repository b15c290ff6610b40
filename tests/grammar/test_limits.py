"""Hostile grammars: limits on size, recursion, time and memory."""

import math
import time

import pytest

from helpers.grammars import LIBRARY, grammar
from morphgen.errors import GrammarError
from morphgen.grammar.analysis import (
    check_grammar,
    count_structures,
)
from morphgen.grammar.derive import Chooser, RandomChooser, derive
from morphgen.grammar.grammar_file import grammar_text, load_grammar
from morphgen.grammar.syntax import (
    MAX_COUNT,
    MAX_NESTING,
    parse_condition,
    parse_derivation,
)

SOON = 10.0
"""CPU seconds."""
DOUBLING = [f"a{i} -> a{i + 1} a{i + 1}" for i in range(64)]


@pytest.fixture(autouse=True)
def soon():
    began = time.process_time()
    yield
    assert time.process_time() - began < SOON


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["robot -> post bead{1,1000000000} jaw"], r"g:1:20: repetition \{1,1000000000\}: expec"),
        (["robot -> post bead{1," + "9" * 6000 + "}"], "g:1:22: a word of 6,000 characters; exp"),
        (["robot -> " + "a" * 101], "g:1:10: a word of 101 characters; expected at most 100"),
        (["let x = 1e" + "9" * 200, "robot -> cubes"], "g:1:9: a word of 202 characters"),
        (["robot -> cubes", "where " + "not " * 5000 + "mass < 4"], "more than 100 levels"),
        (["let x = " + "+".join(["1"] * 5000), "robot -> cubes"], "more than 100 levels"),
        (["let x = " + "-" * 5000 + "1", "robot -> cubes"], "more than 100 levels"),
        (["let x = " + "choice(" * 500 + "1" + ")" * 500, "robot -> cubes"], "than 100 levels"),
        (["robot -> cubes", "where " + "(mass<4 or (mass<5 and " * 900 + "mass<4" + "))" * 900],
         "more than 100 levels"),
        (["robot -> " + "|".join(["cubes"] * 1001)], "g:1:1: 1,001 alternatives of 'robot'"),
        (["robot -> cubes"] + [f"a{i} -> cubes" for i in range(1000)], "g: 1,001 statements"),
        (["robot -> cubes", "#" * 70_000], "g: a text of 70,016 characters; expected at most 65"),
    ],
)  # fmt: skip
def test_exceeding_a_limit_is_an_error_that_names_the_limit(lines, message):
    with pytest.raises(GrammarError, match=message) as refused:
        grammar(*lines)
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 300
    with pytest.raises(GrammarError, match=r"--where:1:.*more than 100 levels"):
        parse_condition("not " * 200 + "mass < 4")


@pytest.mark.slow
def test_grammars_within_the_limits_are_read():
    x = "+".join(["1"] * MAX_NESTING)
    robot_grammar = grammar(f"let x = {x}", "robot -> " + "|".join(["@weight(x) cubes"] * 1000))
    assert count_structures(robot_grammar) == 1000
    assert check_grammar(robot_grammar, LIBRARY) == []
    nested = "(" * 20_000 + "1" + ")" * 20_000
    assert count_structures(grammar(f"let x = {nested}", "robot -> cubes")) == 1


def test_blank_lines_take_linear_time():
    assert count_structures(grammar("robot -> cubes", "\n" * 60_000, " | cartpole")) == 2


@pytest.mark.parametrize(
    ("lines", "number"),
    [
        (["robot -> slides a0", *DOUBLING, "a64 -> bead"], 1),
        (["robot -> slides a0", *DOUBLING, "a64 -> bead | beam"], MAX_COUNT + 1),
        (["robot -> slides a{100}", "a -> " + "|".join(["bead"] * 10)], 10**100),
        (["robot -> slides a{1,100}", "a -> " + "|".join(["bead"] * 10)], MAX_COUNT + 1),
        (["robot -> a0"] + [f"a{i} -> a{i + 1}" for i in range(990)] + ["a990 -> cubes"], 1),
        (["robot -> slides " + "a " * 10_000, "a -> bead | beam"], MAX_COUNT + 1),
    ],
)
def test_huge_numbers_of_structures_are_counted_quickly(lines, number):
    count = count_structures(grammar(*lines))
    assert count == number
    assert count != math.inf


def test_ports_of_more_structures_than_can_be_listed_are_checked():
    lines = "robot -> first a{1,100} cube", "a -> " + "|".join(["bead"] * 11)
    began = time.process_time()
    assert check_grammar(grammar(*lines, "first -> slides | post"), LIBRARY) == []
    (fault,) = check_grammar(grammar(*lines, "first -> slides | cube"), LIBRARY)
    assert fault == "g:1:16: nothing can be attached to 'cube': it has no port"
    assert time.process_time() - began < 0.5


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("let x = 1e400", "is not finite"),
        ("let x = 1e308 * 10", "is not finite"),
        ("let x = randint(-1e308, 1e308)", "too far apart"),
        ("let x = uniform(-1e308, 1e308)", "too far apart"),
        ("let x = loguniform(1e-300, 1e300)", "too far apart"),
        ("let x = nan", "unknown value 'nan'"),
    ],
)
def test_numbers_that_are_not_finite_are_faults(line, message):
    (fault,) = check_grammar(grammar(line, "robot -> @weight(x) cubes"), LIBRARY)
    assert fault.startswith("g:1:")
    assert message in fault


def test_weights_with_an_infinite_sum_are_errors():
    robot_grammar = grammar("robot -> @weight(1e308) cubes | @weight(1e308) cartpole")
    with pytest.raises(GrammarError, match="g:1:1: the sum of weights of 'robot' is infinite"):
        derive(robot_grammar, LIBRARY, Chooser())


def test_the_smallest_positive_weight_is_respected():
    class Last:
        def random(self):
            return 1 - 2**-53

    robot_grammar = grammar("robot -> @weight(5e-324) cubes | @weight(0) cartpole")
    assert derive(robot_grammar, LIBRARY, RandomChooser(Last())).part == "cubes"


def test_at_most_20_faults_are_reported():
    wrong = grammar("robot -> fixed " + " ".join(f"u{i}" for i in range(9000)))
    assert len(check_grammar(wrong, LIBRARY)) == 20


def test_a_grammar_whose_text_exceeds_the_limits_is_not_printed():
    robot_grammar = grammar("robot -> cubes", "where " + "<".join(["mass"] * 12_000))
    with pytest.raises(GrammarError, match="216,001 characters as one text; expected at most"):
        grammar_text(robot_grammar)


@pytest.mark.parametrize(
    "target", ["/etc/passwd", "../outside.grammar", "a/../../outside.grammar", "link.grammar"]
)
def test_an_include_cannot_leave_the_folder_of_its_grammar(tmp_path, target):
    inside = tmp_path / "inside"
    (inside / "a").mkdir(parents=True)
    (tmp_path / "outside.grammar").write_text("secret -> cubes\n")
    (inside / "link.grammar").symlink_to(tmp_path / "outside.grammar")
    mine = inside / "mine.grammar"
    mine.write_text(f'include "{target}"\nrobot -> cubes\n')
    message = r"mine.grammar:1:9: include '.*' leads outside of"
    with pytest.raises(GrammarError, match=message) as no:
        load_grammar(mine)
    assert "secret" not in str(no.value)
    if target.endswith(".grammar"):  # the folder around it as a library
        assert load_grammar(mine, [tmp_path]).start == "robot"


@pytest.mark.parametrize(("depth", "times"), [(24, 2), (1200, 1)], ids=["tree", "chain"])
def test_too_many_includes_are_errors(tmp_path, depth, times):
    for i in range(depth):
        include = f'include "f{i + 1}.grammar"\n'
        (tmp_path / f"f{i}.grammar").write_text(times * include + f"r{i} -> cubes\n")
    (tmp_path / f"f{depth}.grammar").write_text("last -> cubes\n")
    with pytest.raises(GrammarError, match="a grammar is read from at most 100"):
        load_grammar(tmp_path / "f0.grammar")


def test_large_files_and_binary_files_are_errors(tmp_path):
    (tmp_path / "big.grammar").write_text("robot -> cubes\n" + "#" * 10_000_000)
    with pytest.raises(GrammarError, match=r"big.grammar: 10,000,015 bytes; expected at most 65,5"):
        load_grammar(tmp_path / "big.grammar")
    (tmp_path / "binary.grammar").write_bytes(bytes(range(256)))
    with pytest.raises(GrammarError, match=r"binary.grammar: cannot be read: 'utf-8' codec"):
        load_grammar(tmp_path / "binary.grammar")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a=b[c:" * 20_000 + "a=b" + "]" * 20_000, "^d: a derivation has more than 100 parts"),
        ("a=b[" + ",".join(["c:a=b"] * 20_000) + "]", "^d: a derivation has more than 100 parts"),
        ("a=b[c:" * 300_000, "^d: a derivation of 1,800,000 characters; expected at most 262,144"),
        ("a=b[" * 20_000, "^d:1:6: invalid derivation"),
    ],
)
def test_a_derivation_beyond_the_limits_is_an_error(text, message):
    with pytest.raises(GrammarError, match=message):
        parse_derivation(text, "d")
