"""Small stand-ins for the robots that documentation pages take from elsewhere."""

_MJCF = """<mujoco model="{name}"><worldbody>
  <body name="base"><geom size="0.1"/>
    <body name="leg" pos="0 0 {length}">
      <joint name="a" axis="0 1 0" range="-1 1"/><geom size="0.1"/>
      <body name="torso" pos="0 0 {length}">
        <joint name="b" axis="1 0 0" range="-1 1"/><geom size="0.05"/>
        <site name="tool" pos="0 0 0.2"/>
      </body>
    </body>
  </body>
</worldbody></mujoco>"""
_LINK = """<link name="{}"><inertial><mass value="1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><sphere radius="0.05"/></geometry></collision></link>"""
_DESCRIPTION = f"""<robot name="z1_description">{_LINK.format("link00")}{_LINK.format("link06")}
  <joint name="j" type="revolute"><parent link="link00"/><child link="link06"/>
    <origin xyz="0 0 0.3"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


def add_outside_robots(folder, monkeypatch):
    """Write the robots below a folder, and let the collections find them there."""
    menagerie, packages = folder / "outside" / "menagerie", folder / "outside" / "packages"
    monkeypatch.setenv("MENAGERIE_ROOT", str(menagerie))
    lengths = {
        menagerie / "universal_robots_ur5e" / "ur5e.xml": 0.3,
        menagerie / "franka_emika_panda" / "panda_nohand.xml": 0.4,
        **{folder / "bodies" / f"body_{i}.xml": 0.2 + 0.02 * i for i in range(1, 23)},
    }
    for path, length in lengths.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(_MJCF.format(name=path.stem, length=length))
    collection = packages / "robot_descriptions"
    collection.mkdir(parents=True)
    (collection / "z1.urdf").write_text(_DESCRIPTION)
    (collection / "__init__.py").touch()
    (collection / "z1_description.py").write_text(f"URDF_PATH = {str(collection / 'z1.urdf')!r}\n")
    monkeypatch.syspath_prepend(str(packages))
