"""Rules of URDF: its elements and attributes, and the tree of its links."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import TypeAlias

from lxml import etree

from morphgen.errors import nearest, shortened
from morphgen.formats.urdf.write import MUJOCO_BOUNDS
from morphgen.model.findings import Finding, left_out
from morphgen.model.robot import JOINT_KINDS

_DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


MAX_NUMBER = 1e20
"""Largest number that a URDF may hold; simulators overflow above it."""
MIN_LENGTH = 1e-6
"""Smallest length of a primitive [m]; simulators round smaller ones to zero."""
MAX_TEXT = 1000
"""Longest name or file name in a URDF [characters]."""


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


@dataclass(frozen=True)
class Numbers:
    """An attribute that holds numbers."""

    attribute: str
    counts: tuple[int, ...] = (1,)
    """Valid counts of numbers."""
    required: bool = False
    """Whether a missing attribute is an error."""
    positive: bool = False
    nonzero: bool = False
    accepts_commas: bool = False
    """Whether commas between the numbers are repaired instead of refused."""
    accepts_surplus: bool = False
    """Whether surplus numbers are ignored instead of refused."""


CHILDREN = {
    "link": ("inertial", "visual", "collision"),
    "inertial": ("origin", "mass", "inertia"),
    "visual": ("origin", "geometry", "material"),
    "collision": ("origin", "geometry"),
    "geometry": ("box", "capsule", "cylinder", "sphere", "mesh"),
    "material": ("color",),
    "joint": (
        "origin",
        "parent",
        "child",
        "axis",
        "limit",
        "mimic",
        "dynamics",
        "calibration",
        "safety_controller",
    ),
}
"""Child elements that are read, by parent element."""

_UNREAD = ("calibration", "safety_controller")
"""Children that are not read, but whose numbers are checked: loaders refuse invalid ones."""
_READ_CHILDREN = {
    "robot": ("link", "joint", "material", "mujoco", "morphgen"),
    **{tag: tuple(n for n in names if n not in _UNREAD) for tag, names in CHILDREN.items()},
    "mujoco": ("compiler",),
    "morphgen": ("home", "frame"),
}
_REPEATABLE = ("visual", "collision")
_EXPECTED_CHILDREN: dict[str, dict[str, str]] = {
    "joint": {"parent": "", "child": ""},
    "inertial": {
        "mass": "its <inertial> without <mass> was left out",
        "inertia": "the missing <inertia> was read as zero",
    },
    "visual": {"geometry": "a <visual> without <geometry> was left out"},
    "collision": {"geometry": "a <collision> without <geometry> was left out"},
}
"""Children that an element should have, with the repair if one is missing; empty: an error."""
_REQUIRED_TEXT = {
    "robot": ("name",),
    "link": ("name",),
    "joint": ("name", "type"),
    "parent": ("link",),
    "child": ("link",),
    "mimic": ("joint",),
    "mesh": ("filename",),
}
_NUMBERS = {
    "origin": (Numbers("xyz", (3,)), Numbers("rpy", (3,)), Numbers("quat_xyzw", (4,))),
    "axis": (Numbers("xyz", (3,)),),
    "limit": tuple(Numbers(name) for name in ("lower", "upper", "effort", "velocity")),
    "mimic": (Numbers("multiplier"), Numbers("offset")),
    "dynamics": (Numbers("damping"), Numbers("friction")),
    "calibration": (Numbers("rising"), Numbers("falling")),
    "safety_controller": tuple(
        Numbers(name)
        for name in ("soft_lower_limit", "soft_upper_limit", "k_position", "k_velocity")
    ),
    "mass": (Numbers("value", required=True),),
    "inertia": tuple(
        Numbers(name, required=True) for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    ),
    "box": (Numbers("size", (3,), required=True, positive=True, accepts_commas=True),),
    "sphere": (Numbers("radius", required=True, positive=True),),
    "capsule": (
        Numbers("radius", required=True, positive=True),
        Numbers("length", positive=True),
        Numbers("fromto", (6,)),
    ),
    "cylinder": (
        Numbers("radius", required=True, positive=True),
        Numbers("length", required=True, positive=True),
    ),
    "mesh": (Numbers("scale", (1, 3), nonzero=True, accepts_commas=True, accepts_surplus=True),),
    "color": (Numbers("rgba", (4,)),),
}


_LABELS = {
    "robot": ("version",),
    "visual": ("name",),
    "collision": ("name",),
    "material": ("name",),
    "geometry": (),
    "mujoco": (),
    "compiler": ("meshdir", "strippath", "fusestatic", "discardvisual", *MUJOCO_BOUNDS),
    "morphgen": (),
    "home": ("joint", "position"),
    "frame": ("name",),
}
"""Further attributes that are read or only say how to load the file."""
_ATTRIBUTES = {
    tag: (
        *_REQUIRED_TEXT.get(tag, ()),
        *(numbers.attribute for numbers in _NUMBERS.get(tag, ())),
        *_LABELS.get(tag, ()),
    )
    for tag in (*_REQUIRED_TEXT, *_NUMBERS, *_LABELS)
}
"""Attributes that are read, by element."""
_EXTENSIONS = (
    "acceleration calibration collision_checking contact contact_coefficients controller_gains "
    "deceleration deformable dont_collapse gazebo gravity inertial_frame jerk joint_properties "
    "kinematic ros2_control safety_controller self_collision_checking self_filter sensor specular "
    "surface texture transmission type verbose"
)
"""Names that robot software knows and that a robot has no place for; others may be slips."""


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
            if name not in _ATTRIBUTES.get(tag, ()):
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
    valid: tuple[str, ...] = ()
    what = f"{len(found)} text of <{tag}>"
    if kind == "element":
        prefix = f"{first.prefix}:" if first.prefix else ""
        what, valid = counted_elements(found, f"{prefix}{local}", tag), _READ_CHILDREN.get(tag, ())
    elif kind == "attribute":
        prefixes = {namespace: prefix for prefix, namespace in first.nsmap.items()}
        prefix = f"{prefixes.get(etree.QName(name).namespace)}:" if local != name else ""
        what, valid = f"{len(found)} {prefix}{local}=... of <{tag}>", _ATTRIBUTES.get(tag, ())
    code, where = f"{kind}-unread", _finding(first, "", "", "").where
    if name in _EXTENSIONS.split() or local != name:
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
    numbers = (_number_faults(element, numbers) for numbers in _NUMBERS.get(tag, ()))
    checks = (_text_faults(element), *numbers, _missing_faults(element))
    for fault in chain(*checks, _alternative_faults(element)):
        yield _finding(element, *fault)
    if tag == "geometry":
        yield from _geometry_findings(element)
    for name in CHILDREN.get(tag, ()):
        children = element.findall(name)
        if len(children) > 1 and name not in _REPEATABLE:
            yield _finding(
                children[1],
                "element-repeated",
                f"<{tag}> has {len(children)} <{name}>; the first one counts",
                "keep one",
                f"of {len(children)} <{name}> the first one was taken",
            )
        for child in children:
            yield from content_findings(child)


_Fault: TypeAlias = tuple[str, ...]
"""Code, reason and advice of a finding about an element, and its repair if there is one."""


def _text_faults(element: etree._Element) -> Iterator[_Fault]:
    tag = element.tag
    for name in _REQUIRED_TEXT.get(tag, ()):
        value = element.get(name, "")
        if len(value) > MAX_TEXT or not value.isprintable():
            yield (
                "text-invalid",
                f"<{tag} {name}={shortened(value)!r}> holds line breaks or other characters that "
                f"cannot be printed, or more than {MAX_TEXT} characters",
                "write a shorter text of printable characters",
            )
        if not value.strip():
            yield ("attribute-missing", f"<{tag}> has no {name}", f'write <{tag} {name}="...">')


def _missing_faults(element: etree._Element) -> Iterator[_Fault]:
    tag = element.tag
    for name, repair in _EXPECTED_CHILDREN.get(tag, {}).items():
        if element.find(name) is None:
            yield (
                "element-missing",
                f"<{tag}> has no <{name}>",
                f"add <{name}> or drop <{tag}>",
                repair,
            )


def _geometry_findings(element: etree._Element) -> Iterator[Finding]:
    kinds = CHILDREN["geometry"]
    shapes = [child for child in element if isinstance(child.tag, str)]
    if not shapes:
        yield _finding(
            element,
            "geometry-missing",
            "<geometry> is empty",
            f"put one of {_tags(kinds)} into it",
            "a shape with an empty <geometry> was left out",
        )
        return
    known = [shape for shape in shapes if shape.tag in kinds]
    for shape in shapes:
        if shape not in known:
            yield _finding(
                shape,
                "geometry-unknown",
                f"<{shortened(shape.tag)}> is not a geometry of URDF",
                f"use one of {_tags(kinds)}",
                f"the geometry <{shortened(shape.tag)}> was left out",
            )
    if len(known) > 1:
        yield _finding(
            known[1],
            "element-repeated",
            f"<geometry> holds {len(known)} shapes; the first one counts",
            "give each its own <visual> or <collision>",
            f"of {len(known)} shapes in one <geometry> the first one was taken",
        )


def _number_faults(element: etree._Element, numbers: Numbers) -> Iterator[_Fault]:
    name = numbers.attribute
    text = element.get(name)
    if text is None:
        if numbers.required:
            yield (
                "attribute-missing",
                f"<{element.tag}> has no {name}{_others(element)}",
                f'write <{element.tag} {name}="...">',
            )
        return
    shown = f'<{element.tag} {name}="{shortened(text)}">'
    counts = " or ".join(str(count) for count in numbers.counts)
    vector = max(numbers.counts) > 1
    words = text.replace(",", " ").split() if vector else text.split()
    wrong = [w for w in words if not (_DECIMAL.fullmatch(w) and math.isfinite(float(w)))]
    if wrong:
        yield (
            "number-malformed",
            f"{shown}: {shortened(wrong[0])!r} is not a finite decimal number",
            "write decimal numbers with a point, separated by spaces",
        )
        return
    if len(words) not in numbers.counts:
        surplus = numbers.accepts_surplus and len(words) > max(numbers.counts)
        yield (
            "number-count",
            f"{shown} holds {len(words)} numbers",
            f"write {counts}",
            f"of {shown} the first {max(numbers.counts)} numbers were taken" if surplus else "",
        )
        if not surplus:
            return
        words = words[: max(numbers.counts)]
    if "," in text:
        yield (
            "number-commas",
            f"{shown} separates numbers by commas, which MuJoCo refuses",
            "separate them by spaces",
            f"the commas of {shown} were read as spaces" if numbers.accepts_commas else "",
        )
    values = [float(word) for word in words]
    if max(map(abs, values)) > MAX_NUMBER or (numbers.positive and 0 < min(values) < MIN_LENGTH):
        yield (
            "number-absurd",
            f"{shown} is out of range",
            f"write numbers up to {MAX_NUMBER:g} and lengths from {MIN_LENGTH:g}, in SI units",
        )
    if numbers.positive and min(values) <= 0:
        yield (
            "size-not-positive",
            f"{shown} is not positive",
            "write lengths above 0, in metres",
            f"the shape {shown} was left out" if min(values) == 0 else "",
        )
    if numbers.nonzero and 0.0 in values:
        yield ("mesh-scale-invalid", f"{shown} flattens the mesh", "write factors other than 0")


def _alternative_faults(element: etree._Element) -> Iterator[_Fault]:
    """Check attributes of which an element has either one or the other."""
    quaternion = element.get("quat_xyzw", "1").split()
    if element.tag == "origin" and (
        (element.get("rpy") and element.get("quat_xyzw"))
        or not any(float(w) for w in quaternion if _DECIMAL.fullmatch(w))
    ):
        yield (
            "rotation-invalid",
            "its quat_xyzw is zero, or beside rpy",
            "write one rotation, as a quaternion of length 1 or as rpy",
        )
    ends = element.get("fromto", "").split()
    if (
        element.tag == "capsule"
        and not element.get("length")
        and (not ends or ends[:3] == ends[3:])
    ):
        yield (
            "attribute-missing",
            f"<capsule> has no length{_others(element)}, and no two end points as fromto",
            'write <capsule length="...">',
        )


def _others(element: etree._Element) -> str:
    """Return the first attribute that is not read, for an error about one that is missing."""
    others = [name for name in map(str, element.attrib) if name not in _ATTRIBUTES[element.tag]]
    return f", but {shortened(others[0])}" if others else ""


def _tags(names: tuple[str, ...]) -> str:
    return ", ".join(f"<{name}>" for name in names)


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
    xacro_finding = _finding(
        unexpanded,
        "xacro-unexpanded",
        f"{name} is left in the document",
        "give the file the suffix .xacro, or expand it first",
        "" if broken else f"{name} was left out",
        owner=f"robot {shortened(root.get('name', ''))!r}" if root.get("name") else "",
    )
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
            yield _finding(
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
            yield _finding(
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


def _tree(links: Sequence[etree._Element], joints: Sequence[etree._Element]) -> Iterator[Finding]:
    by_name = {name: link for link in links if (name := link.get("name"))}
    parent_of: dict[str, str] = {}
    joint_above: dict[str, etree._Element] = {}
    """Joint whose child a link is, by the link's name."""
    for joint in joints:
        parent, child = _ends(joint)
        for role, name in (("parent", parent), ("child", child)):
            if name and name not in by_name:
                yield _finding(
                    joint,
                    "joint-link-unknown",
                    f"its {role} {name!r} is not a link",
                    f"name a link{nearest(name, by_name)}",
                )
        if not child or child not in by_name:
            continue
        if child in joint_above:
            yield _finding(
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
        yield _finding(
            joint_above[cycle[0]],
            "cycle",
            "links form a loop: " + " -> ".join([*cycle, cycle[0]]),
            "remove one of the joints",
        )
    roots = [name for name in by_name if name not in joint_above]
    for name in roots[1:]:
        yield _finding(
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


def _kinds(root: etree._Element) -> Iterator[Finding]:
    left_out = above_free_base(root)
    for joint in root.iterfind("joint"):
        kind = joint.get("type")
        if kind in _REPLACEMENT and joint in left_out:
            links = [element for element in left_out if element.tag == "link"]
            names = ", ".join(repr(link.get("name")) for link in links[:5])
            shapes = sum(1 for link in links for _ in link.iterchildren("visual", "collision"))
            yield _finding(
                joint,
                "base-free",
                f"it is {kind} and lets the whole robot move; the base of a robot is fixed",
                "attach the robot by a joint of type fixed, if it stands",
                f"joint {joint.get('name')!r} of type {kind} and {len(links)} links above it with "
                f"{shapes} shapes, {names}, were left out",
            )
        elif kind in _REPLACEMENT:
            yield _finding(
                joint,
                "joint-type-unsupported",
                f"joints of type {kind!r} are not supported",
                _REPLACEMENT[kind],
            )
        elif kind and kind not in JOINT_KINDS:
            yield _finding(
                joint,
                "joint-type-unknown",
                f"{kind!r} is not a joint type",
                f"use one{nearest(kind, JOINT_KINDS)}",
            )


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
            yield _finding(
                mimic,
                "mimic-unknown",
                f"it mimics {leader!r}, which is not a joint",
                f"name a joint{nearest(leader, by_name)}",
                f"its <mimic> of {leader!r}, which is not a joint, was left out: "
                "it moves independently",
            )
    for cycle in _cycles(leader_of):
        yield _finding(
            by_name[cycle[0]],
            "mimic-cycle",
            "joints mimic each other: " + " -> ".join([*cycle, cycle[0]]),
            "let one of them move independently",
        )
