"""Expanding xacro files in process, without access to Python, the environment or other files."""

import math
import threading
from pathlib import Path
from xml.dom import minidom

import pytest

from morphgen.errors import FormatError
from morphgen.formats import resolve
from morphgen.formats.resolve import PackageFinder
from morphgen.formats.xacro import expand as xacro_process
from morphgen.formats.xacro.evaluator import evaluate_number
from morphgen.formats.xacro.expand import Expansion, expand
from morphgen.formats.xml import parse_xml

NOWHERE = PackageFinder()
HEAD = '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">'


def expand_text(text, args, origin, finder):
    """Expand a text as if it were a file, in this process."""
    return Expansion(args, origin, finder).run(text.encode())


def robot(body):
    return f"{HEAD}{body}</robot>"


def expanded(body: str, origin: Path, **args: str) -> list[dict[str, str]]:
    """Return the attributes of the links of an expanded document."""
    root = parse_xml(expand_text(robot(body), args, origin, NOWHERE), "out")
    return [dict(link.attrib) for link in root.findall("link")]


def failure(body: str, origin: Path, **args: str) -> str:
    with pytest.raises(FormatError) as caught:
        expand_text(robot(body), args, origin, NOWHERE)
    message = str(caught.value)
    assert "\n" not in message
    assert str(origin.parent) in message
    return message


@pytest.fixture
def origin(tmp_path):
    return tmp_path / "part.xacro"


LENGTH = '<xacro:arg name="length" default="1"/><link name="l"/>'
ARGUMENT = '<xacro:arg name="n" default="3"/><link name="l$(arg n)"/>'
CHAIN = """
  <xacro:property name="n" value="2"/>
  <xacro:macro name="chain" params="i">
    <link name="l${'%.3f' % (pi * i)}"/>
    <xacro:if value="${i &lt; n}"><xacro:chain i="${i + 1}"/></xacro:if>
  </xacro:macro>
  <xacro:chain i="0"/>"""


@pytest.mark.parametrize(
    ("body", "args", "names"),
    [
        (ARGUMENT, {}, ["l3"]),
        (ARGUMENT, {"n": "7"}, ["l7"]),
        ('<link name="$(arg prefix)link"/>', {"prefix": "left_"}, ["left_link"]),
        (f'<xacro:if value="false">{ARGUMENT}</xacro:if><link name="a"/>', {"n": "2"}, ["a"]),
        (CHAIN, {}, ["l0.000", "l3.142", "l6.283"]),
        ('<xacro:include filename="no.xacro" optional="true"/><link name="a"/>', {}, ["a"]),
        ("<link name=\"${xacro.load_yaml('p.yaml').arm.reach}\"/>", {}, ["0.5"]),
        ('<link name="$(optenv EXTRA usual)"/>', {}, ["usual"]),
    ],
)
def test_documents_are_expanded(body, args, names, origin, tmp_path, monkeypatch):
    monkeypatch.setenv("EXTRA", "surprise")
    (tmp_path / "p.yaml").write_text("arm: {reach: !millimeters 500}\n")
    assert expanded(body, origin, **args) == [{"name": name} for name in names]


def test_calls_share_no_state(origin):
    expanded('<xacro:property name="p" value="1"/><xacro:arg name="a" default="1"/>', origin)
    assert "'p'" in failure('<link name="${p}"/>', origin)
    failure('<link name="${1/0}"/>', origin)


def test_includes_are_relative_to_the_file_that_includes(tmp_path, monkeypatch):
    (tmp_path / "sub").mkdir()
    (tmp_path / "top.xacro").write_text(robot('<xacro:include filename="sub/a.xacro"/>'))
    (tmp_path / "sub" / "a.xacro").write_text(robot('<xacro:include filename="b.xacro"/>'))
    (tmp_path / "sub" / "b.xacro").write_text(robot('<link name="$(dirname)"/>'))
    monkeypatch.chdir("/")
    root = parse_xml(expand(tmp_path / "top.xacro", {}, NOWHERE), "out")
    assert [link.get("name") for link in root] == [str(tmp_path / "sub")]


def test_find_searches_around_the_file_and_in_roots(tmp_path, origin):
    (tmp_path / "near_description").mkdir()
    (tmp_path / "far" / "far_description").mkdir(parents=True)
    finder = PackageFinder((tmp_path / "far",))
    text = robot('<link name="$(find near_description)"/><link name="$(find far_description)"/>')
    root = parse_xml(expand_text(text, {}, origin, finder), "out")
    assert [link.get("name") for link in root] == [
        str(tmp_path / "near_description"),
        str(tmp_path / "far" / "far_description"),
    ]


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ('<link name="${1/0}"/>', "division by zero"),
        ('<link name="${nope}"/>', "'nope'"),
        ('<link name="$(eval lambda: 0)"/>', "is not allowed"),
        ('<link name="${1 +}"/>', "syntax"),
        ("<xacro:nope/>", "nope"),
        ("<xacro:property/>", "name"),
        ('<xacro:if value="maybe"/>', "maybe"),
        ('<xacro:macro name="m" params="a"/><xacro:m/>', "a"),
        ('<xacro:macro name="m" params=" "/><xacro:m/>', "m"),
        ('<link name="$(env HOME)"/>', "xacro:arg"),
        ('<link name="$(cwd)"/>', "xacro:arg"),
        ('<link name="$(nope x)"/>', "valid: arg"),
        ("<link name=\"${load_yaml('lost.yaml')}\"/>", "lost.yaml"),
        ('<link name="$(find lost)"/>', "'lost'"),
        ('<link name="$(arg prefix)"/>', "'prefix'"),
        ('<xacro:include filename="lost.xacro"/>', "lost.xacro"),
        ('<xacro:include filename="broken.xacro"/>', "broken.xacro:3:"),
        ('<xacro:include filename="bomb.xacro"/>', "DOCTYPE"),
        ('<xacro:include filename="part.xacro"/>', "endless"),
        ('<xacro:macro name="m"><xacro:m/></xacro:macro><xacro:m/>', "endless"),
    ],
)
def test_errors_are_one_line_that_names_the_file(body, reason, origin, tmp_path):
    origin.write_text(robot(body))
    (tmp_path / "broken.xacro").write_text("<robot>\n\n<link></robot>")
    (tmp_path / "bomb.xacro").write_text('<!DOCTYPE r [<!ENTITY a "b">]><r>&a;</r>')
    assert reason in failure(body, origin)


def test_an_undeclared_argument_is_an_error_that_suggests_the_nearest(origin):
    assert "'lenght'; did you mean 'length'" in failure(LENGTH, origin, lenght="2")


def test_warnings_are_not_printed(origin, capfd):
    body = '<xacro:property name="pi" value="3"/><xacro:property name="a" value="1" odd="2"/>'
    body += "<link name=\"l${xacro.warning('odd')}\"/>"
    expanded(body, origin)
    failure(body + "<xacro:nope/>", origin)
    assert capfd.readouterr() == ("", "")


def test_special_characters_in_text_and_attributes_are_preserved(origin):
    text = robot('<!-- gone --><link name="a&lt;&quot;b\'&amp;é"/><gazebo>1 &lt; 2</gazebo>')
    root = parse_xml(expand_text(text, {}, origin, NOWHERE), "out")
    assert root[0].get("name") == "a<\"b'&é"
    assert root[1].text == "1 < 2"


def test_changes_of_the_xacro_package_to_minidom_are_undone(origin):
    expanded('<link name="l"/>', origin)
    text = '<a z="1" b="2"> <c/> </a>'
    assert minidom.parseString(text).documentElement.toxml() == text  # type: ignore[union-attr]


def test_expansion_is_thread_safe(tmp_path):
    results: dict[int, list[list[dict[str, str]]]] = {}

    def work(k):
        body = '<xacro:arg name="n" default="0"/><link name="$(arg n)${sin(0)}"/>'
        results[k] = [expanded(body, tmp_path / f"{k}.xacro", n=str(k)) for _ in range(30)]

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results == {k: [[{"name": f"{k}0.0"}]] * 30 for k in range(4)}


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("0.5", 0.5),
        (" length / 2 ", 0.15),
        ("2 * math.sin(pi / 6) + max(length, 1)", 2.0),
        ("radians(90)", math.pi / 2),
        ("e", 9.0),
    ],
)
def test_a_numeric_expression_is_evaluated(expression, value):
    assert evaluate_number(expression, {"length": 0.3, "e": 9.0}) == pytest.approx(value)


@pytest.mark.parametrize(
    ("expression", "reason"),
    [
        ("lenght", "did you mean 'length'"),
        ("1 / 0", "division by zero"),
        ("1e400", "not a finite number"),
        ("2**1023 + (2**1023 - 1)", "too large"),
        ("True", "not a finite number"),
        ("'long'", "not a finite number"),
        ("", "invalid syntax"),
        ("$(arg length)", "invalid syntax"),
        ("().__class__", "__class__"),
    ],
)
def test_expressions_that_are_not_numbers_are_errors(expression, reason):
    with pytest.raises(FormatError) as caught:
        evaluate_number(expression, {"length": 0.3})
    assert reason in str(caught.value)
    assert repr(expression) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_installed_file_that_includes_a_user_file_is_expanded_in_a_subprocess(
    tmp_path, monkeypatch
):
    installed = tmp_path / "installed"
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "package.xml").write_text("<package><name>other</name></package>")
    (tmp_path / "other" / "x.xacro").write_text(robot('<link name="theirs"/>'))
    installed.mkdir()
    part = installed / "part.xacro"
    part.write_text(
        robot(
            '<link name="ours"/><xacro:arg name="file" default=""/>'
            "<xacro:if value=\"${'$(arg file)' != ''}\">"
            '<xacro:include filename="$(arg file)"/></xacro:if>'
        )
    )
    monkeypatch.setattr(resolve, "_morphgen_folders", lambda: (installed,))
    asked = []
    run = xacro_process.run_in_child
    monkeypatch.setattr(
        xacro_process, "run_in_child", lambda *a, **k: asked.append(a) or run(*a, **k)
    )
    assert b"ours" in expand(part, {}, NOWHERE)
    assert asked == []
    assert b"theirs" in expand(part, {"file": str(tmp_path / "other" / "x.xacro")}, NOWHERE)
    assert len(asked) == 1
