"""Limits of foreign files: access and size; hostile files; silence of packages."""

import math
import os
import re
import signal
import struct
import subprocess
import sys
from contextlib import closing

import mujoco
import pytest
import trimesh
from PIL import Image
from trimesh.exchange.stl import export_stl

from helpers.commands import run_python
from helpers.fuzzing import MEMORY_MIB, Runner
from helpers.pages import archive
from helpers.robots import arm
from morphgen.api.checks import conform
from morphgen.checks import check
from morphgen.checks.conformance import conformance
from morphgen.checks.readers import loader_copy
from morphgen.cli import main, progress
from morphgen.errors import FormatError, MorphgenError
from morphgen.formats.bundle import (
    MJCF,
    URDF,
    read_description,
    read_robot,
    split_colours,
    write_bundle,
)
from morphgen.model import mesh as mesh_module
from morphgen.model.mesh import load_mesh
from morphgen.model.robot import Robot
from morphgen.viewer.app.uploads import store_upload
from morphgen.viewer.robot_uri import FileAccess, read_robot_uri

URDF_TEXT = """<robot name="r"><link name="a"><visual><geometry><sphere radius="0.1"/></geometry>
</visual>{}</link>{}</robot>"""
MJCF_TEXT = """<mujoco model="r">{}<worldbody><body name="a"><geom size="0.1"/>{}</body></worldbody>
</mujoco>"""
MESH = '<collision><geometry><mesh filename="{}"/></geometry></collision>'
REFERENCES = {
    "absolute path": "{outside}/{file}",
    "parent folder": "../../../outside/{file}",
    "parent folder, escaped": "..%2f..%2f../outside/{file}",
    "file URI": "file://{outside}/{file}",
    "package of another folder": "package://../outside/{file}",
    "package in the file system": "package://outside/{file}",
    "backslashes": "..\\..\\..\\outside\\{file}",
    "network share": "\\\\{outside}\\{file}",
    "link out of the folder": "link-{file}",
    "linked folder": "linked/{file}",
    "pipe": "pipe.{suffix}",
    "device": "/dev/zero",
    "linked device": "zero.{suffix}",
    "folder": "folder.{suffix}",
    "web": "https://localhost:1/{file}",
}
"""Every kind of reference that leaves the folder of a robot, or is no regular file."""
MESH_GEOM = '<geom type="mesh" mesh="m"/>'
URDF_ELEMENTS = {
    "mesh": (MESH.format("{uri}"), ""),
    "mesh with a namespace": (MESH.format("{uri}").replace("<mesh", '<mesh xmlns="x"'), ""),
    "texture": ("", '<material name="m"><texture filename="{uri}"/></material>'),
    "include": ("", '<include file="{uri}"/>'),
    "include in <mujoco>": ("", '<mujoco><include file="{uri}"/></mujoco>'),
    "asset in <mujoco>": ("", '<mujoco><asset><mesh name="m" file="{uri}"/></asset></mujoco>'),
    "signed distance field": (
        "<collision><geometry><sdf filename='{uri}'/></geometry></collision>",
        "",
    ),
}
"""Elements of a URDF that name a file: the text in its link, and that after it."""
MJCF_ELEMENTS = {
    "include": ("", '<include file="{uri}"/>'),
    "include with a namespace": ("", '<include xmlns="x" file="{uri}"/>'),
    "include with a prefix": ("", '<x:include xmlns:x="x" file="{uri}"/>'),
    "include in an include": ("", '<include file="inner.xml"/>'),
    "mesh": ('<asset><mesh name="m" file="{uri}"/></asset>', MESH_GEOM),
    "mesh with a namespace": ('<asset><mesh xmlns="x" name="m" file="{uri}"/></asset>', MESH_GEOM),
    "mesh of a default class": (
        '<default><mesh file="{uri}"/></default><asset><mesh name="m"/></asset>',
        MESH_GEOM,
    ),
    "height field": ('<asset><hfield name="m" file="{uri}" size="1 1 1 1"/></asset>', ""),
    "texture": ('<asset><texture name="m" type="2d" file="{uri}"/></asset>', ""),
    "texture of a cube": ('<asset><texture name="m" type="cube" fileup="{uri}"/></asset>', ""),
    "skin": ('<deformable><skin name="m" file="{uri}"/></deformable>', ""),
    "model": (
        '<asset><model name="m" file="{uri}"/></asset>',
        '<attach model="m" body="b" prefix="p"/>',
    ),
    "flexible body": ("", '<flexcomp name="f" type="mesh" file="{uri}"/>'),
    "mesh attribute of a geom": ("", '<geom size="0.1" file="{uri}"/>'),
}
"""Elements of an MJCF that name a file: the text before its body, and that in it."""
MESH_FILES = {
    "material library": ("obj", "mtllib {uri}\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
    "image": (
        "dae",
        '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset/>'
        '<library_images><image id="i"><init_from>{uri}</init_from></image></library_images>'
        "</COLLADA>",
    ),
}


def upload(path):
    """Store a file, and the regular files beside it, as an upload; read it as a page does."""
    uploads = path.parent.parent / "uploads"
    uploads.mkdir(exist_ok=True)
    access = FileAccess((), (path.parent,), uploads)
    names = [each for each in sorted(path.parent.iterdir()) if each.is_file() and each != path]
    near = {each.name: each.read_bytes() for each in names if not each.is_symlink()}
    stored = store_upload("a.zip", archive({path.name: path.read_bytes(), **near}), access)
    return read_robot_uri(stored, access)


def copy(path):
    """Return the bytes of the copy that loaders get."""
    with loader_copy(path) as folder:
        return {file.name: file.read_bytes() for file in sorted(folder.iterdir())}


READERS = {
    "description": read_description,
    "robot": read_robot,
    "copy for loaders": copy,
    "upload": upload,
}
"""Everything that reads a description."""


@pytest.fixture
def folder(tmp_path):
    """A robot's folder with links, a pipe and a folder; sound files lie beside it."""
    inside, outside = tmp_path / "a" / "robot", tmp_path / "outside"
    inside.mkdir(parents=True)
    outside.mkdir()
    (outside / "secret.xml").write_text('<mujoco><geom name="secret" size="0.3"/></mujoco>')
    trimesh.creation.box((1, 1, 1)).export(outside / "secret.stl")
    (outside / "secret.png").write_bytes(b"secret")
    (inside / "linked").symlink_to(outside)
    for suffix in ("xml", "stl", "png"):
        (inside / f"link-secret.{suffix}").symlink_to(outside / f"secret.{suffix}")
        (inside / f"zero.{suffix}").symlink_to("/dev/zero")
        os.mkfifo(inside / f"pipe.{suffix}")
        (inside / f"folder.{suffix}").mkdir()
    return inside


@pytest.fixture(autouse=True)
def _no_pipe_blocks(monkeypatch):
    """Fail, instead of waiting for ever, if something opens a pipe; print no progress."""
    monkeypatch.setattr(progress, "FIRST_LINE", math.inf)  # on a busy machine all work is long
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.alarm(120)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def reference(kind, suffix, folder):
    outside = folder.parent.parent / "outside"
    return REFERENCES[kind].format(outside=outside, file=f"secret.{suffix}", suffix=suffix)


def block_outside(folder):
    """Replace the files outside of the folder by pipes, which block whoever opens one."""
    for file in (folder.parent.parent / "outside").iterdir():
        file.unlink()
        os.mkfifo(file)


def require_nothing_of_outside(read, path):
    """Require that a reader refuses a file, or returns nothing that lies outside its folder."""
    try:
        result = read(path)
    except MorphgenError:
        return
    text = repr(result)
    for name in ("secret", "outside", "pipe", "zero", "0.3,"):
        assert name not in text.replace(str(path.parent), "")


@pytest.mark.parametrize("kind", REFERENCES)
@pytest.mark.parametrize("reader", READERS)
def test_a_description_reads_nothing_outside_its_folder(reader, kind, folder):
    for is_blocked in (False, True):
        if is_blocked:
            block_outside(folder)
        for element, pieces in URDF_ELEMENTS.items():
            path, text = folder / "robot.urdf", URDF_TEXT.format(*pieces)
            suffix = "png" if element == "texture" else "stl"
            path.write_text(text.replace("{uri}", reference(kind, suffix, folder)))
            require_nothing_of_outside(READERS[reader], path)
        for element, pieces in MJCF_ELEMENTS.items():
            path, text = folder / "robot.xml", MJCF_TEXT.format(*pieces)
            suffix = "xml" if "include" in element or element == "model" else "stl"
            uri = reference(kind, suffix, folder)
            (folder / "inner.xml").write_text(f'<mujoco><include file="{uri}"/></mujoco>')
            path.write_text(text.replace("{uri}", uri))
            require_nothing_of_outside(READERS[reader], path)
            (folder / "inner.xml").unlink()
        for suffix, text in MESH_FILES.values():
            uri = reference(kind, "png", folder)
            (folder / f"mesh.{suffix}").write_text(text.format(uri=uri))
            path = folder / "robot.urdf"
            path.write_text(URDF_TEXT.format(MESH.format(f"mesh.{suffix}"), ""))
            require_nothing_of_outside(lambda path: mesh_of(READERS[reader](path)), path)


def mesh_of(result):
    """Return the triangles of a robot's mesh; the result itself if it is no robot."""
    shapes = result.links[0].collisions if isinstance(result, Robot) else ()
    return [load_mesh(shape.geometry).vertices for shape in shapes] or result


@pytest.mark.parametrize("kind", REFERENCES)
def test_the_folders_of_an_mjcf_compiler_do_not_lead_outside(kind, folder):
    block_outside(folder)
    path, where = folder / "robot.xml", reference(kind, "stl", folder).removesuffix("/secret.stl")
    for attribute in ("meshdir", "assetdir", "texturedir"):
        for file in ("secret.stl", "../outside/secret.stl", "link-secret.stl"):
            asset = f'<asset><mesh name="m" file="{file}"/></asset>'
            compiler = f'<compiler {attribute}="{where}"/>'
            path.write_text(MJCF_TEXT.format(compiler + asset, MESH_GEOM))
            for read in READERS.values():
                with pytest.raises(MorphgenError):
                    read(path)


NAMESPACES = {
    "include": '<include xmlns="x" file="inner.xml"/>',
    "replicate": '<replicate xmlns="x" count="3000000"><body><geom size=".1"/></body></replicate>',
    "prefix": '<x:replicate xmlns:x="x" count="3000000"><geom size=".1"/></x:replicate>',
    "prefix without a declaration": '<x:include file="inner.xml"/>',
    "attribute": '<geom size="1" x:file="a" xmlns:x="x"/>',
    "attribute of XML": '<geom size="1" xml:base="inner.xml"/>',
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("name", NAMESPACES)
def test_an_mjcf_with_namespaces_is_refused(name, reader, folder):
    path = folder / "robot.xml"
    path.write_text(MJCF_TEXT.format("", NAMESPACES[name]))
    with pytest.raises(MorphgenError, match=r"has the namespace .*; names in an MJCF have none"):
        READERS[reader](path)


@pytest.mark.parametrize(
    "encode",
    [
        lambda text: text.encode("utf-16"),
        lambda text: ('<?xml version="1.0" encoding="iso-8859-1"?>' + text).encode("latin-1"),
        lambda text: ("<!-- <a> --><?x y?>" + text).encode(),
        lambda text: text.replace("include ", "<![CDATA[ ]]><include ").encode(),
    ],
)
def test_no_spelling_of_xml_hides_an_include(encode, folder):
    path = folder / "robot.xml"
    for text in (
        '<include file="../outside/secret.xml"/>',
        '<include file="&#46;./outside/secret.xml"/>',
        "<include file='../outside/secret.xml'></include>",
    ):
        path.write_bytes(encode(MJCF_TEXT.format("", text)))
        for read in READERS.values():
            with pytest.raises(MorphgenError):
                read(path)


@pytest.mark.parametrize(
    "text",
    [
        '<mujoco><include file="../outside/secret.xml"/></mujoco>',
        '<mujoco><include xmlns="x" file="../outside/secret.xml"/></mujoco>',
        '<mujoco><include file="pipe.xml"/></mujoco>',
        "pipe.xml",
        "link-secret.xml",
    ],
)
def test_loaders_get_nothing_of_a_bundle_unchecked(text, folder):
    bundle = write_bundle(arm(), folder.parent / "bundle", picture=False)
    (bundle / MJCF).unlink()
    if text.startswith("<"):
        (folder / "pipe.xml").rename(bundle / "pipe.xml")
        (bundle / MJCF).write_text(text)
    else:
        (folder / text).rename(bundle / MJCF)
    for compare in (conform, conformance):
        with pytest.raises(FormatError):
            compare(bundle, samples=1)


def many_meshes(folder, suffix, meshes):
    """Write a robot of meshes, each the bytes of its file, or the size of a sparse one."""
    for i, mesh in enumerate(meshes):
        with (folder / f"{i}.stl").open("wb") as file:
            file.truncate(mesh) if isinstance(mesh, int) else file.write(mesh)
    if suffix == "xml":
        assets = "".join(f'<mesh name="m{i}" file="{i}.stl"/>' for i in range(len(meshes)))
        geoms = "".join(f'<geom type="mesh" mesh="m{i}"/>' for i in range(len(meshes)))
        text = MJCF_TEXT.format(f"<asset>{assets}</asset>", geoms)
    else:
        text = URDF_TEXT.format("".join(MESH.format(f"{i}.stl") for i in range(len(meshes))), "")
    (folder / f"many.{suffix}").write_text(text)
    return folder / f"many.{suffix}"


@pytest.mark.parametrize("sizes", [[60 * 2**20] * 2, [10 * 2**20] * 10, [2**20] * 97])
@pytest.mark.parametrize("suffix", ["urdf", "xml"])
@pytest.mark.parametrize("reader", ["description", "robot", "copy for loaders"])
def test_the_mesh_files_of_a_robot_are_bounded_in_all(sizes, suffix, reader, folder):
    path = many_meshes(folder, suffix, sizes)
    with pytest.raises(MorphgenError, match=f"meshes have {sum(sizes)} bytes"):
        READERS[reader](path)
    assert read_description(many_meshes(folder, "urdf", [2**20] * 96))  # none of them is opened


@pytest.mark.parametrize("counts", [(1, 1), (2, 0), (0, 0, 0, 0, 0, 2)])
@pytest.mark.parametrize("use", [check, split_colours, copy])
def test_the_triangles_of_a_robot_are_bounded_in_all(counts, use, folder, monkeypatch):
    meshes = [export_stl(trimesh.creation.icosphere(n, radius=0.1)) for n in counts]
    faces = sum(20 * 4**n for n in counts)
    path = many_meshes(folder, "urdf", meshes)
    robot = read_description(path)
    argument = path if use is copy else robot
    monkeypatch.setattr(mesh_module, "MAX_ROBOT_FACES", faces)
    use(argument)
    monkeypatch.setattr(mesh_module, "MAX_ROBOT_FACES", faces - 1)
    with pytest.raises(MorphgenError, match=f"meshes have {faces} triangles or more"):
        use(argument)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_the_textures_of_a_robot_are_bounded_in_all(count, folder, monkeypatch):
    Image.new("RGB", (8, 4)).save(folder / "t.png")
    (folder / "m.mtl").write_text("newmtl a\nmap_Kd t.png\n")
    triangle = "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 1\nvt 0 0\nusemtl a\nf 1/1 2/1 3/1\n"
    for i in range(count):
        (folder / f"{i}.obj").write_text(triangle)
    text = "".join(MESH.format(f"{i}.obj") for i in range(count))
    (folder / "robot.urdf").write_text(URDF_TEXT.format(text, ""))
    robot = read_description(folder / "robot.urdf")
    monkeypatch.setattr(mesh_module, "MAX_ROBOT_PIXELS", 32 * count)
    split_colours(robot)
    monkeypatch.setattr(mesh_module, "MAX_ROBOT_PIXELS", 32 * count - 1)
    with pytest.raises(MorphgenError, match=f"meshes have {32 * count} pixels"):
        split_colours(robot)


def test_loaders_get_the_robot_with_its_meshes(folder):
    trimesh.creation.box((1, 1, 1)).export(folder / "box.stl")
    (folder / "inner.xml").write_text(
        '<mujoco><asset><mesh name="m" file="box.stl" scale="2 2 2"/></asset></mujoco>'
    )
    path = folder / "robot.xml"
    path.write_text(
        MJCF_TEXT.format(
            '<option timestep="0.001"/><size memory="900G"/><include file="inner.xml"/>',
            '<geom name="box" type="mesh" mesh="m" density="1"/><site name="s"/>',
        )
    )
    with loader_copy(path) as copied:
        model = mujoco.MjModel.from_xml_path(str(copied / MJCF))
        assert model.opt.timestep == 0.001
        assert model.geom("box").size == pytest.approx([1, 1, 1])
        assert sorted(each.suffix for each in copied.iterdir()) == [".stl", ".xml"]
    assert not copied.exists()
    path = folder / "robot.urdf"
    path.write_text(
        URDF_TEXT.format(
            MESH.format("box.stl"),
            '<mujoco><compiler meshdir="/etc" fusestatic="false"/><size memory="900G"/></mujoco>'
            '<gazebo><plugin filename="x.so"/></gazebo>',
        )
    )
    with loader_copy(path) as copied:
        assert "gazebo" not in (copied / URDF).read_text()
        assert "/etc" not in (copied / URDF).read_text()
        model = mujoco.MjModel.from_xml_path(str(copied / URDF))
        assert model.nmesh == 1


LIMITED = """
import resource, sys
from pathlib import Path
from morphgen.errors import MorphgenError
from morphgen.formats.mjcf.read import read_mjcf
resource.setrlimit(resource.RLIMIT_CPU, (120, 120))
for file in sys.argv[1:]:
    before = resource.getrusage(resource.RUSAGE_SELF)
    try:
        read_mjcf(Path(file))
    except MorphgenError as error:
        assert "\\n" not in str(error)
    seconds = resource.getrusage(resource.RUSAGE_SELF).ru_utime - before.ru_utime
    status = Path("/proc/self/status").read_text().splitlines()
    (memory,) = [int(line.split()[1]) for line in status if line.startswith("VmHWM")]
    if seconds > 10 or memory > 2**20:
        print(Path(file).name, seconds, memory)
"""
"""Reads files and prints those that took more than 10 s of CPU or 1 GiB of memory.

``ru_maxrss`` would count the memory of the process that started this one, too.
"""
JOINTS = '<joint name="j" range="-1 1"/>'
HUGE = {
    "pairs": (20_000, "contact", '<exclude body1="world" body2="a"/>'),
    "couplings": (20_000, "equality", '<joint joint1="j"/>'),
    "tendons": (20_000, "tendon", '<fixed><joint joint="j" coef="1"/></fixed>'),
    "motors": (20_000, "actuator", '<motor joint="j"/>'),
    "classes": (20_000, "default", '<default class="c#"/>'),
    "meshes": (20_000, "asset", '<mesh name="m#" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/>'),
    "materials": (20_000, "asset", '<material name="m#"/>'),
    "keyframes": (20_000, "keyframe", "<key/>"),
    "copies": (1, "worldbody", '<replicate count="9999"><geom size="1"/></replicate>'),
    "cameras": (19_000, "worldbody", "<camera/>"),
    "sites": (19_000, "worldbody", "<site/>"),
    "bodies": (19_000, "worldbody", '<body><geom size="1"/></body>'),
    "any": (1_000_000, "worldbody", "<frame/>"),
    "height field": (1, "asset", '<hfield name="h" nrow="99999" ncol="99999" size="1 1 1 1"/>'),
    "texture": (1, "asset", '<texture type="2d" builtin="flat" width="99999" height="99999"/>'),
    "built-in mesh": (1, "asset", '<mesh name="m" builtin="supersphere" params="9999 1 1"/>'),
    "hull": (1, "asset", '<mesh name="m" maxhullvert="9999999" vertex="0 0 0 1 0 0 0 1 0 0 1 1"/>'),
    "memory": (1, "", '<size memory="900G"/>'),
    "user values": (1, "", '<size nuser_geom="99999999" nuserdata="999999999"/>'),
    "numbers": (1, "custom", '<numeric name="n" size="999999999"/>'),
    "sensor": (1, "sensor", '<user dim="999999999"/>'),
    "grid of points": (1, "worldbody", '<flexcomp name="f" type="grid" count="999 999 999"/>'),
    "grid of bodies": (1, "worldbody", '<composite type="grid" count="999 999 999"/>'),
    "activations": (1, "actuator", '<general joint="j" dyntype="user" actdim="999999999"/>'),
    "delays": (1, "actuator", '<motor joint="j" nsample="999999999" delay="1"/>'),
}
"""Count, section and element of documents that ask for more than a robot needs."""


def require_bounds(files):
    """Require that the reader bounds its time and memory for every file."""
    command = [sys.executable, "-W", "ignore", "-c", LIMITED, *files]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr[-2000:]) == (0, "", "")


@pytest.mark.slow
def test_no_mjcf_takes_more_memory_or_time_than_a_stranger_may(tmp_path):
    files = []
    for name, (count, section, element) in HUGE.items():
        content = "".join(element.replace("#", str(i)) for i in range(min(count, 200_000)))
        files.append(tmp_path / f"{name}.xml")
        files[-1].write_text(
            MJCF_TEXT.format(f"<{section}>{content}</{section}>" if section else content, JOINTS)
        )
    require_bounds(files)


@pytest.mark.slow
def test_no_number_of_mujocos_schema_takes_the_memory_of_the_machine(tmp_path):
    """Every attribute of every element of MuJoCo's own schema, with a huge number."""
    schema = mujoco.mj_printSchema(True, False).replace("&nbsp;", " ")
    rows = re.findall(r'class="el">(.*?)</td>.*?class="at">(.*?)</td>', schema, re.DOTALL)
    stack, files = [], []
    for name, attributes in rows:
        depth = (len(name) - len(name.lstrip())) // 4
        stack = [*stack[:depth], name.strip()]
        section = "worldbody" if stack[1:2] == ["(world)body"] else "".join(stack[1:2])
        known = re.sub("<.*?>", "", attributes).split() if len(stack) > 1 else ()
        for attribute in known:
            named = {key: key[0] for key in ("joint", "name") if key in known}
            values = {**named, attribute: "999999999"}
            text = " ".join(f'{key}="{value}"' for key, value in values.items())
            element = f"<{stack[-1]} {text}/>"
            inside = f"<{section}>{element}</{section}>" if len(stack) > 2 else element
            files.append(tmp_path / f"{len(files)}.xml")
            files[-1].write_text(MJCF_TEXT.format(inside, JOINTS))
    assert len(files) > 500
    require_bounds(files)


BOX = '<robot name="r"><link name="a"><collision><geometry>{}</geometry></collision></link></robot>'
MESH_URDF = BOX.format('<mesh filename="{}"/>')


def chain(links):
    """Return a URDF of a chain of links."""
    names = "".join(f'<link name="l{i}"/>' for i in range(links))
    joints = "".join(
        f'<joint name="j{i}" type="fixed"><parent link="l{i}"/><child link="l{i + 1}"/></joint>'
        for i in range(links - 1)
    )
    return f'<robot name="r">{names}{joints}</robot>'


def entities(depth):
    """Return entities that expand twentyfold at each of ``depth`` levels."""
    lines = [f'<!ENTITY e{n} "{f"&e{n - 1};" * 20 if n else "lol"}">' for n in range(depth)]
    return f"<!DOCTYPE r [{''.join(lines)}]>"


SOUND = '<robot name="r"><link name="a"/></robot>'
URDFS = {
    "nul": b"<robot name='r'>\0</robot>",
    "truncated after a prefix": b'<robot name="r"><drake:x><link name="a',
    "utf-16 without a mark": SOUND.encode("utf-16-le"),
    "utf-16 with the wrong mark": b"\xff\xfe" + SOUND.encode("utf-16-be"),
    "binary": bytes(range(256)) * 100,
    "entity bomb": (entities(10) + '<robot name="&e9;"/>').encode(),
    "deep": b"<robot>" * 100_000,
    "many prefixes": b"<r>" + b"".join(b"<p%d:x/>" % i for i in range(5000)) + b"</r>",
    "many attributes": b"<robot " + b" ".join(b'a%d="1"' % i for i in range(200_000)) + b">",
    "huge": b'<robot name="r">' + b" " * 9_000_000 + b"</robot>",
    "name that moves the cursor": b'<robot name="r&#x9b;2J"><link name="a"/></robot>',
    "chain without end": chain(10_000).encode(),
    "shapes without end": (
        '<robot name="r"><link name="a">' + "<collision/>" * 20_000 + "</link></robot>"
    ).encode(),
    "unknown links": chain(900).replace('child link="', 'child link="x').encode(),
    "many digits": BOX.format(f'<sphere radius="{"9" * 100_000}"/>').encode(),
    "nul in a mesh's name": MESH_URDF.format("%00.stl").encode(),
    "long mesh name": MESH_URDF.format("m" * 5000 + ".stl").encode(),
}


def refused(path, capsys, tmp_path, codes=(2,)):
    """Assert that the three commands fail with one line each; return the line of ``check``."""
    out = tmp_path / "out"
    for words in (["show", path], ["import", path, "--out", out, "--no-picture"], ["check", path]):
        code = main([str(word) for word in words])
        printed, errors = capsys.readouterr()
        if words[0] == "check":
            assert code in (1, 2)
        else:
            assert code in codes, printed
            assert len(errors.splitlines()) == 1
            assert errors.startswith("morphgen: ")
            assert len(errors) < 2000
        text = printed + errors
        assert all(c.isprintable() or c == "\n" for c in text)
        assert "Traceback" not in text
        assert "root:" not in text
        assert not list(out.rglob("*")) if out.exists() else True
    return text


@pytest.mark.parametrize("name", URDFS)
def test_a_hostile_urdf_is_a_one_line_error(name, tmp_path, capsys):
    path = tmp_path / "x.urdf"
    path.write_bytes(URDFS[name])
    refused(path, capsys, tmp_path)


def test_an_unreadable_mesh_is_a_one_line_error(tmp_path, capsys):
    path = tmp_path / "x.urdf"
    path.write_text(MESH_URDF.format("count.stl"))
    (tmp_path / "count.stl").write_bytes(b"x" * 80 + struct.pack("<I", 2**32 - 1) + bytes(500))
    assert main(["import", str(path), "--out", str(tmp_path / "out"), "--no-picture"]) == 2
    errors = capsys.readouterr().err
    assert len(errors.splitlines()) == 1
    assert "count.stl" in errors
    assert main(["check", str(path)]) == 1
    assert "mesh-unreadable" in capsys.readouterr().out
    assert not (tmp_path / "out" / "r").exists()


def test_files_that_are_not_regular_are_not_opened(tmp_path, capsys):
    os.mkfifo(tmp_path / "pipe.urdf")
    (tmp_path / "zero.urdf").symlink_to("/dev/zero")
    (tmp_path / "folder.urdf").mkdir()
    (tmp_path / "loop.urdf").symlink_to(tmp_path / "loop.urdf")
    for path in sorted(tmp_path.glob("*.urdf")):
        refused(path, capsys, tmp_path)
    os.mkfifo(tmp_path / "m.stl")
    (tmp_path / "x.urdf").write_text(MESH_URDF.format("m.stl"))
    assert "does not exist" in refused(tmp_path / "x.urdf", capsys, tmp_path)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root reads all")
def test_an_unreadable_file_is_an_error(tmp_path, capsys):
    path = tmp_path / "x.urdf"
    path.write_text(SOUND)
    path.chmod(0)
    refused(path, capsys, tmp_path)


CARDS = {
    "brackets": "[" * 100_000,
    "levels": '{"format": ' + "[" * 500 + "]" * 500 + "}",
    "digits": '{"format": ' + "9" * 5000 + "}",
    "not text": b"\xff\xfe\x00",
    "frame with a line break": '{"format": 1, "frames": {"a\\n\\u009b2J": {}}}',
    "infinite": '{"format": Infinity}',
}


@pytest.mark.parametrize("name", CARDS)
def test_a_hostile_card_is_a_one_line_error(name, tmp_path, capsys):
    (tmp_path / "robot.urdf").write_text(SOUND)
    content = CARDS[name]
    (tmp_path / "card.json").write_bytes(
        content if isinstance(content, bytes) else content.encode()
    )
    for command in ("show", "check"):
        assert main([command, str(tmp_path)]) == 2
        errors = capsys.readouterr().err
        assert len(errors.splitlines()) == 1
        assert "card.json" in errors or "has no link" in errors
        assert all(c.isprintable() or c == "\n" for c in errors)


def test_a_card_that_is_a_pipe_is_not_opened(tmp_path, capsys):
    (tmp_path / "robot.urdf").write_text(SOUND)
    os.mkfifo(tmp_path / "card.json")
    assert main(["show", str(tmp_path)]) == 2
    assert "holds no robot" in capsys.readouterr().err


@pytest.mark.slow
def test_hostile_urdfs_use_bounded_memory_and_time(tmp_path):
    path = tmp_path / "x.urdf"
    with closing(Runner(tmp_path)) as runner:
        for name in ("many attributes", "shapes without end", "entity bomb"):
            path.write_bytes(URDFS[name])
            answer = runner.run("show", path)
            assert answer["code"] == 2, answer
            assert answer["mib"] < MEMORY_MIB, name


PRINTING = """
import ctypes
from morphgen.formats.quiet import quiet
libc = ctypes.CDLL(None)
with quiet():
    libc.printf(b"from C\\n")
    print("from Python", flush=True)
libc.printf(b"after\\n")
libc.fflush(None)
"""


@pytest.mark.skipif(os.name != "posix", reason="C's buffers are reached by POSIX's names")
def test_buffered_c_output_is_not_printed_at_exit():
    result = run_python(PRINTING)
    assert (result.stdout, result.stderr) == ("after\n", "")


CODE = """
import logging, sys
import morphgen.formats.mjcf.write
import mujoco

logging.basicConfig(stream=sys.stdout, format="%(name)s %(levelname)s %(message)s")
xml = "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
model = mujoco.MjModel.from_xml_string(xml)
data = mujoco.MjData(model)
data.qvel[0] = float("nan")
mujoco.mj_step(model, data)
"""


MINE = "import mujoco; mujoco.set_mju_user_warning(lambda text: print('mine', text))\n"


@pytest.mark.parametrize(("before", "name"), [("", "morphgen.mujoco WARNING"), (MINE, "mine")])
def test_a_warning_is_logged_or_goes_to_the_users_callback_and_to_no_file(before, name, tmp_path):
    result = run_python(before + CODE, cwd=tmp_path)
    assert result.stdout.startswith(f"{name} Nan, Inf or huge value in QVEL")
    assert list(tmp_path.iterdir()) == []
