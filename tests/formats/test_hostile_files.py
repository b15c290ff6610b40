"""Malicious input files: `check`, `show` and `import` fail with one line and leave no files."""

import os
import struct
from contextlib import closing

import pytest

from helpers.fuzzing import MEMORY_MIB, Runner
from morphgen.cli import main

BOX = '<robot name="r"><link name="a"><collision><geometry>{}</geometry></collision></link></robot>'
MESH = BOX.format('<mesh filename="{}"/>')


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
    "nul in a mesh's name": MESH.format("%00.stl").encode(),
    "long mesh name": MESH.format("m" * 5000 + ".stl").encode(),
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
    path.write_text(MESH.format("count.stl"))
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
    (tmp_path / "x.urdf").write_text(MESH.format("m.stl"))
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
