from __future__ import annotations

from pathlib import Path

import pytest

from morphgen.errors import FormatError
from morphgen.formats.xml import parse_xml


def failure(data: bytes) -> str:
    with pytest.raises(FormatError) as caught:
        parse_xml(data, "robot.urdf")
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_a_document_gives_its_root_with_attributes_in_order() -> None:
    root = parse_xml(b'<robot name="a" version="1"><link name="l"/></robot>', "robot.urdf")
    assert root.tag == "robot"
    assert list(root.attrib) == ["name", "version"]
    assert [child.tag for child in root] == ["link"]


def test_comments_and_processing_instructions_are_gone() -> None:
    root = parse_xml(b"<?p q?><robot><!-- a --><link/><?x y?>te<!-- b -->xt</robot>", "robot.urdf")
    assert [child.tag for child in root] == ["link"]
    assert root[0].tail == "text"


def test_broken_xml_is_reported_with_line_and_column() -> None:
    message = failure(b"<robot>\n  <link>\n</robot>")
    assert message.startswith("robot.urdf:3:")
    assert "link" in message
    assert "column" not in message


@pytest.mark.parametrize("data", [b"", b"   ", b"not xml", b"\x00\x01", b"<robot/><robot/>"])
def test_what_is_not_one_xml_document_is_refused(data: bytes) -> None:
    assert failure(data).startswith("robot.urdf:1:")


def test_an_undeclared_prefix_is_refused() -> None:
    assert "xacro" in failure(b"<robot><xacro:property/></robot>")


@pytest.mark.parametrize(
    "doctype",
    [
        b"<!DOCTYPE robot>",
        b'<!DOCTYPE robot SYSTEM "other.dtd">',
        b'<!DOCTYPE robot [<!ENTITY secret SYSTEM "file:///etc/hostname">]>',
    ],
)
def test_a_doctype_is_refused(doctype: bytes) -> None:
    assert "DOCTYPE" in failure(doctype + b"<robot/>")


def test_an_external_entity_is_not_read(tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text("treasure")
    data = f'<!DOCTYPE r [<!ENTITY x SYSTEM "{secret.as_uri()}">]><r>&x;</r>'
    assert "treasure" not in failure(data.encode())


@pytest.mark.parametrize("use", [b"<r>&i9;</r>", b'<r a="&i9;"/>'])
def test_an_entity_bomb_is_refused_at_once(use: bytes) -> None:
    entities = b"".join(
        b'<!ENTITY i%d "%s">' % (n, b"&i%d;" % (n - 1) * 20 if n else b"lol") for n in range(10)
    )
    failure(b"<!DOCTYPE r [" + entities + b"]>" + use)


def test_the_documents_own_encoding_is_respected() -> None:
    data = '<?xml version="1.0" encoding="ISO-8859-1"?><robot name="é"/>'.encode("latin-1")
    assert parse_xml(data, "robot.urdf").get("name") == "é"
    assert parse_xml('<robot name="é"/>'.encode("utf-16"), "robot.urdf").get("name") == "é"
