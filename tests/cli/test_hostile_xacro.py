"""Untrusted xacro files run no code, read no other folders, and stay within limits."""

import json
import os
import subprocess
import sys
from xml.sax.saxutils import quoteattr

import pytest
import yaml

from morphgen.formats.xacro import expand as xacro_process

HEAD = '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">\n'
SECRET = "root:hunter2"
CALL = (  # runs a command with a deny-list of names that begin with __
    "python.vars(python.type(python.vars(python.type(xacro.load_yaml))['__globals__']))['__get__']"
    "(python.vars(python.type(xacro.load_yaml))['__globals__'], xacro.load_yaml)"
    "['sys'].modules['os'].system('touch pwned')"
)


@pytest.fixture
def hostile(tmp_path):
    """Write a document to its own folder, with a secret file next to that folder."""
    folder = tmp_path / "home" / "downloads"
    folder.mkdir(parents=True)
    (tmp_path / "home" / "secret.yaml").write_text(f"key: {SECRET}\n")
    (tmp_path / "home" / "secret.xml").write_text(f"<robot><link name='{SECRET}'/></robot>")

    def write(body):
        path = folder / "robot.urdf.xacro"
        path.write_text(f"{HEAD}{body}</robot>")
        return path

    return write


@pytest.fixture
def refused_at(refused, hostile, xacro_here):
    """Assert that every command that reads the document rejects it; return the message."""

    def refuse(body, line=2):
        path = hostile(body)
        message = refused("import", path, "--out", "robots", "--no-picture")
        assert f"{path}:{line}: " in message
        assert SECRET not in message
        return message

    return refuse


def link(expression):
    return f"<link name={quoteattr('${' + expression + '}')}/>"


def test_known_command_execution_exploit_is_rejected(refused, hostile):
    path = hostile(link(CALL))
    for command in ("show", "check", "fit", "tokens", "import"):
        message = refused(command, path)
        assert f"{path}:2: name 'vars' is not defined when evaluating expression" in message


@pytest.mark.parametrize(
    "body",
    [
        f'<link name="$(eval {"lambda: 0"})"/>',
        '<xacro:if value="${lambda: 0}"/>',
        '<xacro:property name="${lambda: 0}" value="1"/>',
        '<xacro:macro name="m" params="a:=${lambda: 0}"/><xacro:m/>',
        '<xacro:macro name="m"/><xacro:call macro="${lambda: 0}"/>',
        '<xacro:include filename="${lambda: 0}"/>',
        '<xacro:include filename="a" ns="${lambda: 0}"/>',
        '<xacro:element xacro:name="${lambda: 0}"/>',
        '<xacro:attribute name="a" value="${lambda: 0}"/>',
        '<xacro:arg name="a" default="${lambda: 0}"/>',
        "<!-- xacro:eval-comments -->${lambda: 0}",
        '<xacro:property name="a" value="lambda: 0"/><link name="${${a}}"/>',
        '<xacro:arg name="a" default="lambda: 0"/><link name="${$(arg a)}"/>',
    ],
)
@pytest.mark.usefixtures("xacro_here")
def test_allow_list_applies_wherever_expressions_occur(refused, hostile, body):
    message = refused("show", hostile(body))
    assert "Lambda 'lambda: 0' is not allowed" in message or "invalid expression" in message


@pytest.mark.parametrize(
    "name", ["../secret.yaml", "{home}/secret.yaml", "link.yaml", "up/secret.yaml"]
)
def test_yaml_is_read_only_from_the_file_folder(refused_at, hostile, tmp_path, name):
    folder = hostile("").parent
    (folder / "link.yaml").symlink_to(tmp_path / "home" / "secret.yaml")
    (folder / "up").symlink_to(tmp_path / "home")
    name = name.format(home=tmp_path / "home")
    for call in ("load_yaml", "xacro.load_yaml"):
        message = refused_at(link(f"{call}('{name}')"))
        assert f"is not in {folder}, the folder of the description" in message
        assert "--root DIR" in message


OUTSIDE = ("../secret.xml", "{home}/secret.xml", "link.xml", "../*.xml", "{home}/*")


@pytest.mark.parametrize("name", [*OUTSIDE, "$(find home)/secret.xml"])
def test_includes_are_read_only_from_the_file_folder(refused_at, hostile, tmp_path, name):
    (hostile("").parent / "link.xml").symlink_to(tmp_path / "home" / "secret.xml")
    name = name.format(home=tmp_path / "home")
    for more in ("", ' optional="true"'):
        message = refused_at(f'<xacro:include filename="{name}"{more}/>')
        assert "the folder of the description" in message


def test_root_option_allows_files_of_another_folder(run, ok, hostile, tmp_path):
    home = tmp_path / "home"
    (home / "ok.xml").write_text('<robot><link name="included"/></robot>')
    (home / "ok.yaml").write_text("name: loaded\n")
    path = hostile(
        '<xacro:include filename="../ok.xml"/>'
        "<link name=\"${xacro.load_yaml('../ok.yaml').name}\"/>"
        '<joint name="j" type="fixed"><parent link="included"/><child link="loaded"/></joint>'
    )
    assert run("show", path)[0] == 2
    out = ok("show", path, "--root", home)
    assert "loaded" in out
    assert run("show", path, "--root", home / "nowhere")[0] == 2


def test_meshes_in_a_root_folder_are_found(run, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    (tmp_path / "data" / "meshes").mkdir(parents=True)
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "data" / "meshes" / "a.stl")
    path = tmp_path / "data" / "robots" / "x" / "x.urdf"
    path.parent.mkdir(parents=True)
    shape = '<geometry><mesh filename="../../meshes/a.stl"/></geometry>'
    path.write_text(f'<robot name="x"><link name="a"><visual>{shape}</visual></link></robot>')
    code, out, _ = run("check", path)
    assert code == 1
    assert "--root DIR" in out
    assert "mesh-unresolved" not in run("check", path, "--root", tmp_path / "data")[1]
    words = ("import", path, "--no-picture", "--out", "robots")
    assert run(*words, "--root", "data")[0] == 0
    assert (tmp_path / "robots" / "x" / "meshes").is_dir()


def test_device_files_and_pipes_are_not_read(refused_at, hostile):
    folder = hostile("").parent
    os.mkfifo(folder / "pipe")
    for body in ('<xacro:include filename="pipe"/>', link("xacro.load_yaml('pipe')")):
        assert "is not a regular file" in refused_at(body)
    (folder / "zero").symlink_to("/dev/zero")
    for name in ("/dev/zero", "zero"):
        assert "the folder of the description" in refused_at(f'<xacro:include filename="{name}"/>')


MERGES_ONCE = tuple(map(int, yaml.__version__.split(".")[:3])) >= (6, 0, 4)


def aliases(depth):
    lines = [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, depth)]
    return "\n".join(["a0: &a0 [x]", *lines])


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (aliases(12), "a value has more than 200000 characters and entries"),
        ("a: &a [*a]", "a value has more than 200000 characters and entries"),
        pytest.param(
            "a0: &a0 {k: 1}\n"
            + "".join(
                f"a{i}: &a{i} {{<<: [{','.join([f'*a{i - 1}'] * 9)}]}}\n" for i in range(1, 9)
            ),
            "a mapping has more than 200000 entries",
            marks=pytest.mark.skipif(
                MERGES_ONCE, reason="this PyYAML merges a repeated mapping only once"
            ),
        ),
        ("[" * 1500, "invalid YAML"),
        ("a: !!set {b, c}", "invalid YAML"),
        ("a: !degrees (lambda:0)()", "Lambda 'lambda:0' is not allowed"),
        ("a: !!python/object/apply:os.system ['touch pwned']", "bomb.yaml:1:4: invalid YAML"),
    ],
)
def test_yaml_runs_no_code_and_its_aliases_are_limited(refused_at, hostile, content, reason):
    (hostile("").parent / "bomb.yaml").write_text(content)
    assert reason in refused_at(link("xacro.load_yaml('bomb.yaml')"))


MACROS = "".join(
    f'<xacro:macro name="m{i}">{f"<xacro:m{i + 1}/>" * 10}</xacro:macro>' for i in range(8)
)
PROPERTIES = "".join(
    f'<xacro:property name="p{i + 1}" value="{f"${{p{i}}}" * 10}"/>' for i in range(12)
)


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        (
            f'{MACROS}<xacro:macro name="m8"><link name="a"/></xacro:macro><xacro:m0/>',
            "the expansion processes more than 50000 elements",
        ),
        (
            f'<xacro:property name="p0" value="aaaaaaaaaa"/>{PROPERTIES}{link("p12")}',
            "the expansion creates more than 20000000 characters",
        ),
        ("<a>" * 5000 + "</a>" * 5000, "Excessive depth"),
    ],
)
def test_expanded_document_size_is_limited(refused, hostile, body, reason):
    assert reason in refused("show", hostile(body))


ENDLESS = f"<xacro:macro name='m' params=\"a:={'a' * 60}'\"/>"
"""The package's regular expression for parameters takes 2^60 steps for it."""


@pytest.mark.parametrize("limit", ["CPU_LIMIT", "WALL_LIMIT"])
def test_expansion_is_stopped_at_the_time_limit(refused, hostile, monkeypatch, limit):
    monkeypatch.setattr(xacro_process, limit, 1)
    path = hostile(ENDLESS)
    what = {"CPU_LIMIT": "1 s of CPU time", "WALL_LIMIT": "1 s"}[limit]
    assert f"{path}: its expansion takes more than {what}\n" in refused("show", path)


@pytest.mark.slow
def test_expansion_is_stopped_at_the_memory_limit(refused, hostile, monkeypatch):
    monkeypatch.setattr(xacro_process, "MEMORY_LIMIT", 150 << 20)
    path = hostile("<a/>" * 500_000)
    assert "needs more than 150 MiB of memory" in refused("show", path)


def test_limits_apply_to_user_library_parts(refused, tmp_path, monkeypatch):
    monkeypatch.setattr(xacro_process, "CPU_LIMIT", 1)
    library = tmp_path / "library"
    library.mkdir()
    (library / "trap.yaml").write_text(
        "name: trap\nkind: ee\nsummary: a trap\nlicence: MIT\nfile: trap.xacro\n"
        "root: a\ntool: {link: a}\n"
        "parameters:\n  size: {default: 1, min: 0, max: 2}\n"
    )
    argument = '<xacro:arg name="size" default="1"/>'
    for body, reason in (
        (link(CALL), "name 'vars' is not defined"),
        (link("load_yaml('/etc/passwd')"), "is not in"),
        (ENDLESS, "its expansion takes more than 1 s of CPU time"),
    ):
        (library / "trap.xacro").write_text(f"{HEAD}{argument}{body}</robot>")
        assert reason in refused("compose", "arm=ur5", "ee=trap", "--library", library)


def test_child_process_writes_no_files(tmp_path):
    code = "from morphgen.formats.xacro.expand import limit_process; limit_process(9, 2**30); "
    write = "file = open('written', 'w'); file.write('a'); file.close()"
    done = subprocess.run(
        [sys.executable, "-c", code + write], capture_output=True, text=True, check=False
    )
    assert "File too large" in done.stderr
    assert (tmp_path / "written").read_bytes() == b""


def test_child_process_imports_no_heavy_packages():
    code = (
        "import morphgen.formats.xacro.expand, morphgen.formats.xacro.compile, sys, json;"
        "print(json.dumps(list(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"numpy", "torch", "mujoco", "trimesh", "pybullet"} & set(json.loads(done.stdout))
