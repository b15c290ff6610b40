"""The end of a test session."""

import gc

import pytest


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish():
    """Collect garbage while a process may still take its time, and leave none for its end.

    pytest collects ten times more at its end. With many tests behind it a process then takes
    longer than the 5 s after which xdist sends it Ctrl-C, and Python reports a KeyboardInterrupt
    that is ignored in a destructor.
    """
    gc.collect()
    gc.freeze()
