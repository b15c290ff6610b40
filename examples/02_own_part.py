"""Add an end-effector of your own, described by a YAML file and a xacro, and attach it to arms.

Prints the distance of the tool from the flange for two lengths of a hook, and the error for a
length that is out of its range.
"""

from pathlib import Path

import morphgen

# %%
# A part is a YAML file beside a xacro. Its parameters become arguments of the xacro; masses and
# inertias follow from shapes and density.
parts = Path("parts")
parts.mkdir(exist_ok=True)
(parts / "hook.yaml").write_text("""\
name: hook
kind: ee
summary: A rod with a bar across its tip
file: hook.xacro
root: hook
tool: {link: hook, xyz: [0, 0, "${length}"]}
density: 1200
parameters:
  length: {default: 0.2, min: 0.05, max: 0.5, unit: m, summary: length of the rod}
licence: MIT
""")
(parts / "hook.xacro").write_text("""\
<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="hook">
  <xacro:arg name="length" default="0.2"/>
  <xacro:property name="length" value="$(arg length)"/>
  <xacro:macro name="solid" params="x z size">
    <visual><origin xyz="${x} 0 ${z}"/><geometry><box size="${size}"/></geometry></visual>
    <collision><origin xyz="${x} 0 ${z}"/><geometry><box size="${size}"/></geometry></collision>
  </xacro:macro>
  <link name="hook">
    <xacro:solid x="0" z="${length/2}" size="0.02 0.02 ${length}"/>
    <xacro:solid x="0.03" z="${length}" size="0.08 0.02 0.02"/>
  </link>
</robot>
""")

# %%
# The part is used like any other. The names of links begin with the name of their part's key.
for arm, length in (("ur5", "20cm"), ("panda", "35cm")):
    robot = morphgen.compose(f"arm={arm} ee=hook ee.length={length}", library=parts)
    hook, tool = robot.links[-1], robot.frame("tool")
    print(f"{robot.name}: {hook.name}, tool {tool.T_link_frame.position[2]:.2f} m from the flange")

# %%
# An invalid value gives one line that names the valid ones.
try:
    morphgen.compose("arm=ur5 ee=hook ee.length=2m", library=parts)
except morphgen.MorphgenError as error:
    print(f"error: {error}")
