"""Rules of URDF: its elements and attributes, and the tree of its links."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import TypeAlias

from lxml import etree

from morphgen.errors import nearest, shortened
from morphgen.formats.xml import Attribute, read_schema
from morphgen.model.findings import Finding, left_out
from morphgen.model.robot import JOINT_KINDS

_DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")  # neither NaN nor hex
MAX_NUMBER = 1e20  # largest number that a URDF may hold; simulators overflow above it
MIN_LENGTH = 1e-6  # smallest length of a primitive [m]; simulators round smaller ones to zero
MAX_TEXT = 1000  # longest name or file name in a URDF [characters]
MAX_LINKS = 1000  # largest number of links, and of joints, that is read
MAX_SHAPES = 10_000  # largest number of visual and collision shapes that is read
MAX_ERRORS = 50  # number of errors after which the check stops

_SCHEMA = read_schema("urdf")
CHILDREN = _SCHEMA.children  # children that are read or checked, by element
_READ_ATTRIBUTES = {tag: [each.name for each in rules] for tag, rules in _SCHEMA.attributes.items()}
_READ_CHILDREN = {
    tag: [name for name, mark in children.items() if mark != "?"]
    for tag, children in CHILDREN.items()
}
_WITH_COMMAS = ("size", "scale")  # attributes that MuJoCo alone refuses with commas


def _finding(
    element: etree._Element, code: str, why: str, fix: str, repair: str = "", owner: str = ""
) -> Finding:
    """Return a finding at an element's line: a warning if reading repairs it, else an error.

    It names the link, joint or other top-level element that contains the element.
    """
    top = [element, *element.iterancestors()][-2:][0]
    name = top.get("name")
    owner = owner or (f"{top.tag} {shortened(name)!r}" if name else f"{top.tag} without a name")
    where = f":{element.sourceline} {owner}"
    return Finding(code, "warning" if repair else "error", where, why, fix, repair)


def unread_findings(root: etree._Element) -> Iterator[Finding]:
    """Yield a finding for each kind of attribute, element and text that is not read.

    Each has its count and first place. Names that no robot software is known to have are warnings
    with the nearest name that is read; known extensions are for information.
    """
    unread: dict[tuple[str, str, str], list[etree._Element]] = {}
    todo = [root]
    while todo:
        element = todo.pop()
        tag = str(element.tag)
        for name in map(str, element.attrib):
            if name not in _READ_ATTRIBUTES.get(tag, ()):
                unread.setdefault((tag, "attribute", name), []).append(element)
        if any(text and text.strip() for text in (element.text, *(c.tail for c in element))):
            unread.setdefault((tag, "text", ""), []).append(element)
        deeper = [child for child in element if child.tag in _READ_CHILDREN.get(tag, ())]
        for child in element if tag != "geometry" else ():  # which has a finding of its own
            if child not in deeper:
                unread.setdefault((tag, "element", str(child.tag)), []).append(child)
        todo += reversed(deeper)
    for (tag, kind, name), found in unread.items():
        yield _unread_finding(tag, kind, name, found)


def _unread_finding(tag: str, kind: str, name: str, found: list[etree._Element]) -> Finding:
    first, local = found[0], etree.QName(name).localname if name else ""
    valid: Sequence[str] = ()
    what = f"{len(found)} text of <{tag}>"
    if kind == "element":
        prefix = f"{first.prefix}:" if first.prefix else ""
        what, valid = counted_elements(found, f"{prefix}{local}", tag), _READ_CHILDREN.get(tag, ())
    elif kind == "attribute":
        prefixes = {namespace: prefix for prefix, namespace in first.nsmap.items()}
        prefix = f"{prefixes.get(etree.QName(name).namespace)}:" if local != name else ""
        what, valid = f"{len(found)} {prefix}{local}=... of <{tag}>", _READ_ATTRIBUTES.get(tag, ())
    code, where = f"{kind}-unread", _finding(first, "", "", "").where
    if name in _SCHEMA.left_out.split() or local != name:
        return left_out(code, where, what)
    hint = nearest(shortened(name), valid) if valid else ""
    guess = f"{hint.partition('?')[0]}?" if "?" in hint else ""
    fix, repair = "correct the name, or remove it", f"left out: {what}, not of URDF{guess}"
    return Finding(code, "warning", where, f"{what}: not of URDF{hint}", fix, repair)


def counted_elements(elements: Sequence[etree._Element], name: str, parent: str) -> str:
    """Return the number of elements of a name in others, and of what is inside of them."""
    inside = sum(1 for element in elements for _ in element.iterdescendants())
    more = f" with {inside} elements inside" if inside else ""
    return f"{len(elements)} <{name}> of <{parent}>{more}"


def content_findings(element: etree._Element) -> Iterator[Finding]:
    """Check an element and everything that is read inside it."""
    tag = element.tag
    checks = [
        _number_faults(element, attribute) if attribute.counts else _text_faults(element, attribute)
        for attribute in _SCHEMA.attributes.get(tag, ())
    ]
    for fault in chain(*checks, _missing_faults(element), _rotation_faults(element)):
        yield _finding(element, *fault)
    if tag == "geometry":
        yield from _geometry_findings(element)
    # `_robot_findings` checks the children of <robot>.
    for name, mark in () if tag == "robot" else CHILDREN.get(tag, {}).items():
        children = element.findall(name)
        if len(children) > 1 and mark != "*":
            why = f"<{tag}> has {len(children)} <{name}>; the first one counts"
            repair = f"of {len(children)} <{name}> the first one was taken"
            yield _finding(children[1], "element-repeated", why, "keep one", repair)
        for child in children:
            yield from content_findings(child)


_Fault: TypeAlias = tuple[str, ...]
"""Code, reason and advice of a finding about an element, and its repair if there is one."""


def _text_faults(element: etree._Element, attribute: Attribute) -> Iterator[_Fault]:
    tag, name = element.tag, attribute.name
    value = element.get(name, "")
    if not attribute.required:
        return
    if len(value) > MAX_TEXT or not value.isprintable():
        why = (
            f"<{tag} {name}={shortened(value)!r}> holds line breaks or other characters that "
            f"cannot be printed, or more than {MAX_TEXT} characters"
        )
        yield "text-invalid", why, "write a shorter text of printable characters"
    if not value.strip():
        yield "attribute-missing", f"<{tag}> has no {name}", f'write <{tag} {name}="...">'


def _missing_faults(element: etree._Element) -> Iterator[_Fault]:
    tag = element.tag
    for name, repair in _SCHEMA.expected.get(tag, {}).items():
        if element.find(name) is None:
            why, fix = f"<{tag}> has no <{name}>", f"add <{name}> or drop <{tag}>"
            yield "element-missing", why, fix, repair


def _geometry_findings(element: etree._Element) -> Iterator[Finding]:
    kinds = CHILDREN["geometry"]
    tags = ", ".join(f"<{name}>" for name in kinds)
    shapes = [child for child in element if isinstance(child.tag, str)]
    if not shapes:
        fix, repair = f"put one of {tags} into it", "a shape with an empty <geometry> was left out"
        yield _finding(element, "geometry-missing", "<geometry> is empty", fix, repair)
        return
    known = [shape for shape in shapes if shape.tag in kinds]
    for shape in shapes:
        if shape not in known:
            tag = f"<{shortened(shape.tag)}>"
            why, fix = f"{tag} is not a geometry of URDF", f"use one of {tags}"
            yield _finding(shape, "geometry-unknown", why, fix, f"the geometry {tag} was left out")
    if len(known) > 1:
        why = f"<geometry> holds {len(known)} shapes; the first one counts"
        fix = "give each its own <visual> or <collision>"
        repair = f"of {len(known)} shapes in one <geometry> the first one was taken"
        yield _finding(known[1], "element-repeated", why, fix, repair)


def _number_faults(element: etree._Element, attribute: Attribute) -> Iterator[_Fault]:
    name, counts = attribute.name, attribute.counts
    text = element.get(name)
    if text is None:
        if attribute.required:
            why = f"<{element.tag}> has no {name}{_others(element)}"
            yield "attribute-missing", why, f'write <{element.tag} {name}="...">'
        return
    shown = f'<{element.tag} {name}="{shortened(text)}">'
    words = text.replace(",", " ").split() if max(counts) > 1 else text.split()
    wrong = [w for w in words if not (_DECIMAL.fullmatch(w) and math.isfinite(float(w)))]
    if wrong:
        why = f"{shown}: {shortened(wrong[0])!r} is not a finite decimal number"
        fix = "write decimal numbers with a point, separated by spaces"
        yield "number-malformed", why, fix
        return
    if len(words) not in counts:
        surplus = name == "scale" and len(words) > max(counts)  # some exporters write them
        repair = f"of {shown} the first {max(counts)} numbers were taken" if surplus else ""
        fix = f"write {' or '.join(map(str, counts))}"
        yield "number-count", f"{shown} holds {len(words)} numbers", fix, repair
        if not surplus:
            return
        words = words[: max(counts)]
    if "," in text:
        why = f"{shown} separates numbers by commas, which MuJoCo refuses"
        repair = f"the commas of {shown} were read as spaces" if name in _WITH_COMMAS else ""
        yield "number-commas", why, "separate them by spaces", repair
    values = [float(word) for word in words]
    if max(map(abs, values)) > MAX_NUMBER or (attribute.positive and 0 < min(values) < MIN_LENGTH):
        fix = f"write numbers up to {MAX_NUMBER:g} and lengths from {MIN_LENGTH:g}, in SI units"
        yield "number-absurd", f"{shown} is out of range", fix
    if attribute.positive and min(values) <= 0:
        repair = f"the shape {shown} was left out" if min(values) == 0 else ""
        fix = "write lengths above 0, in metres"
        yield "size-not-positive", f"{shown} is not positive", fix, repair
    if name == "scale" and 0.0 in values:
        yield "mesh-scale-invalid", f"{shown} flattens the mesh", "write factors other than 0"


def _rotation_faults(element: etree._Element) -> Iterator[_Fault]:
    quaternion = element.get("quat_xyzw", "1").split()
    if element.tag == "origin" and (
        (element.get("rpy") and element.get("quat_xyzw"))
        or not any(float(w) for w in quaternion if _DECIMAL.fullmatch(w))
    ):
        fix = "write one rotation, as a quaternion of length 1 or as rpy"
        yield "rotation-invalid", "its quat_xyzw is zero, or beside rpy", fix


def _others(element: etree._Element) -> str:
    """Return the first attribute that is not read, for an error about one that is missing."""
    valid = _READ_ATTRIBUTES[element.tag]
    others = [name for name in map(str, element.attrib) if name not in valid]
    return f", but {shortened(others[0])}" if others else ""


_REPLACEMENT = {
    "floating": "fix the body to the world, or use three prismatic and three revolute joints",
    "planar": "use two prismatic joints and a revolute one",
}


def structure_findings(root: etree._Element, origin: str) -> tuple[Finding, ...]:
    """Check that a URDF is a kinematic tree with valid numbers.

    Returns:
        Findings in the order of detection. A document without errors can be converted.
    """
    return tuple(replace(f, where=f"{origin}{f.where}") for f in _document_findings(root))


def _document_findings(root: etree._Element) -> list[Finding]:
    if root.tag != "robot":
        return [_wrong_root(root)]
    if large := [*_size_findings(root)]:
        return large
    findings = [*_first(_robot_findings(root)), *unread_findings(root)]
    unexpanded = _first_xacro(root)
    if unexpanded is None:
        return findings
    # Loaders ignore an unexpanded xacro call, so alone it is a warning. Next to other errors it is
    # their likely cause, and reported alone.
    broken = any(finding.severity == "error" for finding in findings)
    name = f"<xacro:{etree.QName(unexpanded).localname}>"
    why = f"{name} is left in the document"
    fix = "give the file the suffix .xacro, or expand it first"
    repair = "" if broken else f"{name} was left out"
    owner = f"robot {shortened(root.get('name', ''))!r}" if root.get("name") else ""
    xacro_finding = _finding(unexpanded, "xacro-unexpanded", why, fix, repair, owner)
    return [xacro_finding] if broken else [xacro_finding, *findings]


def _size_findings(root: etree._Element) -> Iterator[Finding]:
    """Check the number of elements first: later checks would take too long on a huge document."""
    for tag, elements, max_count in (
        ("link", root.iterfind("link"), MAX_LINKS),
        ("joint", root.iterfind("joint"), MAX_LINKS),
        ("visual and collision", root.iter("visual", "collision"), MAX_SHAPES),
    ):
        count = sum(1 for _ in elements)
        if count > max_count:
            why = f"it has {count} <{tag}> elements; at most {max_count} are read"
            fix = "leave out everything that is not part of the robot"
            yield _finding(root, "robot-too-large", why, fix)


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


def _robot_findings(root: etree._Element) -> Iterator[Finding]:
    links, joints = root.findall("link"), root.findall("joint")
    yield from content_findings(root)
    if not links:
        yield _finding(root, "link-missing", "<robot> has no <link>", "add at least one link")
    yield from _duplicates(links)
    yield from _duplicates(joints)
    yield from _tree(links, joints)
    yield from _kinds(root)
    yield from _mimics(joints)
    for element in [*links, *joints, *root.findall("material")]:
        yield from content_findings(element)


def _wrong_root(root: etree._Element) -> Finding:
    name = etree.QName(root)
    fix = "give a URDF or xacro, whose root element is <robot>, or an MJCF, whose is <mujoco>"
    tag = f"{root.prefix}:{name.localname}" if root.prefix else name.localname
    why = f"the root element is <{tag}>, not <robot>"
    if root.prefix:
        fix = f"remove the prefix {root.prefix!r} from all elements; robot software reads none"
    elif name.localname == "robot":
        why = f"the root element <robot> is in the namespace {shortened(str(name.namespace))!r}"
        fix = "remove xmlns=... from it"
    return _finding(root, "root-not-robot", why, fix, owner=f"<{tag}>")


def _first_xacro(root: etree._Element) -> etree._Element | None:
    for element in root.iter("{*}*"):
        namespace = etree.QName(element).namespace
        if namespace is not None and "xacro" in namespace:
            return element
    return None


def _duplicates(elements: Sequence[etree._Element]) -> Iterator[Finding]:
    first: dict[str, etree._Element] = {}
    for element in elements:
        name = element.get("name")
        if name in first:
            why = f"the name is taken by the {element.tag} on line {first[name].sourceline}"
            yield _finding(element, f"{element.tag}-duplicate", why, "rename one of them")
        elif name:
            first[name] = element


def _ends(joint: etree._Element) -> tuple[str | None, str | None]:
    parent, child = joint.find("parent"), joint.find("child")
    return (
        None if parent is None else parent.get("link"),
        None if child is None else child.get("link"),
    )


def _tree(links: Sequence[etree._Element], joints: Sequence[etree._Element]) -> Iterator[Finding]:
    by_name = {name: link for link in links if (name := link.get("name"))}
    parent_of: dict[str, str] = {}
    joint_above: dict[str, etree._Element] = {}  # joint whose child a link is, by the link's name
    for joint in joints:
        parent, child = _ends(joint)
        for role, name in (("parent", parent), ("child", child)):
            if name and name not in by_name:
                why = f"its {role} {name!r} is not a link"
                fix = f"name a link{nearest(name, by_name)}"
                yield _finding(joint, "joint-link-unknown", why, fix)
        if not child or child not in by_name:
            continue
        if child in joint_above:
            other = f"{joint_above[child].get('name')!r} (line {joint_above[child].sourceline})"
            why = f"link {child!r} is already the child of joint {other}"
            fix = "remove one joint: a robot is a tree, loops are not supported"
            yield _finding(joint, "link-two-parents", why, fix)
            continue
        joint_above[child] = joint
        if parent in by_name:
            parent_of[child] = parent
    for cycle in _cycles(parent_of):
        why = "links form a loop: " + " -> ".join([*cycle, cycle[0]])
        yield _finding(joint_above[cycle[0]], "cycle", why, "remove one of the joints")
    roots = [name for name in by_name if name not in joint_above]
    for name in roots[1:]:
        why = f"no joint attaches it, nor the root {roots[0]!r}; a tree has one root"
        fix = "attach it by a fixed joint, or remove it"
        yield _finding(by_name[name], "disconnected", why, fix)


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
    below = {}  # links below each free joint
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
    # The smallest part that moves freely is the robot; another free joint may stand above it.
    base = min(below, key=lambda joint: len(below[joint]))
    outside = [joint for joint in joints if _ends(joint)[0] not in below[base]]
    if any(
        joint.get("type") != "fixed" and not below[base] <= below.get(joint, set())
        for joint in outside
    ):
        return []
    links = [link for link in root.iterfind("link") if link.get("name") not in below[base]]
    return [*outside, *links]


def _kinds(root: etree._Element) -> Iterator[Finding]:
    left_out = above_free_base(root)
    for joint in root.iterfind("joint"):
        kind = joint.get("type")
        if kind in _REPLACEMENT and joint in left_out:
            links = [element for element in left_out if element.tag == "link"]
            names = ", ".join(repr(link.get("name")) for link in links[:5])
            shapes = sum(1 for link in links for _ in link.iterchildren("visual", "collision"))
            why = f"it is {kind} and lets the whole robot move; the base of a robot is fixed"
            fix = "attach the robot by a joint of type fixed, if it stands"
            repair = (
                f"joint {joint.get('name')!r} of type {kind} and {len(links)} links above it with "
                f"{shapes} shapes, {names}, were left out"
            )
            yield _finding(joint, "base-free", why, fix, repair)
        elif kind in _REPLACEMENT:
            why = f"joints of type {kind!r} are not supported"
            yield _finding(joint, "joint-type-unsupported", why, _REPLACEMENT[kind])
        elif kind and kind not in JOINT_KINDS:
            why, fix = f"{kind!r} is not a joint type", f"use one{nearest(kind, JOINT_KINDS)}"
            yield _finding(joint, "joint-type-unknown", why, fix)


def _mimics(joints: Sequence[etree._Element]) -> Iterator[Finding]:
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
            unknown = f"{leader!r}, which is not a joint"
            fix = f"name a joint{nearest(leader, by_name)}"
            repair = f"its <mimic> of {unknown}, was left out: it moves independently"
            yield _finding(mimic, "mimic-unknown", f"it mimics {unknown}", fix, repair)
    for cycle in _cycles(leader_of):
        why = "joints mimic each other: " + " -> ".join([*cycle, cycle[0]])
        yield _finding(by_name[cycle[0]], "mimic-cycle", why, "let one of them move independently")
