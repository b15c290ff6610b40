"""A compiled xacro filled with values has the same bytes as its expansion."""

import os

import numpy as np
import pytest

from morphgen.errors import FormatError
from morphgen.formats.resolve import PackageFinder
from morphgen.formats.rounding import format_number
from morphgen.formats.xacro.compile import compile_xacro, trace
from morphgen.formats.xacro.expand import expand
from morphgen.grammar.library import default_library

TEMPLATES = [manifest for manifest in default_library().manifests() if manifest.is_template]
FINDER = PackageFinder()
HEAD = (
    '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="x">'
    '<xacro:arg name="x" default="0.1"/><xacro:property name="x" value="$(arg x)"/>'
)


@pytest.fixture
def write(tmp_path):
    """Write a xacro with an argument x around a body; return its path."""

    def written(body):
        path = tmp_path / "x.xacro"
        path.write_text(f"{HEAD}{body}</robot>")
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
