"""Write small MJCF files and read them."""

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
