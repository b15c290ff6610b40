"""The position actuators of composed robots hold the home configuration in MuJoCo."""

import mujoco
import numpy as np
import pytest

import morphgen


@pytest.mark.parametrize("request_", ["arm=ur5 ee=plane", "arm=panda ee=panda_hand", "arm3"])
def test_actuators_hold_home_for_three_seconds(request_, tmp_path):
    folder = morphgen.write(morphgen.compose(request_), tmp_path, picture=False)
    model = mujoco.MjModel.from_xml_path(str(folder / "robot.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    mujoco.mj_forward(model, data)
    assert data.ncon == 0
    start = data.site("tool").xpos.copy()
    for _ in range(int(3.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    assert np.linalg.norm(data.site("tool").xpos - start) < 1e-3
