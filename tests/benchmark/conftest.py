"""Fixtures shared by the tests of splits."""

import shutil

import pytest

from helpers.goal_sets import once
from helpers.splits import LIBRARY, combined
from morphgen.benchmark import survey
from morphgen.benchmark.split_folder import build_split
from morphgen.splits.split import RobotFactory


@pytest.fixture(scope="module")
def composed_once():
    """Compose and measure each robot once in a module whose tests draw from the same few."""
    with pytest.MonkeyPatch.context() as patch:
        make = once(RobotFactory.__call__, lambda self, recipe: (self.max_links, repr(recipe)))
        patch.setattr(RobotFactory, "__call__", make)
        measure = once(survey.survey_robot, lambda _, max_links, member: (max_links, member))
        patch.setattr(survey, "survey_robot", measure)
        yield


@pytest.fixture
def example_split():
    """A split of four robots."""
    return combined()


@pytest.fixture(scope="session")
def built(tmp_path_factory):
    """The split of four robots, built."""
    return build_split(combined(), tmp_path_factory.mktemp("built"), LIBRARY).folder


@pytest.fixture
def bundles(built, tmp_path):
    """A copy of the built split."""
    return shutil.copytree(built, tmp_path / "whole" / "mine" / "some")
