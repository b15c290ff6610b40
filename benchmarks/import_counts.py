"""Count what URDF files hold, without morphgen's reader, and what became of it.

    python benchmarks/import_counts.py [PACKAGE|DIR ...]

Python's minidom counts elements, attributes and texts of every URDF of the packages of
``import_scoreboard.py``. A row has the count in the files, how many the ``Robot`` holds, how many
findings leave out, by count or by another finding about the file's structure, and the rest, which
must be 0. Of poses, axes and other values with a default, only those that differ from it count. An
element that a finding leaves out stands for all inside. Not counted are the rotation of inertias,
definitions of materials, and files that are refused or no valid XML. The exit code is 1 if
anything is unexplained.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections import Counter
from typing import Any
from xml.dom import expatbuilder, minidom
from xml.parsers import expat

from tabulate import tabulate
from tqdm import tqdm

from import_scoreboard import PACKAGES, _folder
from morphgen.errors import MorphgenError
from morphgen.formats.resolve import default_finder
from morphgen.formats.urdf.read import read_urdf
from morphgen.model.geometry import IDENTITY, Mesh
from morphgen.model.robot import Robot

Counts = Counter[tuple[str, str]]

_LEFT_OUT = re.compile(r"left out: (\d+) (?:(<[^>]+>)|([^ ]+)=\.\.\.|(text)) of <(\w+)>")
_STRUCTURAL = {
    "base-free",
    "element-missing",
    "element-repeated",
    "geometry-missing",
    "geometry-unknown",
    "material-unknown",
    "mimic-unknown",
    "number-count",
    "size-not-positive",
}
"""Codes of findings that leave out an element without its count."""
_DEFAULTS = {
    ("origin", "xyz"): (0, 0, 0),
    ("origin", "rpy"): (0, 0, 0),
    ("axis", "xyz"): (1, 0, 0),
    ("dynamics", "damping"): (0,),
    ("dynamics", "friction"): (0,),
    ("mimic", "multiplier"): (1,),
    ("mimic", "offset"): (0,),
}
_UNCOUNTED = {
    *(("robot", name) for name in ("name", "version", "<material>", "<mujoco>", "<morphgen>")),
    *(("material", name) for name in ("name", "<color>")),
    *((tag, "<origin>") for tag in ("inertial", "visual", "collision", "joint")),
    *(("joint", name) for name in ("<axis>", "<limit>", "<dynamics>")),
    *((tag, "name") for tag in ("visual", "collision")),
    *(("limit", name) for name in ("lower", "upper")),
    ("color", "rgba"),
    ("mesh", "scale"),
    ("inertial origin", "rpy"),
}
"""Names that only hold others, refer to others, or may have the default."""


def count_elements(data: bytes, left_out: Counts) -> Counts:
    """Count elements, attributes and texts by their parent, without those inside what is left out.

    Raises:
        ExpatError: If it is not valid XML.
    """
    counts: Counts = Counter()
    todo: list[tuple[str, Any]] = [
        ("", expatbuilder.parseString(data, namespaces=False).documentElement)
    ]
    while todo:
        parent, element = todo.pop()
        tag = element.tagName
        is_inertial = (parent, tag) == ("inertial", "origin")
        for name, text in element.attributes.items():
            owner = "inertial origin" if is_inertial and name == "rpy" else tag
            default = _DEFAULTS.get((owner, name), ())
            if text.strip() and not name.startswith("xmlns") and not _equals(text, default):
                counts[owner, name] += 1
        for child in element.childNodes:
            if isinstance(child, minidom.Element):
                key = (tag, f"<{child.tagName}>")
                counts[key] += 1
                if key not in left_out and not (tag == "robot" and key in _UNCOUNTED):
                    todo.append((tag, child))
        texts = [child.data for child in element.childNodes if isinstance(child, minidom.Text)]
        counts[tag, "text"] += any(text.strip() for text in texts)
    return counts


def _equals(text: str, default: tuple[float, ...]) -> bool:
    return bool(default) and tuple(map(float, text.split())) == default


def robot_counts(robot: Robot) -> Counts:
    """Count what a robot holds, by the names of the URDF."""
    visuals = [shape for link in robot.links for shape in link.visuals]
    collisions = [shape for link in robot.links for shape in link.collisions]
    inertials = [link.inertial for link in robot.links if link.inertial is not None]
    poses = [joint.T_parent_joint for joint in robot.joints]
    poses += [shape.T_link_shape for shape in visuals + collisions]
    joints, links = len(robot.joints), len(robot.links)
    mimics = [joint.mimic for joint in robot.joints if joint.mimic is not None]
    counts: Counts = Counter(
        {
            ("robot", "<link>"): links,
            ("link", "name"): links,
            ("link", "<visual>"): len(visuals),
            ("visual", "<geometry>"): len(visuals),
            ("visual", "<material>"): sum(shape.rgba is not None for shape in visuals),
            ("link", "<collision>"): len(collisions),
            ("collision", "<geometry>"): len(collisions),
            ("link", "<inertial>"): len(inertials),
            ("inertial", "<mass>"): len(inertials),
            ("mass", "value"): len(inertials),
            ("inertial", "<inertia>"): len(inertials),
            **{
                ("inertia", f"i{axes}"): len(inertials)
                for axes in ("xx", "xy", "xz", "yy", "yz", "zz")
            },
            ("robot", "<joint>"): joints,
            **{("joint", name): joints for name in ("name", "type", "<parent>", "<child>")},
            ("parent", "link"): joints,
            ("child", "link"): joints,
            ("limit", "effort"): sum(joint.effort is not None for joint in robot.joints),
            ("limit", "velocity"): sum(joint.velocity is not None for joint in robot.joints),
            ("dynamics", "damping"): sum(joint.damping != 0 for joint in robot.joints),
            ("dynamics", "friction"): sum(joint.friction != 0 for joint in robot.joints),
            ("axis", "xyz"): sum(joint.axis != (1, 0, 0) for joint in robot.joints),
            ("joint", "<mimic>"): len(mimics),
            ("mimic", "joint"): len(mimics),
            ("mimic", "multiplier"): sum(mimic.multiplier != 1 for mimic in mimics),
            ("mimic", "offset"): sum(mimic.offset != 0 for mimic in mimics),
            ("origin", "xyz"): sum(any(T.position) for T in poses)
            + sum(any(inertial.com) for inertial in inertials),
            ("origin", "rpy"): sum(T.quaternion != IDENTITY.quaternion for T in poses),
        }
    )
    sizes = {"box": ("size",), "sphere": ("radius",), "mesh": ("filename",)}
    for shape in visuals + collisions:
        tag = "mesh" if isinstance(shape.geometry, Mesh) else type(shape.geometry).__name__.lower()
        counts["geometry", f"<{tag}>"] += 1
        for name in sizes.get(tag, ("radius", "length")):
            counts[tag, name] += 1
    return counts


def main() -> int:
    """Count all files and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sources", nargs="*", metavar="PACKAGE|DIR", default=list(PACKAGES))
    outcome: Counter[str] = Counter()
    held, known, counted, structural, rest = Counts(), Counts(), Counts(), Counts(), Counts()
    kinds: dict[tuple[str, str], list[int]] = {}
    for root in map(_folder, parser.parse_args().sources):
        for path in tqdm(sorted(root.rglob("*.urdf")), unit="file", file=sys.stderr):
            try:
                robot = read_urdf(path, finder=default_finder(root=root))
                left = left_out(robot)
                file = count_elements(path.read_bytes(), left)
            except MorphgenError:
                outcome["refused"] += 1
                continue
            except expat.ExpatError:
                outcome["no valid XML, but read"] += 1
                continue
            outcome["counted"] += 1
            for key, count in left.items():
                row = kinds.setdefault(key, [0, 0])
                row[0], row[1] = row[0] + count, row[1] + 1
            is_structural = any(finding.code in _STRUCTURAL for finding in robot.source_findings)
            in_robot = robot_counts(robot)
            for key in file.keys() - _UNCOUNTED:
                held[key] += file[key]
                known[key] += 0 if key in left else min(in_robot[key], file[key])
                counted[key] += min(left[key], file[key])
                missing = file[key] - (left[key] if key in left else in_robot[key])
                (structural if is_structural and missing > 0 else rest)[key] += abs(missing)
                if missing and not is_structural:
                    tqdm.write(f"{path}: {' '.join(key)}: {missing}", file=sys.stderr)
    print(", ".join(f"{count} files {name}" for name, count in outcome.items()))
    heads = ["of", "name", "in files", "in robots", "left out", "structural finding", "unexplained"]
    rows = [
        (*k, held[k], known[k], counted[k], structural[k], rest[k]) for k in sorted(held) if held[k]
    ]
    print(tabulate(rows, heads))
    print(
        tabulate([(*k, *row) for k, row in sorted(kinds.items())], [*heads[:2], "count", "files"])
    )
    return int(any(rest.values()))


def left_out(robot: Robot) -> Counts:
    """Return how many elements, attributes and texts of each kind the findings leave out."""
    counts: Counts = Counter()
    for finding in robot.source_findings:
        if match := _LEFT_OUT.match(finding.repair):
            count, element, attribute, text, tag = match.groups()
            counts[tag, element or attribute or text] += int(count)
    return counts


if __name__ == "__main__":
    sys.exit(main())
