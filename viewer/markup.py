"""HTML that several pages share, and texts about a robot; what comes from outside is escaped."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from typing import Any, cast

import numpy as np

from morphgen.benchmark.licences import find_licence
from morphgen.formats.bundle import part_licences
from morphgen.model.findings import Finding
from morphgen.model.geometry import Mesh, Shape, dimensions
from morphgen.model.kinematics import reach
from morphgen.model.robot import Joint, Link, Robot
from morphgen.viewer.app.address import Address


def framed(*content: str) -> str:
    """Return HTML in the style of the pages."""
    return f'<div class="mg">{"".join(content)}</div>'


def dim(html: str) -> str:
    """Return HTML as a block of small grey text."""
    return f'<div class="dim">{html}</div>'


def link(address: Address, text: str) -> str:
    """Return a link to a page."""
    return f'<a href="{escape(address.query)}">{escape(text)}</a>'


def choose_box(uri: str, label: str = "") -> str:
    """Return a check box that puts a robot into the tray, with a label behind it."""
    stop = "" if label else ' tabindex="-1"'  # the card around it is a stop of the Tab key
    name = f'aria-label="choose {escape(uri)}"'
    box = f'<input type="checkbox" data-choose="{escape(uri)}" {name}{stop}>'
    return f'<label class="choose" title="choose">{box} {escape(label)}</label>'


def breadcrumbs(*steps: tuple[str, Address | None]) -> str:
    """Return the path from the library to a page; steps without address are plain text."""
    library = ("Library", Address("library"))
    parts = [
        link(address, text) if address else escape(text) for text, address in (library, *steps)
    ]
    return framed(f'<div class="crumbs">{" / ".join(parts)}</div>')


def tag(text: str, style: str = "") -> str:
    """Return a word in a coloured box; its style is one of the frame, such as ``error``."""
    return f'<span class="tag {escape(style)}">{escape(text)}</span>'


def error(text: str) -> str:
    """Return an error as a framed line."""
    return framed(tag("error", "error"), f" {escape(text)}")


def code(text: str) -> str:
    """Return text to copy: a click selects all of it."""
    return f"<pre>{escape(text)}</pre>"


def command(text: str) -> str:
    """Return the block with the command that repeats a page's robot on the command line."""
    return f"<h3>The same on the command line</h3>{code(text)}"


def table(header: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """Return a table."""
    right = ['class="n"' if i in numbers else "" for i in range(len(header))]

    def row(kind: str, cells: Iterable[str]) -> str:
        line = "".join(f"<{kind} {r}>{c}</{kind}>" for r, c in zip(right, cells, strict=True))
        return f"<tr>{line}</tr>"

    body = "".join(row("td", cells) for cells in rows)
    return f"<table>{row('th', map(escape, header))}{body}</table>"


def findings_table(findings: Sequence[Finding], redact: Callable[[str], str] = str) -> str:
    """Return a table of findings and their repairs; ``redact`` as in ``FileAccess``."""
    if not findings:
        return dim("no findings")
    rows = [
        (
            tag(finding.severity, finding.severity) + f"<br><code>{escape(finding.code)}</code>",
            f"<b>{escape(redact(finding.where))}</b>: {escape(redact(finding.why))}<br>"
            f'<span class="dim">{escape(redact(finding.fix))}</span>',
        )
        for finding in findings
    ]
    return table(("", "finding"), rows)


def status(text: str, fraction: float | None = None) -> str:
    """Return the line of the current activity with a progress bar; empty without a text."""
    if not text:
        return ""
    bar = ""
    if fraction is not None:
        bar = f'<div class="bar"><div style="width:{100 * fraction:.0f}%"></div></div>'
    return framed(dim(escape(text)) + bar)


_UNITS = {"prismatic": ("m", "N", "m/s")}  # units of position, effort, velocity
_ROTATION_UNITS = ("rad", "N m", "rad/s")


def joint_groups(robot: Robot) -> list[tuple[str, str, list[int]]]:
    """Return the independent joints by part: its label, its title, and indices of joints in q.

    The label begins the names of the joints. A robot of unknown parts has one group without label.
    """
    parts = cast(Sequence[Mapping[str, Any]], robot.provenance.get("parts", ()))
    names = {str(part["label"]): str(part["part"]) for part in parts}
    # The longest label first: a joint of "left_arm" does not belong to "left".
    labels = sorted(names, key=len, reverse=True)
    groups: dict[str, list[int]] = {}
    for row, k in enumerate(robot.independent_joints):
        name = robot.joints[k].name
        label = next((label for label in labels if name.startswith(f"{label}_")), "")
        groups.setdefault(label, []).append(row)
    return [
        (label, part_title(label, names[label]) if label else "joints", rows)
        for label, rows in groups.items()
    ]


def part_title(label: str, part: str) -> str:
    """Return the label of a part with its name, or one of them if both are the same."""
    return label if label == part else f"{label} ({part})"


def slider_step(low: float, high: float) -> float:
    """Return a power of ten that divides a range into a few hundred to 2000 steps."""
    if not high > low:
        return 0.001
    return float(10.0 ** math.floor(math.log10((high - low) / 200)))


def rounded(value: float, step: float) -> float:
    """Return a value rounded to the digits of a slider's step, which is a power of ten."""
    return round(value, max(-math.floor(math.log10(step)), 0))


def summary(robot: Robot, links: str) -> str:
    """Return a robot's name, numbers of links and joints, mass and reach, followed by HTML."""
    facts = [f"{len(robot.links)} links", f"{robot.dof} DoF", f"{robot.mass:.3g} kg"]
    if robot.tool and robot.dof:
        facts.append(f"reach {reach(robot):.3g} m")
    if mimics := len(robot.movable_joints) - robot.dof:
        facts.insert(2, f"{mimics} mimic joint{'s' if mimics > 1 else ''}")
    text = f"{' · '.join(facts)}{licence_line(robot)}{links}"
    return framed(f"<h3>{escape(robot.name)}</h3>", dim(text))


def licence_line(robot: Robot) -> str:
    """Return a line with the licences of a robot's parts and their restrictions; HTML."""
    licences = []
    for licence in map(find_licence, part_licences(robot.provenance)):
        licences.append(escape(licence.id))
        if licence.restrictions:
            licences[-1] += " " + tag(", ".join(licence.restrictions), "warning")
    return f"<br>licences of its parts: {', '.join(licences)}" if licences else ""


def link_table(robot: Robot) -> str:
    """Return the indented tree of links: joint above the link, mass and shapes."""
    depth = [0] * len(robot.links)
    rows = []
    tool = robot.tool and robot.tool.link
    for i, link in enumerate(robot.links):
        shapes = link.solid_shapes
        kinds = Counter(type(shape.geometry).__name__.lower() for shape in shapes)
        counts = ", ".join(kind if n == 1 else f"{n} {kind}" for kind, n in kinds.items())
        joint = robot.joints[i - 1] if i else None
        if joint is not None:
            depth[i] = depth[robot.parents[i]] + 1
        mark = " " + tag("tool", "info") if link.name == tool else ""
        rows.append(
            (
                f'<span style="padding-left:{0.7 * min(depth[i], 12):.1f}em">'
                f"{escape(link.name)}</span>{mark}",
                "root" if joint is None else joint.kind + (" (mimic)" if joint.mimic else ""),
                f"{link.inertial.mass:.3g}" if link.inertial else "–",  # noqa: RUF001
                escape(counts),
            )
        )
    return table(("link", "joint", "kg", "shapes"), rows, numbers=(2,))


def link_card(robot: Robot, name: str, findings: Sequence[Finding]) -> str:
    """Return a table of a link, the joint above it with its limits, and the findings about both."""
    link, i = robot.link(name), robot.link_index[name]
    joint = robot.joints[i - 1] if i else None
    rows = _inertial_rows(link)
    rows += [("joint", "none, it is the root")] if joint is None else _joint_rows(joint)
    rows += [("visual", _shape_text(shape)) for shape in link.visuals]
    rows += [("collision", _shape_text(shape)) for shape in link.collisions]
    rows += [("frame", frame.name) for frame in robot.frames if frame.link == name]
    texts = [
        f"{tag(finding.severity, finding.severity)} {escape(finding.why)}"
        for finding in findings
        if is_about(finding, name, joint.name if joint else "")
    ]
    cells = [(escape(key), escape(text)) for key, text in rows]
    cells.append(("findings", "<br>".join(texts) or "none"))
    return table((name, ""), cells)


def is_about(finding: Finding, link: str, joint: str) -> bool:
    """Return whether a finding names a link or a joint as its place."""
    kind, _, names = finding.where.partition(" ")
    name = {"link": link, "links": link, "joint": joint, "joints": joint}.get(kind)
    return bool(name) and name in names.split(", ")


def collision_text(pairs: Mapping[tuple[str, str], float]) -> str:
    """Return the colliding pairs of links with their penetration depths [m], deepest first."""
    if not pairs:
        return dim("no self-collision")
    deepest = sorted(pairs.items(), key=lambda item: -item[1])
    lines = [f"{escape(a)} in {escape(b)}: {1000 * d:.1f} mm" for (a, b), d in deepest[:6]]
    more = f"<br>and {len(deepest) - 6} more" if len(deepest) > 6 else ""
    return f"{tag('collision', 'error')}<br>{'<br>'.join(lines)}{more}"


def _joint_rows(joint: Joint) -> list[tuple[str, str]]:
    position, effort, speed = _UNITS.get(joint.kind, _ROTATION_UNITS)
    rows = [
        ("joint", f"{joint.name}, {joint.kind}"),
        ("parent", joint.parent),
        ("position", _numbers(joint.T_parent_joint.position) + " m"),
    ]
    if joint.is_movable:
        low, high = joint.effective_limits
        limits = f"{low:.3g} to {high:.3g} {position}"
        if joint.kind != "prismatic":
            limits += f" ({math.degrees(low):.3g} to {math.degrees(high):.3g}°)"
        rows.append(("axis", _numbers(joint.axis)))
        rows.append(("limits", limits if joint.limits else "none"))
    if joint.effort is not None:
        rows.append(("effort", f"at most {joint.effort:.3g} {effort}"))
    if joint.velocity is not None:
        rows.append(("velocity", f"at most {joint.velocity:.3g} {speed}"))
    if joint.mimic:
        mimic = joint.mimic
        rows.append(("mimics", f"{mimic.multiplier:g} × {mimic.joint} + {mimic.offset:g}"))  # noqa: RUF001
    return rows


def _inertial_rows(link: Link) -> list[tuple[str, str]]:
    if link.inertial is None:
        return [("mass", "none")]
    moments = np.linalg.eigvalsh(link.inertial.matrix)
    return [
        ("mass", f"{link.inertial.mass:.4g} kg"),
        ("centre of mass", _numbers(link.inertial.com) + " m"),
        ("principal moments", _numbers(moments.tolist()) + " kg m²"),
    ]


def _shape_text(shape: Shape) -> str:
    geometry = shape.geometry
    if isinstance(geometry, Mesh):
        return f"mesh {geometry.path.name}"
    size = " × ".join(f"{1000 * value:.4g}" for value in dimensions(geometry))  # noqa: RUF001
    return f"{type(geometry).__name__.lower()} {size} mm"


def _numbers(values: Sequence[float]) -> str:
    return " ".join(f"{value:.4g}" for value in values)
