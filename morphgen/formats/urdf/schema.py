"""Rules of URDF: its elements and attributes, and the tree of its links."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from lxml import etree

from morphgen.errors import nearest, shortened
from morphgen.formats.xml import Attribute, found, read_schema
from morphgen.model.findings import Finding
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


def _finding(element: etree._Element, row: str, owner: str = "", /, **values: Any) -> Finding:  # noqa: ANN401
    """Return the finding of a row at an element's line, with the link or joint around it."""
    top = [element, *element.iterancestors()][-2:][0]
    name = top.get("name")
    owner = owner or (f"{top.tag} {shortened(name)!r}" if name else f"{top.tag} without a name")
    return found(row, f":{element.sourceline} {owner}", **values)


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
    for (tag, kind, name), elements in unread.items():
        yield _unread_finding(tag, kind, name, elements)


def _unread_finding(tag: str, kind: str, name: str, elements: list[etree._Element]) -> Finding:
    first, local = elements[0], etree.QName(name).localname if name else ""
    valid: Sequence[str] = ()
    what = f"{len(elements)} text of <{tag}>"
    if kind == "element":
        prefix = f"{first.prefix}:" if first.prefix else ""
        what = counted_elements(elements, f"{prefix}{local}", tag)
        valid = _READ_CHILDREN.get(tag, ())
    elif kind == "attribute":
        prefixes = {namespace: prefix for prefix, namespace in first.nsmap.items()}
        prefix = f"{prefixes.get(etree.QName(name).namespace)}:" if local != name else ""
        what = f"{len(elements)} {prefix}{local}=... of <{tag}>"
        valid = _READ_ATTRIBUTES.get(tag, ())
    if name in _SCHEMA.left_out.split() or local != name:
        return _finding(first, f"{kind}-unread/known", what=what)
    hint = nearest(shortened(name), valid) if valid else ""
    guess = f"{hint.partition('?')[0]}?" if "?" in hint else ""
    return _finding(first, f"{kind}-unread", what=what, hint=hint, guess=guess)


def counted_elements(elements: Sequence[etree._Element], name: str, parent: str) -> str:
    """Return the number of elements of a name in others, and of what is inside of them."""
    inside = sum(1 for element in elements for _ in element.iterdescendants())
    more = f" with {inside} elements inside" if inside else ""
    return f"{len(elements)} <{name}> of <{parent}>{more}"


def content_findings(element: etree._Element) -> Iterator[Finding]:
    """Check an element and everything that is read inside it."""
    tag = element.tag
    for attribute in _SCHEMA.attributes.get(tag, ()):
        check = _number_findings if attribute.counts else _text_findings
        yield from check(element, attribute)
    yield from _missing_findings(element)
    yield from _rotation_findings(element)
    if tag == "geometry":
        yield from _geometry_findings(element)
    # `_robot_findings` checks the children of <robot>.
    for name, mark in () if tag == "robot" else CHILDREN.get(tag, {}).items():
        children = element.findall(name)
        if len(children) > 1 and mark != "*":
            values = {"tag": tag, "name": name, "count": len(children)}
            yield _finding(children[1], "element-repeated", **values)
        for child in children:
            yield from content_findings(child)


def _text_findings(element: etree._Element, attribute: Attribute) -> Iterator[Finding]:
    tag, name = element.tag, attribute.name
    value = element.get(name, "")
    if not attribute.required:
        return
    if len(value) > MAX_TEXT or not value.isprintable():
        values = {"text": shortened(value), "most": MAX_TEXT}
        yield _finding(element, "text-invalid", tag=tag, name=name, **values)
    if not value.strip():
        yield _finding(element, "attribute-missing", tag=tag, name=name, others="")


def _missing_findings(element: etree._Element) -> Iterator[Finding]:
    tag = element.tag
    for name, repair in _SCHEMA.expected.get(tag, {}).items():
        if element.find(name) is None:
            yield _finding(element, "element-missing", tag=tag, name=name, repair=repair)


def _geometry_findings(element: etree._Element) -> Iterator[Finding]:
    kinds = CHILDREN["geometry"]
    tags = ", ".join(f"<{name}>" for name in kinds)
    shapes = [child for child in element if isinstance(child.tag, str)]
    if not shapes:
        yield _finding(element, "geometry-missing", tags=tags)
        return
    known = [shape for shape in shapes if shape.tag in kinds]
    for shape in shapes:
        if shape not in known:
            tag = f"<{shortened(shape.tag)}>"
            yield _finding(shape, "geometry-unknown", tag=tag, tags=tags)
    if len(known) > 1:
        yield _finding(known[1], "element-repeated/geometry", count=len(known))


def _number_findings(element: etree._Element, attribute: Attribute) -> Iterator[Finding]:
    name, counts = attribute.name, attribute.counts
    text = element.get(name)
    if text is None:
        if attribute.required:
            values = {"tag": element.tag, "name": name, "others": _others(element)}
            yield _finding(element, "attribute-missing", **values)
        return
    shown = f'<{element.tag} {name}="{shortened(text)}">'
    words = text.replace(",", " ").split() if max(counts) > 1 else text.split()
    wrong = [w for w in words if not (_DECIMAL.fullmatch(w) and math.isfinite(float(w)))]
    if wrong:
        yield _finding(element, "number-malformed", shown=shown, word=shortened(wrong[0]))
        return
    if len(words) not in counts:
        surplus = name == "scale" and len(words) > max(counts)  # some exporters write them
        expected = {"counts": " or ".join(map(str, counts)), "most": max(counts)}
        fault = {"shown": shown, "count": len(words), "repairable": surplus}
        yield _finding(element, "number-count", **fault, **expected)
        if not surplus:
            return
        words = words[: max(counts)]
    if "," in text:
        yield _finding(element, "number-commas", shown=shown, repairable=name in _WITH_COMMAS)
    numbers = [float(word) for word in words]
    is_short = attribute.positive and 0 < min(numbers) < MIN_LENGTH
    if max(map(abs, numbers)) > MAX_NUMBER or is_short:
        bounds = {"most": MAX_NUMBER, "least": MIN_LENGTH}
        yield _finding(element, "number-absurd", shown=shown, **bounds)
    if attribute.positive and min(numbers) <= 0:
        yield _finding(element, "size-not-positive", shown=shown, repairable=min(numbers) == 0)
    if name == "scale" and 0.0 in numbers:
        yield _finding(element, "mesh-scale-invalid", shown=shown)


def _rotation_findings(element: etree._Element) -> Iterator[Finding]:
    quaternion = element.get("quat_xyzw", "1").split()
    if element.tag == "origin" and (
        (element.get("rpy") and element.get("quat_xyzw"))
        or not any(float(w) for w in quaternion if _DECIMAL.fullmatch(w))
    ):
        yield _finding(element, "rotation-invalid")


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
    """Check that a URDF is a kinematic tree with valid numbers and can be converted."""
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
    owner = f"robot {shortened(root.get('name', ''))!r}" if root.get("name") else ""
    values = {"name": name, "repairable": not broken}
    xacro_finding = _finding(unexpanded, "xacro-unexpanded", owner, **values)
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
            yield _finding(root, "robot-too-large", count=count, tag=tag, most=max_count)


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
        yield _finding(root, "link-missing")
    yield from _duplicates(links)
    yield from _duplicates(joints)
    yield from _tree(links, joints)
    yield from _kinds(root)
    yield from _mimics(joints)
    for element in [*links, *joints, *root.findall("material")]:
        yield from content_findings(element)


def _wrong_root(root: etree._Element) -> Finding:
    name = etree.QName(root)
    tag = f"{root.prefix}:{name.localname}" if root.prefix else name.localname
    row = "root-not-robot"
    if root.prefix:
        row = "root-not-robot/prefix"
    elif name.localname == "robot":
        row = "root-not-robot/namespace"
    namespace = shortened(str(name.namespace))
    return _finding(root, row, f"<{tag}>", tag=tag, prefix=root.prefix, namespace=namespace)


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
            values = {"kind": element.tag, "line": first[name].sourceline}
            yield _finding(element, f"{element.tag}-duplicate", **values)
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
                values = {"role": role, "name": name, "hint": nearest(name, by_name)}
                yield _finding(joint, "joint-link-unknown", **values)
        if not child or child not in by_name:
            continue
        if child in joint_above:
            other, line = joint_above[child].get("name"), joint_above[child].sourceline
            yield _finding(joint, "link-two-parents", child=child, other=other, line=line)
            continue
        joint_above[child] = joint
        if parent in by_name:
            parent_of[child] = parent
    for cycle in _cycles(parent_of):
        yield _finding(joint_above[cycle[0]], "cycle", chain=" -> ".join([*cycle, cycle[0]]))
    roots = [name for name in by_name if name not in joint_above]
    for name in roots[1:]:
        yield _finding(by_name[name], "disconnected", root=roots[0])


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
            values = {"count": len(links), "shapes": shapes, "names": names}
            yield _finding(joint, "base-free", joint=joint.get("name"), kind=kind, **values)
        elif kind in _REPLACEMENT:
            replacement = _REPLACEMENT[kind]
            yield _finding(joint, "joint-type-unsupported", kind=kind, replacement=replacement)
        elif kind and kind not in JOINT_KINDS:
            hint = nearest(kind, JOINT_KINDS)
            yield _finding(joint, "joint-type-unknown", kind=kind, hint=hint)


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
            hint = nearest(leader, by_name)
            yield _finding(mimic, "mimic-unknown", leader=leader, hint=hint)
    for cycle in _cycles(leader_of):
        yield _finding(by_name[cycle[0]], "mimic-cycle", chain=" -> ".join([*cycle, cycle[0]]))
