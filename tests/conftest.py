"""Settings of hypothesis, and the end of a test session."""

import gc

import pytest
from hypothesis import HealthCheck, settings

# Tests do not fail because other work makes the machine slow.
settings.register_profile("any load", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any load")


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish():
    """Collect garbage while a process may still take its time, and leave none for its end.

    pytest collects ten times more at its end. With many tests behind it a process then takes
    longer than the 5 s after which xdist sends it Ctrl-C, and Python reports a KeyboardInterrupt
    that is ignored in a destructor.
    """
    gc.collect()
    gc.freeze()
