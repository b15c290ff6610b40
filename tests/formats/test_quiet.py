"""What C code prints stays out of a program's output, also when that is a pipe."""

import os
import subprocess
import sys

import pytest

CODE = """
import ctypes
from morphgen.formats.quiet import quiet
libc = ctypes.CDLL(None)
with quiet():
    libc.printf(b"from C\\n")
    print("from Python", flush=True)
libc.printf(b"after\\n")
libc.fflush(None)
"""


@pytest.mark.skipif(os.name != "posix", reason="C's buffers are reached by POSIX's names")
def test_what_c_buffers_within_is_not_printed_at_the_end():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    assert done.stdout == "after\n"
    assert done.stderr == ""
