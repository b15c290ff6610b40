"""Check the structure of a URDF on its XML, so that findings have line numbers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from lxml import etree

from morphgen.errors import nearest
from morphgen.formats.urdf_schema import UrdfLocation, content_findings, unread_findings
from morphgen.formats.xml import shortened
from morphgen.model.findings import Finding
from morphgen.model.robot import JOINT_KINDS

MAX_LINKS = 1000
"""Largest number of links, and of joints, that is read."""
MAX_SHAPES = 10_000
"""Largest number of visual and collision shapes that is read."""
MAX_ERRORS = 50
"""Number of errors after which the check stops."""
_REPLACEMENT = {
    "floating": "fix the body to the world, or use three prismatic and three revolute joints",
    "planar": "use two prismatic joints and a revolute one",
}


def structure_findings(root: etree._Element, origin: str) -> tuple[Finding, ...]:
    """Check that a URDF is a kinematic tree with valid numbers.

    Args:
        root: The document's root element; findings report ``sourceline`` of its elements.
        origin: Name of the document in messages, usually its path.

    Returns:
        Findings in the order of detection. A document without errors can be converted.
    """
    if root.tag != "robot":
        return (_wrong_root(root, origin),)
    large = tuple(_size_findings(root, origin))
    if large:
        return large
    findings = [*_first(_robot_findings(root, origin)), *unread_findings(root, origin)]
    unexpanded = _first_xacro(root)
    if unexpanded is None:
        return tuple(findings)
    # Loaders ignore an unexpanded xacro call, so alone it is a warning. Next to other errors it is
    # their likely cause, and reported alone.
    broken = any(finding.severity == "error" for finding in findings)
    xacro_finding = UrdfLocation.of(root, origin).finding(
        unexpanded,
        "xacro-unexpanded",
        f"<xacro:{etree.QName(unexpanded).localname}> is left in the document",
        "give the file the suffix .xacro, or expand it first",
        "" if broken else f"<xacro:{etree.QName(unexpanded).localname}> was left out",
    )
    return (xacro_finding,) if broken else (xacro_finding, *findings)


def _size_findings(root: etree._Element, origin: str) -> Iterator[Finding]:
    """Check the number of elements first: later checks would take too long on a huge document."""
    for tag, elements, max_count in (
        ("link", root.iterfind("link"), MAX_LINKS),
        ("joint", root.iterfind("joint"), MAX_LINKS),
        ("visual and collision", root.iter("visual", "collision"), MAX_SHAPES),
    ):
        count = sum(1 for _ in elements)
        if count > max_count:
            yield UrdfLocation.of(root, origin).finding(
                root,
                "robot-too-large",
                f"it has {count} <{tag}> elements; at most {max_count} are read",
                "leave out everything that is not part of the robot",
            )


def _first(findings: Iterator[Finding]) -> list[Finding]:
    """Return findings up to ``MAX_ERRORS`` errors."""
    kept: list[Finding] = []
    num_errors = 0
    for finding in findings:
        kept.append(finding)
        num_errors += finding.severity == "error"
        if num_errors == MAX_ERRORS:
            break
    return kept


def _robot_findings(root: etree._Element, origin: str) -> Iterator[Finding]:
    links, joints = root.findall("link"), root.findall("joint")
    yield from content_findings(root, UrdfLocation.of(root, origin))
    if not links:
        yield UrdfLocation.of(root, origin).finding(
            root, "link-missing", "<robot> has no <link>", "add at least one link"
        )
    yield from _duplicates(links, origin)
    yield from _duplicates(joints, origin)
    yield from _tree(links, joints, origin)
    yield from _kinds(root, origin)
    yield from _mimics(joints, origin)
    for element in [*links, *joints, *root.findall("material")]:
        yield from content_findings(element, UrdfLocation.of(element, origin))


def _wrong_root(root: etree._Element, origin: str) -> Finding:
    name = etree.QName(root)
    fix = "give a URDF or xacro, whose root element is <robot>, or an MJCF, whose is <mujoco>"
    tag = f"{root.prefix}:{name.localname}" if root.prefix else name.localname
    why = f"the root element is <{tag}>, not <robot>"
    if root.prefix:
        fix = f"remove the prefix {root.prefix!r} from all elements; robot software reads none"
    elif name.localname == "robot":
        why = f"the root element <robot> is in the namespace {shortened(str(name.namespace))!r}"
        fix = "remove xmlns=... from it"
    return UrdfLocation(origin, f"<{tag}>").finding(root, "root-not-robot", why, fix)


def _first_xacro(root: etree._Element) -> etree._Element | None:
    for element in root.iter("{*}*"):
        namespace = etree.QName(element).namespace
        if namespace is not None and "xacro" in namespace:
            return element
    return None


def _duplicates(elements: Sequence[etree._Element], origin: str) -> Iterator[Finding]:
    first: dict[str, etree._Element] = {}
    for element in elements:
        name = element.get("name")
        if name in first:
            yield UrdfLocation.of(element, origin).finding(
                element,
                f"{element.tag}-duplicate",
                f"the name is taken by the {element.tag} on line {first[name].sourceline}",
                "rename one of them",
            )
        elif name:
            first[name] = element


def _ends(joint: etree._Element) -> tuple[str | None, str | None]:
    parent, child = joint.find("parent"), joint.find("child")
    return (
        None if parent is None else parent.get("link"),
        None if child is None else child.get("link"),
    )


def _tree(
    links: Sequence[etree._Element], joints: Sequence[etree._Element], origin: str
) -> Iterator[Finding]:
    by_name = {name: link for link in links if (name := link.get("name"))}
    parent_of: dict[str, str] = {}
    joint_above: dict[str, etree._Element] = {}
    """Joint whose child a link is, by the link's name."""
    for joint in joints:
        location = UrdfLocation.of(joint, origin)
        parent, child = _ends(joint)
        for role, name in (("parent", parent), ("child", child)):
            if name and name not in by_name:
                yield location.finding(
                    joint,
                    "joint-link-unknown",
                    f"its {role} {name!r} is not a link",
                    f"name a link{nearest(name, by_name)}",
                )
        if not child or child not in by_name:
            continue
        if child in joint_above:
            yield location.finding(
                joint,
                "link-two-parents",
                f"link {child!r} is already the child of joint {joint_above[child].get('name')!r} "
                f"(line {joint_above[child].sourceline})",
                "remove one joint: a robot is a tree, loops are not supported",
            )
            continue
        joint_above[child] = joint
        if parent in by_name:
            parent_of[child] = parent
    for cycle in _cycles(parent_of):
        yield UrdfLocation.of(joint_above[cycle[0]], origin).finding(
            joint_above[cycle[0]],
            "cycle",
            "links form a loop: " + " -> ".join([*cycle, cycle[0]]),
            "remove one of the joints",
        )
    roots = [name for name in by_name if name not in joint_above]
    for name in roots[1:]:
        yield UrdfLocation.of(by_name[name], origin).finding(
            by_name[name],
            "disconnected",
            f"no joint attaches it, nor the root {roots[0]!r}; a tree has one root",
            "attach it by a fixed joint, or remove it",
        )


def _cycles(parent_of: dict[str, str]) -> Iterator[list[str]]:
    """Yield each cycle of a map from child to parent once, from the top down."""
    done: set[str] = set()
    for start in parent_of:
        path: list[str] = []
        name: str | None = start
        while name is not None and name not in done:
            done.add(name)
            path.append(name)
            name = parent_of.get(name)
        if name in path:
            yield list(reversed(path[path.index(name) :]))


def above_free_base(root: etree._Element) -> list[etree._Element]:
    """Return the joints and links of a URDF that are left out because its robot moves freely.

    These are a floating or planar joint and all that is not below it, if nothing else moves there:
    the world, with what stands in it.
    """
    joints = root.findall("joint")
    children: dict[str | None, list[str | None]] = {}
    for parent, child in map(_ends, joints):
        children.setdefault(parent, []).append(child)
    below = {}
    """Links below each free joint."""
    for joint in joints:
        if joint.get("type") in _REPLACEMENT:
            reached, todo = set[str | None](), [_ends(joint)[1]]
            while todo:
                link = todo.pop()
                if link not in reached:
                    reached.add(link)
                    todo += children.get(link, [])
            below[joint] = reached
    if not below:
        return []
    base = min(below, key=lambda joint: len(below[joint]))
    outside = [joint for joint in joints if _ends(joint)[0] not in below[base]]
    if any(
        joint.get("type") != "fixed" and not below[base] <= below.get(joint, set())
        for joint in outside
    ):
        return []
    links = [link for link in root.iterfind("link") if link.get("name") not in below[base]]
    return [*outside, *links]


def _kinds(root: etree._Element, origin: str) -> Iterator[Finding]:
    left_out = above_free_base(root)
    for joint in root.iterfind("joint"):
        kind = joint.get("type")
        if kind in _REPLACEMENT and joint in left_out:
            links = [element for element in left_out if element.tag == "link"]
            names = ", ".join(repr(link.get("name")) for link in links[:5])
            shapes = sum(1 for link in links for _ in link.iterchildren("visual", "collision"))
            yield UrdfLocation.of(joint, origin).finding(
                joint,
                "base-free",
                f"it is {kind} and lets the whole robot move; the base of a robot is fixed",
                "attach the robot by a joint of type fixed, if it stands",
                f"joint {joint.get('name')!r} of type {kind} and {len(links)} links above it with "
                f"{shapes} shapes, {names}, were left out",
            )
        elif kind in _REPLACEMENT:
            yield UrdfLocation.of(joint, origin).finding(
                joint,
                "joint-type-unsupported",
                f"joints of type {kind!r} are not supported",
                _REPLACEMENT[kind],
            )
        elif kind and kind not in JOINT_KINDS:
            yield UrdfLocation.of(joint, origin).finding(
                joint,
                "joint-type-unknown",
                f"{kind!r} is not a joint type",
                f"use one{nearest(kind, JOINT_KINDS)}",
            )


def _mimics(joints: Sequence[etree._Element], origin: str) -> Iterator[Finding]:
    by_name = {name: joint for joint in joints if (name := joint.get("name"))}
    leader_of: dict[str, str] = {}
    for name, joint in by_name.items():
        mimic = joint.find("mimic")
        leader = None if mimic is None else mimic.get("joint")
        if mimic is None or not leader:
            continue
        if leader in by_name:
            leader_of[name] = leader
        else:
            yield UrdfLocation.of(joint, origin).finding(
                mimic,
                "mimic-unknown",
                f"it mimics {leader!r}, which is not a joint",
                f"name a joint{nearest(leader, by_name)}",
                f"its <mimic> of {leader!r}, which is not a joint, was left out: "
                "it moves independently",
            )
    for cycle in _cycles(leader_of):
        yield UrdfLocation.of(by_name[cycle[0]], origin).finding(
            by_name[cycle[0]],
            "mimic-cycle",
            "joints mimic each other: " + " -> ".join([*cycle, cycle[0]]),
            "let one of them move independently",
        )
