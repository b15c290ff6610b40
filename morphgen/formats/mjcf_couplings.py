"""Constraints of compiled MuJoCo models: mimic joints and joints that are held in place."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field

import mujoco

from morphgen.formats.mjcf_bodies import joint_label
from morphgen.formats.mjcf_document import MjcfDocument, listed
from morphgen.model.findings import Finding
from morphgen.model.robot import Mimic

_EQ = mujoco.mjtEq
_OBJ = mujoco.mjtObj
_WRAP = mujoco.mjtWrap
_WRAPPED_GEOMS = (_WRAP.mjWRAP_SPHERE, _WRAP.mjWRAP_CYLINDER)


@dataclass(frozen=True)
class Couplings:
    """What equality constraints require of joints, by the index of the joint."""

    mimics: dict[int, tuple[int, float, float]] = field(default_factory=dict)
    """Leader, multiplier and offset [rad or m] of each coupled joint."""
    locks: dict[int, float] = field(default_factory=dict)
    """Position of each joint that is held in place [rad or m]."""
    findings: list[Finding] = field(default_factory=list)
    """Constraints that were left out."""

    def mimic(self, joint: int, model: mujoco.MjModel, names: dict[int, str]) -> Mimic | None:
        """Return the mimic of a joint; None if it is independent.

        Raises:
            KeyError: If the leader has no name in ``names``.
        """
        if joint not in self.mimics:
            return None
        leader, multiplier, offset = self.mimics[joint]
        return Mimic(names[leader], multiplier, offset)

    def leader(self, joint: int) -> int:
        """Return the joint at the end of a chain of mimics, or the joint that closes a circle."""
        seen = {joint}
        while joint in self.mimics:
            joint = self.mimics[joint][0]
            if joint in seen:
                break
            seen.add(joint)
        return joint


@dataclass(frozen=True)
class _Scope:
    """The part of a compiled model that becomes a robot."""

    model: mujoco.MjModel
    joints: Collection[int]
    bodies: Collection[int]
    document: MjcfDocument


def read_couplings(
    model: mujoco.MjModel, joints: Collection[int], bodies: Collection[int], document: MjcfDocument
) -> Couplings:
    """Return the couplings among joints, and refuse the constraints that a robot cannot have.

    An active ``<equality><joint>`` of degree 1 is a mimic; one without ``joint2`` holds its joint.
    An ``<equality><tendon>`` of one fixed tendon of two joints is a mimic, too. Other tendons are
    accepted only if they merely drive joints that follow the same leader. Constraints to mocap
    bodies outside the robot, by which users drag it, are left out with a finding. Inactive
    constraints have no effect.

    Args:
        model: The compiled model.
        joints: Joints of the robot.
        bodies: Bodies of the robot; constraints that touch none of its joints and bodies are
            somebody else's.
        document: The document, for messages.

    Raises:
        FormatError: If a constraint or tendon has no counterpart.
    """
    scope, couplings = _Scope(model, joints, bodies, document), Couplings()
    resolved_tendons = set()
    for k in range(model.neq):
        kind = _EQ(model.eq_type[k])
        if not model.eq_active0[k] or not _touches(scope, k, kind):
            continue
        name = model.equality(k).name or _ends(model, k, kind)
        if kind == _EQ.mjEQ_JOINT:
            _add_joint_equality(scope, couplings, k, name)
        elif kind == _EQ.mjEQ_TENDON and _add_tendon_equality(scope, couplings, k, name):
            resolved_tendons.add(int(model.eq_obj1id[k]))
        elif _is_handle(scope, k, kind):
            couplings.findings.append(_handle_finding(name, document))
        else:
            word = kind.name.removeprefix("mjEQ_").lower()
            raise document.error(
                f"equality {name!r}: a {word} constraint has no counterpart; expected joint "
                "constraints of degree 1"
            )
    _lock_followers(couplings)
    for tendon in range(model.ntendon):
        if tendon not in resolved_tendons:
            _require_actuation_only(scope, couplings, tendon)
    return couplings


def _touches(scope: _Scope, equality: int, kind: mujoco.mjtEq) -> bool:
    """Return whether a constraint acts on a joint or body of the robot."""
    model = scope.model
    ends = [int(k) for k in (model.eq_obj1id[equality], model.eq_obj2id[equality]) if k >= 0]
    if kind == _EQ.mjEQ_JOINT:
        return any(end in scope.joints for end in ends)
    if kind == _EQ.mjEQ_TENDON:
        return any(_tendon_touches(scope, end) for end in ends)
    return any(body in scope.bodies for body in _connected_bodies(model, equality))


def _connected_bodies(model: mujoco.MjModel, equality: int) -> list[int]:
    """Return the bodies at the ends of a constraint other than of joints and tendons."""
    ends = [int(k) for k in (model.eq_obj1id[equality], model.eq_obj2id[equality]) if k >= 0]
    if model.eq_objtype[equality] == _OBJ.mjOBJ_SITE:
        return [int(model.site_bodyid[end]) for end in ends]
    if model.eq_objtype[equality] == _OBJ.mjOBJ_GEOM:
        return [int(model.geom_bodyid[end]) for end in ends]
    return ends


def _is_handle(scope: _Scope, equality: int, kind: mujoco.mjtEq) -> bool:
    """Return whether a constraint connects the robot to a mocap body that is not of the robot."""
    return kind in (_EQ.mjEQ_CONNECT, _EQ.mjEQ_WELD) and any(
        body not in scope.bodies and scope.model.body_mocapid[body] >= 0
        for body in _connected_bodies(scope.model, equality)
    )


def _handle_finding(name: str, document: MjcfDocument) -> Finding:
    return Finding(
        "mocap-constraint",
        "warning",
        f"{document.path.name}: equality {name!r}",
        "it connects the robot to a mocap body, which is not of the robot",
        "remove it, if it is not needed",
        "a constraint to a mocap body was left out",
    )


def _ends(model: mujoco.MjModel, equality: int, kind: mujoco.mjtEq) -> str:
    """Return what a constraint without a name connects."""
    object_type = {_EQ.mjEQ_JOINT: _OBJ.mjOBJ_JOINT, _EQ.mjEQ_TENDON: _OBJ.mjOBJ_TENDON}.get(
        kind, model.eq_objtype[equality]
    )
    ends = (model.eq_obj1id[equality], model.eq_obj2id[equality])
    names = (mujoco.mj_id2name(model, int(object_type), int(end)) or "" for end in ends if end >= 0)
    return " - ".join(names)


def _add_joint_equality(scope: _Scope, couplings: Couplings, k: int, name: str) -> None:
    """Add q1 - ref1 = a0 + a1 (q2 - ref2), or a1 = 0 without a second joint."""
    model = scope.model
    follower, leader = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
    a0, a1, *higher = (float(value) for value in model.eq_data[k, :5])
    if leader < 0:
        _claim(scope, couplings, follower, name)
        couplings.locks[follower] = _ref(model, follower) + a0
        return
    if any(higher):
        raise scope.document.error(
            f"equality {name!r}: its polycoef has degree {_degree(higher)}; expected degree 1, as "
            "of a mimic joint"
        )
    _require_own_joints(scope, (follower, leader), name)
    _claim(scope, couplings, follower, name)
    offset = _ref(model, follower) + a0 - a1 * _ref(model, leader)
    couplings.mimics[follower] = (leader, a1, offset)


def _add_tendon_equality(scope: _Scope, couplings: Couplings, k: int, name: str) -> bool:
    """Add c1 q1 + c2 q2 = length0 + a0 of a fixed tendon; return False if it is something else."""
    model = scope.model
    terms = _terms(model, int(model.eq_obj1id[k]))
    if model.eq_obj2id[k] >= 0 or terms is None or len({joint for joint, _ in terms}) != 2:
        return False
    (leader, c_leader), *others = terms
    follower, c_follower = others[0]
    if len(others) > 1 or c_follower == 0:
        return False
    _require_own_joints(scope, (follower, leader), name)
    _claim(scope, couplings, follower, name)
    length = float(model.tendon_length0[model.eq_obj1id[k]]) + float(model.eq_data[k, 0])
    couplings.mimics[follower] = (leader, -c_leader / c_follower, length / c_follower)
    return True


def _require_own_joints(scope: _Scope, ends: Iterable[int], name: str) -> None:
    outside = [joint_label(scope.model, joint) for joint in ends if joint not in scope.joints]
    if outside:
        raise scope.document.error(
            f"equality {name!r}: joint {listed(outside)} is not of the robot"
        )


def _lock_followers(couplings: Couplings) -> None:
    """Hold the joints that follow a joint that is held."""
    mimics, locks = couplings.mimics, couplings.locks
    while held := [joint for joint, (leader, _, _) in mimics.items() if leader in locks]:
        for joint in held:
            leader, multiplier, offset = mimics.pop(joint)
            locks[joint] = multiplier * locks[leader] + offset


def _require_actuation_only(scope: _Scope, couplings: Couplings, tendon: int) -> None:
    if not _tendon_touches(scope, tendon):
        return
    model, document = scope.model, scope.document
    name = model.tendon(tendon).name
    terms = _terms(model, tendon)
    if terms is None:
        raise document.error(
            f"tendon {name!r} is spatial, which has no counterpart; remove it and what uses it"
        )
    moving = [joint for joint, _ in terms if joint not in couplings.locks]
    if len({couplings.leader(joint) for joint in moving}) > 1:
        raise document.error(
            f"tendon {name!r} couples the joints "
            f"{listed(model.joint(joint).name for joint in moving)}, which has no counterpart; "
            "couple them by <equality><joint>, or remove the tendon and what uses it"
        )


def _terms(model: mujoco.MjModel, tendon: int) -> list[tuple[int, float]] | None:
    """Return joint and coefficient of every term of a fixed tendon; None for a spatial tendon."""
    first = int(model.tendon_adr[tendon])
    wraps = range(first, first + int(model.tendon_num[tendon]))
    if any(model.wrap_type[w] != _WRAP.mjWRAP_JOINT for w in wraps):
        return None
    return [(int(model.wrap_objid[w]), float(model.wrap_prm[w])) for w in wraps]


def _tendon_touches(scope: _Scope, tendon: int) -> bool:
    model = scope.model
    terms = _terms(model, tendon)
    if terms is not None:
        return any(joint in scope.joints for joint, _ in terms)
    first = int(model.tendon_adr[tendon])
    for w in range(first, first + int(model.tendon_num[tendon])):
        item = int(model.wrap_objid[w])
        kind = _WRAP(model.wrap_type[w])
        if kind == _WRAP.mjWRAP_SITE and int(model.site_bodyid[item]) in scope.bodies:
            return True
        if kind in _WRAPPED_GEOMS and int(model.geom_bodyid[item]) in scope.bodies:
            return True
    return False


def _claim(scope: _Scope, couplings: Couplings, joint: int, name: str) -> None:
    """Require that no other constraint determines a joint."""
    if joint in couplings.mimics or joint in couplings.locks:
        raise scope.document.error(
            f"equality {name!r}: another one couples joint {scope.model.joint(joint).name!r}, too; "
            "expected one"
        )


def _degree(higher: Iterable[float]) -> int:
    """Return the degree of a polynomial whose coefficients from the square on are given."""
    return max(power for power, value in enumerate(higher, start=2) if value)


def _ref(model: mujoco.MjModel, joint: int) -> float:
    return float(model.qpos0[model.jnt_qposadr[joint]])
