"""Parsing XML safely: no external entities, no expansion bombs, errors with positions."""

import pytest

from morphgen.errors import FormatError
from morphgen.formats.xml import parse_description, parse_xml


def failure(data):
    with pytest.raises(FormatError) as caught:
        parse_xml(data, "robot.urdf")
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_comments_and_processing_instructions_are_removed():
    root = parse_xml(b"<?p q?><robot><!-- a --><link/><?x y?>te<!-- b -->xt</robot>", "robot.urdf")
    assert [child.tag for child in root] == ["link"]
    assert root[0].tail == "text"


def test_broken_xml_is_reported_with_line_and_column():
    message = failure(b"<robot>\n  <link>\n</robot>")
    assert message.startswith("robot.urdf:3:")
    assert "link" in message
    assert "column" not in message


@pytest.mark.parametrize("data", [b"", b"   ", b"not xml", b"\x00\x01", b"<robot/><robot/>"])
def test_text_that_is_not_one_xml_document_is_an_error(data):
    assert failure(data).startswith("robot.urdf:1:")


BOMB = "".join(f'<!ENTITY i{n} "{f"&i{n - 1};" * 20 if n else "lol"}">' for n in range(10))


@pytest.mark.parametrize(
    "text",
    [
        "<!DOCTYPE r><r/>",
        '<!DOCTYPE r SYSTEM "other.dtd"><r/>',
        '<!DOCTYPE r [<!ENTITY x SYSTEM "file://SECRET">]><r>&x;</r>',
        f"<!DOCTYPE r [{BOMB}]><r>&i9;</r>",
        f'<!DOCTYPE r [{BOMB}]><r a="&i9;"/>',
    ],
)
def test_a_doctype_is_an_error_and_entities_are_not_read(text, tmp_path):
    (tmp_path / "secret").write_text("treasure")
    message = failure(text.replace("SECRET", str(tmp_path / "secret")).encode())
    assert "treasure" not in message
    assert "DOCTYPE" in message or "&i9;" not in text or "entity" in message.lower()


def test_the_declared_encoding_is_respected():
    data = '<?xml version="1.0" encoding="ISO-8859-1"?><robot name="é"/>'.encode("latin-1")
    assert parse_xml(data, "robot.urdf").get("name") == "é"
    assert parse_xml('<robot name="é"/>'.encode("utf-16"), "robot.urdf").get("name") == "é"


@pytest.mark.parametrize(
    ("start", "codes"),
    [
        (b'<?xml version="0.0"?>', ["xml-declaration"]),
        (b'\n\r\n <?xml version="1.0"?>', ["xml-declaration"]),
        (b'\xef\xbb\xbf\n<?xml version="0.0" encoding="utf-8" ?>', ["xml-declaration"]),
        (b'\xef\xbb\xbf<?xml version="1.0"?>', []),
        (b'<?xml version="1.1"?>', []),
        (b"\n", []),
    ],
)
def test_invalid_xml_declarations_are_repaired_with_a_warning(start, codes):
    root, findings = parse_description(start + b'<robot name="\xc3\xa9"><l/></robot>', "r.urdf")
    assert root.get("name") == "é"
    assert [finding.code for finding in findings] == codes
    assert all(finding.severity == "warning" and finding.repair for finding in findings)
    assert root[0].sourceline == start.count(b"\n") + 1


def test_undeclared_prefixes_are_repaired():
    uses = b'<drake:a/><l gazebo:b="1" name="x"/>' * 200
    text = b"<!-- <no:t> > --><?p ?><robot>" + uses + b"<last:c/></robot>"
    root, findings = parse_description(text, "r.urdf")
    assert root.findall("l")[199].get("name") == "x"
    assert [finding.code for finding in findings] == ["prefix-undeclared"] * 3
    assert [finding.why.split("'")[1] for finding in findings] == ["drake", "gazebo", "last"]


def test_a_prefix_that_cannot_be_declared_is_refused():
    message = r"^x\.urdf:1:9: not well-formed XML: error parsing attribute name"
    with pytest.raises(FormatError, match=message):
        parse_description(b'<a:model="m"><b/></a:model>', "x.urdf")


def test_other_errors_are_found_despite_undeclared_prefixes():
    with pytest.raises(FormatError, match=r"^r.urdf:1:\d+: "):
        parse_description(b"<robot><drake:a></robot>", "r.urdf")
    with pytest.raises(FormatError, match="DOCTYPE"):
        parse_description(
            b'\n<?xml version="0.0"?><!DOCTYPE r [<!ENTITY e "x">]><r a:b="1">&e;</r>', "r.urdf"
        )


def described(body=b"", name=b"r", before=b"", after=b""):
    return before + b'<robot name="' + name + b'">\n' + body + b'<link name="l"/></robot>' + after


# What each loader does was tried: Pinocchio 4.1, MuJoCo 4.0, PyBullet 3.2.7 (all three parse by
# tinyxml2) and yourdfpy 0.0.60 (libxml2's recovery).
@pytest.mark.parametrize(
    ("data", "name", "repair"),
    [
        (described(b"<!-- a -- b -->"), "r", "comments with '--'"),
        (described(b"<!-- a --->"), "r", "comments with '--'"),
        (described(before=b"<!-- a -- b -->"), "r", "comments with '--'"),
        (described(b"<!-- \x01 -->"), "r", "comments with '--'"),
        (described(name=b"Arm & Hand"), "Arm & Hand", "bare '&'"),
        (described(b" a & b "), "r", "bare '&'"),
        (described(name=b"a&nbsp;b"), "a&nbsp;b", "bare '&'"),
        (described(name=b"a&amp b &lt;"), "a&amp b <", "bare '&'"),
        (described(after=b"\nthe end"), "r", "text after"),
        (described(after=b"</robot>"), "r", "text after"),
        (described(after=b'<robot name="second"><link name="m"/></robot>'), "r", "text after"),
        (described(after=b"<!-- a -- b -->"), "r", "comments with '--'"),
        (described(before=b"junk"), "r", "text before"),
        (described(before=b"\xef\xbb\xbf\xef\xbb\xbf"), "r", "text before"),
        (described(name=b"a<b>"), "a<b>", "'<' in an attribute"),
        (described(name=b"a\x01b"), "a\ufffdb", "U+FFFD"),
        (described(b" ]]> "), "r", "']]>' in a text"),
        (described(name=b"t\xefp"), "t\xefp", "read as latin1"),
        (described(b"<!-- t\xefp -->"), "r", "read as latin1"),
        (described(before=b'<?xml version="1.0" encoding="foo-8"?>'), "r", "read as utf-8"),
        (described(before=b'<?xml version="1.0" encoding="utf-16"?>'), "r", "read as utf-8"),
        (
            described(before=b'<?xml version="1.0" encoding="us-ascii"?>', name=b"t\xc3\xafp"),
            "t\xefp",
            "read as utf-8",
        ),
        (described(before=b'<?xml encoding="utf-8"?>'), "r", "declaration"),
        (described(b'<?xml version="1.0"?>'), "r", "declaration"),
    ],
)
def test_what_loaders_read_although_it_is_not_xml_is_read_with_a_warning(data, name, repair):
    failure(data)
    root, (finding,) = parse_description(data, "robot.urdf")
    assert root.get("name") == name
    assert [link.get("name") for link in root.iterfind("link")] == ["l"]
    assert root.find("link").sourceline == 2
    assert finding.severity == "warning"
    assert repair in finding.repair
    assert finding.where.startswith("robot.urdf:")


def test_a_declared_encoding_counts_in_a_document_that_is_repaired():
    text = '<?xml version="1.0" encoding="{}"?><robot name="{}"/><!-- a -- b -->'
    for encoding, name in (("ISO-8859-1", "é"), ("gb2312", "机器人"), ("utf-16", "é")):
        root, _ = parse_description(text.format(encoding, name).encode(encoding), "r.urdf")
        assert root.get("name") == name


def test_repairs_of_a_kind_are_one_finding_with_a_count():
    data = described(b"\n<!-- a -- b -->" * 3 + b" x & y ")
    _, (comments, ampersand) = parse_description(data, "r.urdf")
    assert "(3 times)" in comments.why
    assert comments.where == "r.urdf:3 document"
    assert "times" not in ampersand.why


@pytest.mark.parametrize(
    "data",
    [
        described(b'<link name="a" name="b"/>'),
        described(b'<a b="1"c="2"/>'),
        described(b'<a b="<"/>' * 100),
        described(b"< a/>"),
        described(b"<!foo>"),
        described(b"<link name/>"),
        described(b"<link name=a/>"),
        described(b"a < b"),
        described(b"<a></b>"),
        described()[:-8],
        described(b"<!-- a"),
        described(b"<!--" * 2**18),  # in hours, if each is searched for an end
        described(b"<? " * 2**18),
        described(b"<![CDATA[ a"),
        b"<!-- a -- b -->",
    ],
)
def test_what_has_two_meanings_stays_an_error(data):
    with pytest.raises(FormatError, match=r"^robot.urdf:\d+:\d+: "):
        parse_description(data, "robot.urdf")


@pytest.mark.parametrize("fault", [b"<!-- a -- b -->", b"x & y", b'<a b="<"/>', b""])
@pytest.mark.parametrize("doctype", [b"<!DOCTYPE r>", b'<!doctype r [<!ENTITY e "x">]>'])
@pytest.mark.parametrize("place", ["before", "body", "after"])
def test_a_doctype_is_an_error_beside_other_faults(fault, doctype, place):
    pieces = {"before": b"", "body": b"", "after": b"", place: doctype}
    body = pieces.pop("body") + fault
    with pytest.raises(FormatError, match="DOCTYPE"):
        parse_description(described(body, **pieces), "robot.urdf")
