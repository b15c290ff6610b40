"""Parts that tests write to their own folders."""

from pathlib import Path

import yaml

PINCER = """\
<?xml version="1.0"?>
<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="pincer">
  <xacro:arg name="length" default="0.2"/>
  <xacro:property name="length" value="$(arg length)"/>
  <xacro:macro name="bar" params="name size">
    <link name="${name}">
      <visual><origin xyz="0 0 ${size/2}"/>
        <geometry><box size="0.02 0.02 ${size}"/></geometry>
        <material name="red"><color rgba="1 0 0 1"/></material></visual>
      <collision><origin xyz="0 0 ${size/2}"/>
        <geometry><box size="0.02 0.02 ${size}"/></geometry></collision>
    </link>
  </xacro:macro>
  <xacro:macro name="finger" params="name y limits *mimic">
    <xacro:bar name="${name}" size="0.05"/>
    <joint name="${name}_slide" type="prismatic">
      <parent link="palm"/><child link="${name}"/>
      <origin xyz="0 ${y} ${length}"/><axis xyz="0 1 0"/>
      <limit lower="${limits.split()[0]}" upper="${limits.split()[1]}" effort="10" velocity="0.1"/>
      <xacro:insert_block name="mimic"/>
    </joint>
  </xacro:macro>
  <link name="plinth"/>
  <joint name="foot" type="fixed">
    <parent link="plinth"/><child link="palm"/><origin xyz="0 0 1"/>
  </joint>
  <xacro:bar name="palm" size="${length}"/>
  <xacro:finger name="left" y="0.03" limits="0 0.04"><dynamics damping="1"/></xacro:finger>
  <xacro:finger name="right" y="-0.03" limits="-0.04 0">
    <mimic joint="left_slide" multiplier="-1"/>
  </xacro:finger>
  <joint name="wheel" type="continuous">
    <parent link="palm"/><child link="disc"/>
    <origin xyz="0.05 0 0"/><axis xyz="1 0 0"/>
    <limit lower="-9" upper="9" effort="1" velocity="2"/>
  </joint>
  <xacro:bar name="disc" size="0.01"/>
</robot>
"""
"""A palm with two fingers, the right one a mimic of the left, and a wheel on its side."""

MANIFEST = {
    "name": "pincer",
    "kind": "ee",
    "summary": "A palm with two fingers",
    "file": "pincer.xacro",
    "root": "palm",
    "mount": {"link": "palm"},
    "tool": {"link": "palm", "xyz": [0, 0, "${length + 0.05}"]},
    "home": {"left_slide": 0.01, "wheel": 0.5},
    "density": 1000,
    "accepted": {name: {"links-apart": "it hovers"} for name in ("left", "right", "disc")},
    "parameters": {"length": {"default": 0.2, "min": 0.1, "max": 0.5, "unit": "m"}},
    "licence": "MIT",
}


def write_part(folder: Path, *, xacro: str = PINCER, **changes: object) -> Path:
    """Write the pincer's YAML and xacro, keys changed; those that become None are left out.

    Returns:
        The YAML file, which has the part's name.
    """
    data = {key: value for key, value in (MANIFEST | changes).items() if value is not None}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "pincer.xacro").write_text(xacro)
    path = folder / f"{changes.get('name') or 'pincer'}.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    return path
