"""Grammar files: includes, printing, lookup and digests; docs/grammar.md agrees with the code."""

import json
import re
from pathlib import Path

import pytest

from helpers.grammars import CATEGORIES, LIBRARY, grammar, shipped, unphysical
from morphgen.errors import GrammarError
from morphgen.grammar.analysis import check_grammar
from morphgen.grammar.derive import FirstChooser, derive
from morphgen.grammar.grammar_file import (
    find_grammar,
    grammar_from_text,
    grammar_names,
    grammar_text,
    load_grammar,
)
from morphgen.grammar.manifest import UNITS
from morphgen.grammar.request import pin
from morphgen.grammar.robot_set import SetConfig, make_in_processes, make_set
from morphgen.grammar.sampling import SamplingError, sample_robots
from morphgen.grammar.syntax import parse_condition
from morphgen.grammar.values import DISTRIBUTIONS, PROPERTIES


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
    return str(derive(grammar, LIBRARY, FirstChooser()))


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
        "robot -> base left:limb right:limb | @weight((r / 2)) body(size=-(r + 1), x=r){2,7}",
        "limb -> ur5",
        "where not ((mass < 3kg) or (dof == 2))",
        "where ((0.3 < reach) and (reach <= 1))",
    ]
    assert grammar_text(grammar(*lines)).splitlines() == lines


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
    grammar = load_grammar(path)
    assert grammar_text(grammar).splitlines() == [
        "let r = 8cm",
        "ee -> cube(size=r)",
        "robot -> gantry ee",
        "where (dof > 2)",
    ]


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


def test_an_unsatisfiable_condition_raises_an_error_that_names_it():
    message = "robot 0 of 'cubes': 0 of 500 draws were accepted; 500 failed at: where (mass > 900)"
    with pytest.raises(SamplingError) as caught:
        next(sample_robots(shipped("cubes"), LIBRARY, 1, where=[parse_condition("mass > 900")]))
    assert str(caught.value) == message


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
    make_set(plan, 1, make_in_processes())
    record = json.loads((tmp_path / "s" / "index.jsonl").read_text())
    assert set(record) - {"index"} == named
