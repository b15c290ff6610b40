"""Write small MJCF files and read them."""

import mujoco
import numpy as np
import pytest

from morphgen.errors import FormatError
from morphgen.formats.mjcf.read import read_mjcf

TWO_JOINTS = """
<worldbody>
  <body name="base"><geom size="0.1"/>
    <body name="left"><joint name="a" range="-1 1"/><geom size="0.1"/></body>
    <body name="right"><joint name="b" range="-1 1"/><geom size="0.1"/></body>
  </body>
</worldbody>"""


def write(folder, content, name="robot.xml"):
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f'<mujoco model="test">{content}</mujoco>', encoding="utf-8")
    return path


def read(folder, content, **kwargs):
    return read_mjcf(write(folder, content), **kwargs)


def refusal(folder, content, **kwargs):
    """Return the message of the refusal of an MJCF, without its path."""
    with pytest.raises(FormatError) as error:
        read(folder, content, **kwargs)
    return str(error.value).removeprefix(f"{folder / 'robot.xml'}: ")


def inertia_in_mujoco(model, body):
    """Return the inertia of a body about its centre of mass in the axes of the body, (3, 3)."""
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, model.body(body).iquat)
    R = R.reshape(3, 3)
    return R @ np.diag(model.body(body).inertia) @ R.T
