"""Output of C libraries is suppressed, and MuJoCo's warnings go to the log, not to a file."""

import os
import subprocess
import sys

import pytest

PRINTING = """
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
        [sys.executable, "-c", PRINTING], capture_output=True, text=True, check=True
    )
    assert result.stdout == "after\n"
    assert result.stderr == ""


CODE = """
import logging, sys
import morphgen.formats.mjcf.write
import mujoco

logging.basicConfig(stream=sys.stdout, format="%(name)s %(levelname)s %(message)s")
xml = "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
model = mujoco.MjModel.from_xml_string(xml)
data = mujoco.MjData(model)
data.qvel[0] = float("nan")
mujoco.mj_step(model, data)
"""


@pytest.mark.slow
def test_a_warning_is_logged_and_writes_no_file(tmp_path):
    result = subprocess.run(
        [sys.executable, "-c", CODE], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    assert result.stdout.startswith("morphgen.mujoco WARNING Nan, Inf or huge value in QVEL")
    assert list(tmp_path.iterdir()) == []


def test_a_warning_callback_of_the_user_is_kept(tmp_path):
    code = "import mujoco; mujoco.set_mju_user_warning(lambda text: print('mine', text))\n" + CODE
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    assert result.stdout.startswith("mine Nan, Inf or huge value in QVEL")
