"""Settings of hypothesis, fixtures of several rooms, and the end of a test session."""

import gc
import sys
from contextlib import ExitStack, closing
from dataclasses import replace

import pytest
from hypothesis import HealthCheck, settings

# Tests do not fail because other work makes the machine slow.
settings.register_profile("any load", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any load")
gc.disable()  # else a third of the time in which tests are collected, and nothing is garbage


def pytest_collection_finish():
    """Collect the garbage of tests, but less often than Python does, which takes 5% of the time."""
    gc.freeze()
    gc.set_threshold(10_000)
    gc.enable()


@pytest.fixture(scope="module")
def module_cache(tmp_path_factory):
    """Keep goal sets and other files in a cache of the module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    """Folder of stored goal sets, which the tests of a process share."""
    return tmp_path_factory.mktemp("goals")


@pytest.fixture
def opened():
    """Return a function that returns what it is given, which is closed after the test."""
    with ExitStack() as stack:
        yield lambda thing: stack.enter_context(closing(thing))


@pytest.fixture
def robot_urdf(tmp_path):
    """Write a robot as ``some_robot.urdf``."""
    from morphgen.formats.urdf.write import urdf_text  # few tests need it

    def write(robot):
        path = tmp_path / "some_robot.urdf"
        path.write_text(urdf_text(replace(robot, frames=()), str))
        return path

    return write


@pytest.fixture
def xacro_here(monkeypatch):
    """Expand xacro files of users in this process; the limits of its own have other tests."""
    monkeypatch.setattr(
        "morphgen.formats.xacro.expand.run_in_child",
        lambda task, path, finder, **values: task(path, finder, **values),
    )
    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(4 * limit)  # as in that process
    yield
    sys.setrecursionlimit(limit)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish():
    """Collect garbage while a process may still take its time, and leave none for its end.

    pytest collects ten times more at its end. With many tests behind it a process then takes
    longer than the 5 s after which xdist sends it Ctrl-C, and Python reports a KeyboardInterrupt
    that is ignored in a destructor.
    """
    gc.collect()
    gc.freeze()
