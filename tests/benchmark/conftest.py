"""Fixtures shared by the tests of splits."""

import shutil

import pytest

from helpers.caching import once
from helpers.splits import LIBRARY, combined
from morphgen.benchmark import survey
from morphgen.benchmark.split_folder import BUNDLED, BuildSettings, build_split
from morphgen.splits.candidates import RobotFactory


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
    """Function that builds the split of four robots once with each of the settings."""
    folders = {}

    def build(settings):
        if settings not in folders:
            home = tmp_path_factory.mktemp("built")
            folders[settings] = build_split(combined(), home, LIBRARY, settings=settings).folder
        return folders[settings]

    return build


@pytest.fixture
def copy_of(built, tmp_path):
    """Function that returns a copy of the built split."""

    def copied(settings):
        return shutil.copytree(built(settings), tmp_path / "whole" / "mine" / "some")

    return copied


@pytest.fixture
def bundles(copy_of):
    """A built split with bundles."""
    return copy_of(BUNDLED)


@pytest.fixture(params=[BUNDLED, BuildSettings(light=True)], ids=["bundles", "light"])
def either(copy_of, request):
    """A built split with bundles, and a light one."""
    return copy_of(request.param)
