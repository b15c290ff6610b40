"""Effort limits from the actuators of compiled MuJoCo models."""

from __future__ import annotations

import mujoco

_TRN = mujoco.mjtTrn
_JOINT_TRANSMISSIONS = (_TRN.mjTRN_JOINT, _TRN.mjTRN_JOINTINPARENT)


def read_efforts(model: mujoco.MjModel) -> dict[int, float]:
    """Return the effort limits by joint [N m or N].

    A joint's ``actuatorfrcrange`` comes first. Without it, the limits of the actuators on the joint
    are added up: their ``forcerange``, or for motors without one the ``ctrlrange`` times the gain;
    each times the gear. A joint has no effort limit if one of its actuators has none.
    """
    efforts: dict[int, float] = {}
    unlimited = set()
    for k in range(len(model.actuator_trntype)):
        if _TRN(model.actuator_trntype[k]) not in _JOINT_TRANSMISSIONS:
            continue
        joint = int(model.actuator_trnid[k, 0])
        force = _largest_force(model, k)
        if force is None:
            unlimited.add(joint)
        else:
            gear = abs(float(model.actuator_gear[k, 0]))
            efforts[joint] = efforts.get(joint, 0.0) + force * gear
    for joint in unlimited:
        efforts.pop(joint, None)
    for joint in range(model.njnt):
        if model.jnt_actfrclimited[joint]:
            efforts[joint] = float(abs(model.jnt_actfrcrange[joint]).max())
    return efforts


def _largest_force(model: mujoco.MjModel, actuator: int) -> float | None:
    if model.actuator_forcelimited[actuator]:
        return float(abs(model.actuator_forcerange[actuator]).max())
    is_motor = (
        model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_NONE
        and model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_NONE
    )
    # From MuJoCo 4 on, an actuator may have several controls; a motor has one.
    control = (
        int(model.actuator_ctrladr[actuator]) if hasattr(model, "actuator_ctrladr") else actuator
    )
    if is_motor and model.actuator_ctrllimited[control]:
        gain = abs(float(model.actuator_gainprm[actuator, 0]))
        return gain * float(abs(model.actuator_ctrlrange[control]).max())
    return None
