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


MINE = "import mujoco; mujoco.set_mju_user_warning(lambda text: print('mine', text))\n"


@pytest.mark.parametrize(("before", "name"), [("", "morphgen.mujoco WARNING"), (MINE, "mine")])
def test_a_warning_is_logged_or_goes_to_the_users_callback_and_to_no_file(before, name, tmp_path):
    result = subprocess.run(
        [sys.executable, "-c", before + CODE],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
    )
    assert result.stdout.startswith(f"{name} Nan, Inf or huge value in QVEL")
    assert list(tmp_path.iterdir()) == []
