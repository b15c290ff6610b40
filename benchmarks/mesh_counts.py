"""Count the triangles of mesh files without morphgen's readers or trimesh, and compare.

    python benchmarks/mesh_counts.py FILE|DIR ...

The rows are the files in which both numbers differ, or from which something was left out. For a
single file the peak of memory and the CPU time of loading it are printed, too.
"""

from __future__ import annotations

import re
import resource
import struct
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from tabulate import tabulate

from morphgen.errors import MeshError
from morphgen.model.mesh_files import read_mesh_file

SUFFIXES = (".dae", ".obj", ".stl")


def count_triangles(path: Path) -> int:
    """Return the number of triangles that a mesh file places in its scene, by its bytes alone."""
    return _COUNTERS[path.suffix.lower()](path.read_bytes())


def _stl(data: bytes) -> int:
    if data.lstrip()[:5].lower() == b"solid" and b"facet" in data[:2000]:
        return len(re.findall(rb"^\s*endfacet", data, re.M | re.I))
    total = start = 0
    while start + 84 <= len(data):
        (count,) = struct.unpack_from("<I", data, start + 80)
        start += 84 + 50 * count
        total += count if start <= len(data) else 0
        if not count:
            break
    return total


def _obj(data: bytes) -> int:
    lines = data.replace(b"\\\n", b" ").replace(b"\\\r\n", b" ").split(b"\n")
    words = (line.split(b"#")[0].split() for line in lines)
    return sum(max(len(line) - 3, 0) for line in words if line[:1] == [b"f"])


def _dae(data: bytes) -> int:
    root = ElementTree.fromstring(re.sub(rb'\sxmlns="[^"]*"', b"", data))
    nodes = {f"#{node.get('id')}": node for node in root.iter("node")}
    geometries = {f"#{g.get('id')}": _dae_geometry(g) for g in root.iter("geometry")}
    deformers = {
        f"#{c.get('id')}": d.get("source", "") for c in root.iter("controller") for d in c[:1]
    }

    def below(node: ElementTree.Element) -> int:
        total = sum(map(below, node.findall("node")))
        for instance in node.findall("instance_node"):
            total += below(nodes[instance.get("url", "")])
        for instance in (*node.findall("instance_geometry"), *node.findall("instance_controller")):
            url = instance.get("url", "")
            while url in deformers:
                url = deformers[url]
            total += geometries.get(url, 0)
        return total

    shown = {scene.get("url") for scene in root.iter("instance_visual_scene")}
    scenes = (s for s in root.iter("visual_scene") if f"#{s.get('id')}" in shown)
    return sum(below(node) for scene in scenes for node in scene.findall("node"))


def _dae_geometry(geometry: ElementTree.Element) -> int:
    total = 0
    for tag in ("triangles", "polygons", "tristrips", "trifans", "polylist"):
        for primitive in geometry.iter(tag):
            if tag == "polylist":
                corners = (primitive.findtext("vcount") or "").split()
                total += sum(max(int(count) - 2, 0) for count in corners)
                continue
            width = 1 + max(int(i.get("offset", 0)) for i in primitive.findall("input"))
            for indices in primitive.findall("p"):
                corners = (indices.text or "").split()
                count = len(corners) // width
                total += count // 3 if tag == "triangles" else max(count - 2, 0)
    return total


_COUNTERS = {
    ".dae": _dae,
    ".obj": _obj,
    ".stl": _stl,
}


def compare_triangles(files: Iterable[Path]) -> tuple[int, list[list[object]]]:
    """Return the number of mesh files, and a row per kind of difference: kind, files, example."""
    kinds: Counter[str] = Counter()
    examples: dict[str, Path] = {}
    total = 0
    for path in files:
        total += 1
        try:
            counted: int | str = count_triangles(path)
        except Exception as error:  # any fault of a file is an outcome of this count
            counted = f"not counted: {type(error).__name__}"
        try:
            content = read_mesh_file(path)
        except MeshError as error:
            reason = str(error).split("mesh: ")[-1]
            found = [f"{counted} triangles, refused: {re.sub(r'[0-9]+', 'N', reason)}"]
        else:
            read = sum(len(part.faces) for part in content.parts)
            found = [re.sub(r"'[^']*'|\d+", "N", note) for note in content.left_out]
            if counted != read:
                found.append(f"triangles differ{'' if content.left_out else ' without a note'}")
        for kind in dict.fromkeys(found):
            kinds[kind] += 1
            examples.setdefault(kind, path)
    return total, [[kind, n, examples[kind].name] for kind, n in kinds.most_common()]


def mesh_files(root: Path) -> list[Path]:
    """Return the mesh files below a folder."""
    return sorted(
        path for path in root.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file()
    )


def main() -> None:
    """Print the comparison of the files and folders on the command line."""
    paths = [Path(word) for word in sys.argv[1:]]
    files = [file for path in paths for file in (mesh_files(path) if path.is_dir() else [path])]
    start = time.process_time()
    total, rows = compare_triangles(files)
    print(f"{total} mesh files")
    print(tabulate(rows, headers=["left out or different", "files", "example"]))
    if len(files) == 1:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"peak {peak:.0f} MiB, {time.process_time() - start:.1f} s of CPU")


if __name__ == "__main__":
    main()
