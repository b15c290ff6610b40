"""A command and the Python function of the same operation have the same options."""

import inspect
import re

import pytest

import morphgen
from morphgen.cli.command import read_commands
from morphgen.rl.config import SWITCHES
from morphgen.tasks.registry import Registry

ROBOT = {"words": "robot"}
ROBOTS = {"words": "robots"}
OPERATIONS = {
    "conform": ("conform", ROBOT, {"root", "json", "wide"}),
    "eval": ("evaluate", ROBOTS | {"checkpoint": "policy"}, {"out", "json", "wide"}),
    "export": ("export", ROBOT, {"root", "json"}),
    "goals": ("goals", ROBOTS, {"json", "wide"}),
    "play": ("play", ROBOT, set()),
    "clone": ("clone", {"words": "demonstrations"}, set()),
    "record": ("record", ROBOTS, {"json"}),
    "train": ("train", ROBOTS, {*SWITCHES, "observe"}),
    "verify": ("verify", {}, {"json", "wide"}),
}
"""For each command the function, the names of its parameters where they differ, and the options
that are no parameters: they print or write the result, or are switches within ``agent``."""
ONLY_IN_PYTHON = {"max_successes", "show"}
"""Parameters that are no options."""


def options_of(path):
    """Return the settings of a command's options by the names of their attributes."""
    (command,) = (each for each in read_commands() if each.path == path)
    return {
        settings.get("dest") or name.lstrip("-").replace("-", "_"): settings
        for name, settings in command.options.items()
    }


def documented(function):
    """Return the text of each parameter in the docstring."""
    text = re.search(r"\n    Args:\n(.*?)\n    (?=\w)", function.__doc__, re.DOTALL)[1]
    entries = re.split(r"^        \**(\w+): ", text, flags=re.MULTILINE)[1:]
    return dict(zip(entries[::2], entries[1::2], strict=True))


@pytest.mark.parametrize("path", OPERATIONS)
def test_options_and_parameters_are_the_same(path):
    name, renamed, others = OPERATIONS[path]
    function = getattr(morphgen, name)
    parameters = inspect.signature(function).parameters
    texts = documented(function)
    assert list(texts) == list(parameters)
    others = {each.replace("-", "_") for each in others}
    options = {renamed.get(k, k): v for k, v in options_of(path).items() if k not in others}
    assert set(options) == set(parameters) - ONLY_IN_PYTHON
    for key, settings in options.items():
        default, expected = settings.get("default"), parameters[key].default
        valid = (None, ()) if default == [] else (default,)
        assert expected is inspect.Parameter.empty or expected in valid, key
        choices = settings.get("choices", ())
        if not isinstance(choices, Registry):
            assert [each for each in choices if f"``{each}``" not in texts[key]] == [], key
