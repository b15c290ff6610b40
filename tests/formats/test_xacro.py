"""Expansion of xacro: expressions and their limits, compiled templates, errors of files."""

import ast
import builtins
import math
import os
import re
import threading
import time
import warnings
from pathlib import Path
from xml.dom import minidom

import numpy as np
import pytest

import morphgen.formats
from morphgen.errors import FormatError
from morphgen.formats import resolve
from morphgen.formats.resolve import PackageFinder
from morphgen.formats.rounding import format_number
from morphgen.formats.xacro import evaluator
from morphgen.formats.xacro import expand as xacro_process
from morphgen.formats.xacro.compile import compile_xacro, trace
from morphgen.formats.xacro.expand import (
    MAX_ELEMENTS,
    MAX_INCLUDE_DEPTH,
    MAX_TEXT,
    Expansion,
    expand,
)
from morphgen.formats.xml import parse_xml
from morphgen.grammar.library import default_library

NOWHERE = PackageFinder()
HEAD = '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">'


def expand_text(text, args, origin, finder):
    """Expand a text as if it were a file, in this process."""
    return Expansion(args, origin, finder).run(text.encode())


def robot(body):
    return f"{HEAD}{body}</robot>"


def expanded(body, origin, **args):
    """Return the attributes of the links of an expanded document."""
    root = parse_xml(expand_text(robot(body), args, origin, NOWHERE), "out")
    return [dict(link.attrib) for link in root.findall("link")]


def failure(body, origin, **args):
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
    results = {}

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
    assert evaluator.evaluate_number(expression, {"length": 0.3, "e": 9.0}) == pytest.approx(value)


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
        evaluator.evaluate_number(expression, {"length": 0.3})
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


NAMES = {
    **evaluator.MATH,
    **evaluator.BUILTINS,
    "x": 3,
    "words": "1 2.5 3",
    "limits": {"elbow": {"max": 2.5, "keys": 7}, "list": [1, [2, 3]]},
}


def value(text, names=NAMES):
    return evaluator.Expression(text).evaluate(names)


@pytest.mark.parametrize(
    "text",
    [
        "2*x + 1 - x/3 + x**2 - x//2 + x%2",
        "-x + +x",
        "sqrt(x) + sin(pi/6) * hypot(x, 4) + radians(90) + atan2(x, 1)",
        "1 < x <= 3 and not x == 4 or x in [1, 2]",
        "'a' if x > 2 else 'b'",
        "'left_' + 'arm' * 2",
        "'%.3f and %d%% of %s' % (pi, x, 'y')",
        "max(x, 5) + min([x, 1]) + abs(-x) + round(2.5, 1) + int('7') + float('1') + len(words)",
        "[float(word) for word in words.split()]",
        "[a * b for a in range(4) if a % 2 for b in range(a)]",
        "[a + b for a, b in zip([1, 2], [3, 4])]",
        "' '.join(str(a) for a in range(3))",
        "sum(a * 2 for a in range(5))",
        "limits['elbow']['max'] + limits['list'][1][0] + limits['list'][-1][-1]",
        "limits.get('nothing', 1)",
        "list(limits.keys())",
        "dict(a=1) == {'a': 1} and {'b': [2], x: 1}",
        "[0, x, (1, 2)][1:3]",
        "'Ab_c'.lower().upper().replace('B', 'd').strip('A').split('_')",
        "words.startswith('1') and words.endswith('3') and words.index('2') == 2",
        "'abc'[::-1] + str(True) + str(None) + str([1, 'a'])",
        "sorted([3, 1, 2], reverse=True) + list(reversed((1, 2)))",
        "bool(x) and any([0, 1]) and all([])",
        "divmod(7, 2) + tuple([1]) + ()",
        "x is not None",
    ],
)
def test_expressions_have_the_values_of_python(text):
    python = {
        name: getattr(math, name, None) or getattr(builtins, name, given)
        for name, given in NAMES.items()
    }
    assert value(text) == eval(text, {"__builtins__": {}} | python)


def test_a_dot_accesses_dictionary_entries():
    assert value("limits.elbow.max") == 2.5
    assert value("limits.elbow.keys") == 7
    assert value("limits.elbow.keys()") == ["max", "keys"]


@pytest.mark.parametrize(
    ("text", "construct"),
    [
        ("().__class__.__bases__", "Attribute '().__class__.__bases__' is not allowed"),
        ("x.real", "Attribute 'x.real' is not allowed"),
        ("sin.call", "Attribute 'sin.call' is not allowed"),
        ("limits.__class__", "Attribute 'limits.__class__' is not allowed"),
        ("'{0.__class__}'.format(x)", "Attribute \"'{0.__class__}'.format\" is not allowed"),
        ("'{a}'.format_map(limits)", 'format_map" is not allowed'),
        ("f'{x.real}'", "JoinedStr \"f'{x.real}'\" is not allowed"),
        ("lambda: x", "Lambda 'lambda: x' is not allowed"),
        ("(y := x)", "NamedExpr 'y := x' is not allowed"),
        ("(a for a in ()).gi_frame", "Attribute '(a for a in ()).gi_frame' is not allowed"),
        ("{1, 2}", "Set '{1, 2}' is not allowed"),
        ("{a: 1 for a in []}", "DictComp"),
        ("[*words]", "Starred '*words' is not allowed"),
        ("dict(**limits)", "keyword '**limits' is not allowed"),
        ("{**limits}", "Dict '{**limits}' is not allowed"),
        ("x << 2", "LShift"),
        ("1j", "Constant '1j' is not allowed"),
        ("...", "is not allowed"),
        ("[a for limits.elbow in [1]]", "'limits.elbow' is not allowed"),
        ("x(1)", "Call 'x(1)' is not allowed"),
        ("'a'.split()()", "Call \"'a'.split()()\" is not allowed"),
        ("sin", "its value is a function"),
    ],
)
def test_syntax_outside_the_allowlist_is_an_error(text, construct):
    with pytest.raises(evaluator.RefusedError) as caught:
        value(text)
    assert construct in str(caught.value)


@pytest.mark.parametrize(
    "text",
    ["vars(x)", "type(x)", "open('a')", "eval('1')", "getattr(x, 'real')", "__import__('os')"],
)
def test_builtins_outside_the_allowlist_are_unknown(text):
    with pytest.raises(NameError, match="is not defined"):
        value(text)


@pytest.mark.parametrize("text", ["str(sin)", "[sin]", "dict(a=sin)", "sin == sin", "min(key=len)"])
def test_functions_are_not_data(text):
    with pytest.raises(TypeError, match="is not data"):
        value(text)


@pytest.mark.parametrize(
    "text",
    [
        "'a' * 10**10",
        "10**10 * 'a'",
        "[0] * 10**9",
        "list(range(10**9))",
        "10**10**10",
        "2**1000 * 2**1000",
        "round(5, -10**9)",
        "'%1000000000d' % 1",
        "'%.1000000000f' % 1",
        "'%*d' % (10**9, 1)",
        "'%(a(b)c)1000000000d' % {'a(b)c': 1}",
        "'a'.zfill(10**9)",
        "('a' * 1000).replace('a', 'b' * 1000)",
        "('a' * 1000).join(['b'] * 1000)",
        "[a for a in range(10**5) for b in range(10**5) for c in range(10**5)]",
        "[0 for a in range(10**5) for b in range(10**5) if 0]",
        "[len('a' * 10**5) for a in range(10**5)]",
        "[(a + a) for a in ['a' * 10**5] for b in range(10**4)]",
        "str(" + "[[a, a] for a in " * 30 + "[0]" + "]" * 30 + ")",
        "+".join(["1"] * 9000),
        "-" * 9000 + "1",
        "1" * 10_001,
        "(" * 150 + "[" * 150,
    ],
)
def test_expressions_have_bounded_time_and_size(text):
    start = time.process_time()
    with pytest.raises((evaluator.RefusedError, SyntaxError)):
        value(text)
    assert time.process_time() - start < 2


def test_no_text_of_a_document_is_executed_by_python():
    folder = Path(morphgen.formats.__file__).parent
    calls = [
        f"{path.name}: {ast.unparse(node)}"
        for path in sorted(folder.rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id in ("eval", "exec", "compile", "__import__")
    ]
    assert calls == []


def test_the_page_documents_every_function_and_bound():
    page = (Path(__file__).parents[2] / "docs" / "importing.md").read_text(encoding="utf-8")
    words = set(re.findall(r"\w+", page))
    assert set(evaluator.BUILTINS) - words == set()
    bounds = (
        f"{evaluator.MAX_LENGTH:,} characters, {evaluator.MAX_WORK:,} steps, ",
        f"{evaluator.MAX_WORK:,} steps, {evaluator.MAX_DEPTH} levels",
        f"{evaluator.MAX_SIZE:,} characters and entries; {evaluator.MAX_BITS} bits",
        f"| {xacro_process.MAX_FILE >> 20} MiB |",
        f"| {MAX_INCLUDE_DEPTH} |",
        f"{MAX_ELEMENTS:,} elements processed, {xacro_process.MAX_CLONES:,} copied, {MAX_TEXT:,}",
        f"| {xacro_process.MAX_OUTPUT:,} characters |",
        f"{xacro_process.CPU_LIMIT} s of CPU time, {xacro_process.WALL_LIMIT} s of waiting, "
        f"{xacro_process.MEMORY_LIMIT >> 30} GiB of memory",
    )
    assert [bound for bound in bounds if bound not in page] == []


@pytest.mark.parametrize("expression", ["2if 1 else 3", r"len('\d')"])
def test_suspicious_expressions_print_no_python_warning(expression):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert evaluator.evaluate_number(expression, {}) == 2.0


TEMPLATES = [manifest for manifest in default_library().manifests() if manifest.is_template]
FINDER = PackageFinder()
HEAD_OF_COMPILED = (
    '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="x">'
    '<xacro:arg name="x" default="0.1"/><xacro:property name="x" value="$(arg x)"/>'
)


@pytest.fixture
def write(tmp_path):
    """Write a xacro with an argument x around a body; return its path."""

    def written(body):
        path = tmp_path / "x.xacro"
        path.write_text(f"{HEAD_OF_COMPILED}{body}</robot>")
        return path

    return written


def values_of(manifest, rng):
    """Return random integer and real parameters of a template as xacro arguments."""
    constants, numbers = {}, {}
    for name, parameter in manifest.parameters.items():
        if parameter.integer:
            drawn = rng.integers(int(parameter.minimum), int(parameter.maximum) + 1)
            constants[name] = format_number(float(drawn))
        else:
            numbers[name] = format_number(rng.uniform(parameter.minimum, parameter.maximum))
    return constants, numbers


@pytest.mark.parametrize("manifest", TEMPLATES, ids=lambda manifest: manifest.name)
def test_every_compiled_template_fills_to_the_bytes_of_its_expansion(manifest):
    rng = np.random.default_rng(0)
    drawn = [values_of(manifest, rng) for _ in range(6)]
    reals = {name: p for name, p in manifest.parameters.items() if not p.integer}
    for pick in (min, max):
        ends = {name: format_number(pick(p.minimum, p.maximum)) for name, p in reals.items()}
        drawn.append((drawn[0][0], ends))
    for constants, numbers in drawn:
        compiled = compile_xacro(manifest.source, constants, numbers, FINDER)
        assert compiled is not None
        whole = expand(manifest.source, constants | numbers, FINDER)
        assert compiled.fill(numbers) == whole


@pytest.mark.parametrize(
    "body",
    [
        '<a v="$(arg x)"/>',
        '<a v="${x}"/>',
        '<a v="${2*x + 1 - x/3 + x**2}" w="${-x} 0 ${+x}"/>',
        '<a v="${sqrt(x) + sin(x) * cos(2*x) - tan(x/2) + atan2(x, 1)}"/>',
        '<a v="${max(x, 0.5, 2) + min(1, x) + fabs(-x) + radians(x) + degrees(x) + pi}"/>',
        '<xacro:property name="y" value="${x*3}"/><a v="${y*2}">${y}</a>',
        '<xacro:macro name="m" params="s"><b v="${s*2}"/></xacro:macro><xacro:m s="${x*3}"/>',
        '<xacro:if value="${1 > 0}"><a v="${x}"/></xacro:if>',
        '<link name="part_${x}"/>',
        "<a>&lt;${x}&amp;</a>",
    ],
)
@pytest.mark.usefixtures("xacro_here")
def test_arithmetic_is_compiled(write, body):
    path = write(body)
    compiled = compile_xacro(path, {}, {"x": "0.7"}, FINDER)
    assert compiled is not None
    for value in ("0.3", "2", "1e-05", "123456789012", "0.123456789012", "0"):
        assert compiled.fill({"x": value}) == expand(path, {"x": value}, FINDER)


@pytest.mark.parametrize(
    "body",
    [
        '<xacro:if value="${x > 1}"><a/></xacro:if>',
        '<xacro:unless value="${x}"><a/></xacro:unless>',
        '<a v="${1 if x else 2}"/>',
        '<a v="${x % 2}"/>',
        '<a v="${x // 2}"/>',
        '<a v="${int(x) + round(x, 1) + ceil(x)}"/>',
        '<a v="${min([x, 1])}"/>',
        '<a v="${hypot(x, 1)}"/>',
        "<a v=\"${'%.2f' % x}\"/>",
        '<a v="$(eval x * 2)"/>',
        '<xacro:property name="y" value="-${x}"/><a v="${y*2}"/>',
        '<xacro:property name="y" value="-${x}"/><a v="${y+1}"/>',
        '<xacro:property name="y" value="${-x} ${2*x}"/><a v="${y.split()[1]}"/>',
        '<xacro:macro name="m" params="s"><b v="${s*2}"/></xacro:macro><xacro:m s="-${x}"/>',
        "<a v=\"${'a' if str(x) == '0.3' else 'b'}\"/>",
    ],
)
@pytest.mark.usefixtures("xacro_here")
def test_documents_with_more_than_arithmetic_are_not_compiled(write, body):
    path = write(body)
    assert compile_xacro(path, {}, {"x": "0.3"}, FINDER) is None
    assert b"<robot" in expand(path, {"x": "0.3"}, FINDER)


@pytest.mark.parametrize("body", ['<a v="${nothing}"/>', '<a v="${1/(x-0.3)}"/>', "<a>", "<a b=/>"])
@pytest.mark.usefixtures("xacro_here")
def test_documents_with_errors_are_not_compiled(write, body):
    path = write(body)
    assert compile_xacro(path, {}, {"x": "0.3"}, FINDER) is None
    with pytest.raises(FormatError, match=r"x\.xacro"):
        expand(path, {"x": "0.3"}, FINDER)


@pytest.mark.parametrize("expression", ["().__class__", "2", "p_x", "lambda: 0", "1" * 20_000])
def test_marker_characters_in_a_document_are_kept_as_text(write, expression):
    path = write(f'<a v="\ue000{expression}\ue001"/>')
    for trusted in (False, True):
        assert trace(path, FINDER, {}, {"x": "0.3"}, installed_only=trusted) is None
    assert compile_xacro(path, {}, {"x": "0.3"}, FINDER) is None
    assert f"\ue000{expression}\ue001" in expand(path, {"x": "0.3"}, FINDER).decode()


def test_a_value_for_which_an_expression_fails_is_an_error(write):
    compiled = compile_xacro(write('<a v="${1/(x-0.3)}"/>'), {}, {"x": "1"}, FINDER)
    assert compiled.fill({"x": "2"}) == b'<robot name="x"><a v="0.5882352941176471"></a></robot>'
    with pytest.raises(FormatError, match=r"fails for \{'x': '0.3'\}: float division by zero"):
        compiled.fill({"x": "0.3"})


def test_a_file_is_compiled_once_until_it_changes(write):
    path = write('<a v="${x}"/>')
    before = compile_xacro(path, {}, {"x": "0.3"}, FINDER)
    assert compile_xacro(path, {}, {"x": "0.4"}, FINDER) is before
    write('<a v="${2*x}"/>')
    later = path.stat().st_mtime_ns + 10**9
    os.utime(path, ns=(later, later))
    after = compile_xacro(path, {}, {"x": "0.3"}, FINDER)
    assert (before.fill({"x": "2"}), after.fill({"x": "2"})) == (
        b'<robot name="x"><a v="2"></a></robot>',
        b'<robot name="x"><a v="4"></a></robot>',
    )
