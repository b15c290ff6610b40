"""What a robot's page says in words and numbers."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, cast

import numpy as np

from morphgen.model.geometry import Mesh, Shape, dimensions
from morphgen.model.robot import TOOL, Joint, Link, Robot
from morphgen.viewer import markup

_UNITS = {"prismatic": ("m", "N", "m/s")}
_TURNS = ("rad", "N m", "rad/s")


@dataclass(frozen=True)
class Chain:
    """Joints that belong together."""

    title: str
    rows: tuple[int, ...]
    """Positions in q."""


def chains(robot: Robot) -> list[Chain]:
    """The independent joints by the part that they came with; in one chain where it is unknown."""
    parts = cast(Sequence[Mapping[str, Any]], robot.provenance.get("parts", ()))
    # The longest label first: a joint of "left_arm" is none of "left".
    titles = {str(part["label"]): f"{part['label']}: {part['part']}" for part in parts}
    labels = sorted(titles, key=len, reverse=True)
    found: dict[str, list[int]] = {}
    for row, k in enumerate(robot.independent_joints):
        name = robot.joints[k].name
        label = next((each for each in labels if name.startswith(f"{each}_")), "")
        found.setdefault(titles.get(label, "joints"), []).append(row)
    return [Chain(title, tuple(rows)) for title, rows in found.items()]


def short_name(joint: Joint, chain: Chain) -> str:
    """A joint's name without the label of its chain."""
    return joint.name.removeprefix(chain.title.partition(":")[0] + "_")


def joint_hint(joint: Joint) -> str:
    """A joint's kind and limits in a line."""
    position, effort, speed = _UNITS.get(joint.kind, _TURNS)
    low, high = joint.effective_limits
    parts = [f"{joint.name}: {joint.kind}"]
    parts.append(f"{low:.4g} to {high:.4g} {position}" if joint.limits else "no limits")
    if joint.effort is not None:
        parts.append(f"at most {joint.effort:.4g} {effort}")
    if joint.velocity is not None:
        parts.append(f"{joint.velocity:.4g} {speed}")
    return ", ".join(parts)


def slider_step(low: float, high: float) -> float:
    """A round step that makes a few hundred of a range."""
    if not high > low:
        return 0.001
    return float(10.0 ** math.floor(math.log10((high - low) / 200)))


def summary(robot: Robot, reach: float | None) -> str:
    """A robot in one line."""
    facts = [f"{len(robot.links)} links", f"{robot.dof} DoF", f"{robot.mass:.3g} kg"]
    if reach is not None:
        facts.append(f"reach {reach:.3g} m")
    mimics = len(robot.movable_joints) - robot.dof
    if mimics:
        facts.insert(2, f"{mimics} mimic joint{'s' if mimics > 1 else ''}")
    return " · ".join(facts)


def link_table(robot: Robot) -> str:
    """The tree of links: a row a link, indented, with the joint that moves it and its mass."""
    depth = [0] * len(robot.links)
    rows = []
    tool = next((frame.link for frame in robot.frames if frame.name == TOOL), None)
    for i, link in enumerate(robot.links):
        joint = robot.joints[i - 1] if i else None
        if joint is not None:
            depth[i] = depth[robot.parents[i]] + 1
        mark = " " + markup.tag("tool", "info") if link.name == tool else ""
        rows.append(
            (
                f'<span style="padding-left:{0.7 * min(depth[i], 12):.1f}em">'
                f"{escape(link.name)}</span>{mark}",
                escape(_moves(joint)),
                f"{link.inertial.mass:.3g}" if link.inertial else "–",  # noqa: RUF001
                escape(_shapes_text(link.collisions or link.visuals)),
            )
        )
    return markup.table(("link", "moves by", "kg", "shapes"), rows, numbers=(2,))


def link_details(robot: Robot, name: str) -> str:
    """All about a link and the joint above it."""
    link, i = robot.link(name), robot.link_index[name]
    rows: list[tuple[str, str]] = []
    if i:
        joint = robot.joints[i - 1]
        rows += [("on", joint.parent), ("joint", joint_hint(joint))]
        rows.append(("at", _numbers(joint.T_parent_joint.position) + " m"))
        if joint.is_movable:
            rows.append(("axis", _numbers(joint.axis)))
        if joint.mimic:
            mimic = joint.mimic
            rows.append(("mimics", f"{mimic.multiplier:g} × {mimic.joint} + {mimic.offset:g}"))  # noqa: RUF001
    rows += _inertial_rows(link)
    rows += [("visual", _shape_text(shape)) for shape in link.visuals]
    rows += [("collision", _shape_text(shape)) for shape in link.collisions]
    rows += [("frame", frame.name) for frame in robot.frames if frame.link == name]
    return markup.table(
        ("", escape(name)), [(f"<b>{escape(key)}</b>", escape(text)) for key, text in rows]
    )


def collision_text(pairs: Mapping[tuple[str, str], float]) -> str:
    """What collides, and how deep."""
    if not pairs:
        return '<div class="dim">no self-collision</div>'
    deepest = sorted(pairs.items(), key=lambda item: -item[1])
    lines = [f"{escape(a)} in {escape(b)}: {1000 * d:.1f} mm" for (a, b), d in deepest[:6]]
    more = f"<br>and {len(deepest) - 6} more" if len(deepest) > 6 else ""
    return f"{markup.tag('collision', 'error')}<br>{'<br>'.join(lines)}{more}"


def _moves(joint: Joint | None) -> str:
    if joint is None:
        return "root"
    return joint.kind + (" (mimic)" if joint.mimic else "")


def _inertial_rows(link: Link) -> list[tuple[str, str]]:
    if link.inertial is None:
        return [("mass", "none")]
    moments = np.linalg.eigvalsh(link.inertial.matrix)
    return [
        ("mass", f"{link.inertial.mass:.4g} kg"),
        ("centre of mass", _numbers(link.inertial.com) + " m"),
        ("principal moments", _numbers(moments.tolist()) + " kg m²"),
    ]


def _shapes_text(shapes: Sequence[Shape]) -> str:
    kinds = Counter(type(shape.geometry).__name__.lower() for shape in shapes)
    return ", ".join(kind if n == 1 else f"{n} {kind}" for kind, n in kinds.items())


def _shape_text(shape: Shape) -> str:
    geometry = shape.geometry
    if isinstance(geometry, Mesh):
        return f"mesh {geometry.path.name}"
    size = " × ".join(f"{1000 * value:.4g}" for value in dimensions(geometry))  # noqa: RUF001
    return f"{type(geometry).__name__.lower()} {size} mm"


def _numbers(values: Sequence[float]) -> str:
    return " ".join(f"{value:.4g}" for value in values)
