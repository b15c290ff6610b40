"""Importable functions for worker processes."""

import os
import time

from morphgen.errors import BenchmarkError
from morphgen.processes import init_worker


def power(exponent, base):
    return base**exponent, os.getpid()


def fail(number):
    if number == 20:
        raise BenchmarkError(f"{number} is wrong")
    return number


def die(number):
    os._exit(number)


def die_at_three(number):
    if number == 3:
        os._exit(1)
    return number


def die_later(seconds):
    time.sleep(seconds)
    os._exit(0)


def sleep_from(started):
    """Create a file, then sleep for an hour."""
    started.touch()
    time.sleep(3600)


def be_idle(stopped):
    """Initialise a worker, and wait for work."""
    init_worker(stopped)
    time.sleep(60)
