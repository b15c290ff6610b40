"""Compose a robot from parts, check it, write its files and step it in MuJoCo.

Prints the robot, the number of findings, the files of its bundle, and the height of the tool at
home and after half a second in MuJoCo, which holds the robot at home with its own actuators.
"""

import mujoco

import morphgen

# %%
# Name the parts, and set a parameter of one. `morphgen list` names all parts.
robot = morphgen.compose(arm="ur5", ee="plane", **{"ee.size": "80mm"}, name="pusher")
print(robot)

# %%
# Every finding has a code, a severity and a repair; a composed robot has no errors.
findings = morphgen.check(robot)
errors = [finding for finding in findings if finding.severity == "error"]
print(f"{len(findings)} findings, {len(errors)} errors")

# %%
# A bundle is a folder that all common loaders read: URDF, MJCF, meshes and a card of facts.
folder = morphgen.write(robot, "robots", picture=False)
print(folder, sorted(path.name for path in folder.iterdir()))

# %%
# The MJCF has actuators with gains that suit the robot, a keyframe `home` and a site `tool`.
model = mujoco.MjModel.from_xml_path(str(folder / "robot.xml"))
data = mujoco.MjData(model)
mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
mujoco.mj_forward(model, data)
print(f"tool at home: z = {data.site('tool').xpos[2]:.3f} m")
while data.time < 0.5:
    mujoco.mj_step(model, data)
print(f"tool after {data.time:.1f} s: z = {data.site('tool').xpos[2]:.3f} m")
