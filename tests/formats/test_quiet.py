"""Output of C libraries is suppressed, even when standard output is a pipe."""

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
def test_buffered_c_output_is_not_printed_at_exit():
    result = subprocess.run(
        [sys.executable, "-c", CODE], capture_output=True, text=True, check=True
    )
    assert result.stdout == "after\n"
    assert result.stderr == ""
