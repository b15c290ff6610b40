"""docs/grammar.md agrees with the code: its examples run and its error messages are real."""

import re
from pathlib import Path

import pytest

from helpers.grammars import LIBRARY, shipped, unphysical
from morphgen.errors import GrammarError
from morphgen.grammar.analysis import check_grammar
from morphgen.grammar.derive import RandomChooser, derive
from morphgen.grammar.grammar_file import find_grammar, load_grammar
from morphgen.grammar.manifest import UNITS
from morphgen.grammar.request import pin
from morphgen.grammar.robot_set import SetConfig, make_in_processes, make_set
from morphgen.grammar.sampling import SamplingError, sample_robots
from morphgen.grammar.syntax import parse_condition
from morphgen.grammar.values import DISTRIBUTIONS, PROPERTIES

PAGE = (Path(__file__).parents[2] / "docs" / "grammar.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```grammar\n(.*?)```", PAGE, re.DOTALL)
MISTAKES = re.findall(r"^\| (.*?) \| `(my\.grammar:.*?)` \|$", PAGE, re.MULTILINE)


@pytest.fixture
def load(tmp_path, monkeypatch):
    """Read lines as the file ``my.grammar``."""
    monkeypatch.chdir(tmp_path)

    def loaded(text):
        Path("my.grammar").write_text(text)
        return load_grammar(find_grammar("my.grammar"))

    return loaded


def test_there_are_five_examples():
    assert len(EXAMPLES) == 5


@pytest.mark.parametrize("text", EXAMPLES)
def test_examples_have_no_faults_and_can_be_sampled(load, text):
    grammar = load(text)
    assert check_grammar(grammar, LIBRARY) == []
    for drawn in sample_robots(grammar, LIBRARY, 3):
        assert unphysical(drawn.robot) == []
        assert any(frame.name == "tool" for frame in drawn.robot.frames)


def test_two_limbs_have_the_documented_names(load):
    (text,) = (text for text in EXAMPLES if "left:limb" in text)
    (drawn,) = sample_robots(load(text), LIBRARY, 1)
    labels = [node.label for node in drawn.derivation.walk()]
    assert labels == ["pedestal", "left_arm", "left_ee", "right_arm", "right_ee"]
    frames = {frame.name for frame in drawn.robot.frames}
    assert frames == {"tool", "left_tool", "right_tool"}


def test_the_arms_of_the_first_example_have_weights_two_to_one(load):
    import numpy as np

    found, rng = load(EXAMPLES[0]), np.random.default_rng(0)
    arms = [derive(found, LIBRARY, RandomChooser(rng)).children[0][1].part for _ in range(300)]
    assert arms.count("ur5") / 300 == pytest.approx(2 / 3, abs=0.08)


def test_the_page_shows_mistakes_of_many_kinds():
    assert len(MISTAKES) >= 10


@pytest.mark.parametrize(("lines", "message"), MISTAKES)
def test_each_mistake_raises_the_documented_message(load, lines, message):
    text = "\n".join(re.findall("`(.*?)`", lines)) + "\n"
    try:
        faults = check_grammar(load(text), LIBRARY)
    except GrammarError as error:
        faults = [str(error)]
    if message.endswith("..."):
        faults = [fault[: len(message) - 3] + "..." for fault in faults]
    assert message in faults


def test_an_unsatisfiable_condition_raises_the_documented_message(monkeypatch):
    (told,) = re.findall(r"`(robot 0 of .*?)`", PAGE)
    with pytest.raises(SamplingError) as caught:
        next(sample_robots(shipped("cubes"), LIBRARY, 1, where=[parse_condition("mass > 900")]))
    assert str(caught.value) == told


def test_all_units_distributions_and_properties_are_documented():
    for name in (*(f"`{d}(" for d in DISTRIBUTIONS), *(f"`{p}`" for p in PROPERTIES)):
        assert name in PAGE
    (units,) = re.findall(r"\*\*Units\*\* are (.*?)\.", PAGE)
    assert set(units.split(", ")) == set(UNITS)


def test_documented_pins_are_valid():
    assert pin(shipped("chain"), ["beads=5", "bead.rod=3cm", "radius=2cm"], LIBRARY)


def test_the_index_has_the_documented_fields(tmp_path):
    (row,) = re.findall(r"\| `index\.jsonl` \| one line per robot: (.*?) \|", PAGE)
    named = set(row.replace("rejected draws", "rejected").split(", "))
    plan = SetConfig(tmp_path / "s", "g", "robot -> cubes\n", 0, (), True, False, ())
    make_set(plan, 1, make_in_processes())
    import json

    record = json.loads((tmp_path / "s" / "index.jsonl").read_text())
    assert set(record) - {"index"} == named
