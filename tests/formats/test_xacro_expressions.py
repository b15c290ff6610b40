"""Xacro expressions are evaluated by an interpreter with an allowlist and resource bounds."""

import ast
import builtins
import math
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

import morphgen.formats
from morphgen.formats.xacro import expand as xacro_process
from morphgen.formats.xacro.evaluator import (
    BUILTINS,
    MATH,
    MAX_BITS,
    MAX_DEPTH,
    MAX_LENGTH,
    MAX_SIZE,
    MAX_WORK,
    Expression,
    RefusedError,
)
from morphgen.formats.xacro.expand import MAX_ELEMENTS, MAX_INCLUDE_DEPTH, MAX_TEXT

NAMES = {
    **MATH,
    **BUILTINS,
    "x": 3,
    "words": "1 2.5 3",
    "limits": {"elbow": {"max": 2.5, "keys": 7}, "list": [1, [2, 3]]},
}


def value(text, names=NAMES):
    return Expression(text).evaluate(names)


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
    with pytest.raises(RefusedError) as caught:
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
    with pytest.raises((RefusedError, SyntaxError)):
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
    assert set(BUILTINS) - words == set()
    bounds = (
        f"{MAX_LENGTH:,} characters, {MAX_WORK:,} steps, {MAX_DEPTH} levels",
        f"{MAX_SIZE:,} characters and entries; {MAX_BITS} bits",
        f"| {xacro_process.MAX_FILE >> 20} MiB |",
        f"| {MAX_INCLUDE_DEPTH} |",
        f"{MAX_ELEMENTS:,} elements processed, {xacro_process.MAX_CLONES:,} copied, {MAX_TEXT:,}",
        f"| {xacro_process.MAX_OUTPUT:,} characters |",
        f"{xacro_process.CPU_LIMIT} s of CPU time, {xacro_process.WALL_LIMIT} s of waiting, "
        f"{xacro_process.MEMORY_LIMIT >> 30} GiB of memory",
    )
    assert [bound for bound in bounds if bound not in page] == []


def test_suspicious_expressions_print_no_python_warning():
    code = (
        "from morphgen.formats.xacro.evaluator import evaluate_number as evaluate; "
        r"print(evaluate('2if 1 else 3', {}), evaluate('len(\'\\d\')', {}))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert (result.stdout, result.stderr) == ("2.0 2.0\n", "")
