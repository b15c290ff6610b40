"""Arbitrary file contents cause no traceback, no hang and no memory use above one gigabyte.

Rejected files give a one-line message. The generated examples are the same in every run.
"""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import morphgen
from helpers.fuzzing import MEMORY_MIB, Runner
from helpers.robots import arm
from morphgen.formats.urdf.write import urdf_text
from morphgen.grammar.grammar_file import grammar_names

TEMPLATES = Path(morphgen.__file__).parent / "templates"

ROBOT = urdf_text(arm(), str).replace(
    "</link>", '<collision><geometry><mesh filename="a/b.stl"/></geometry></collision></link>', 1
)

MODEL = """<mujoco model="m">
  <compiler angle="radian" autolimits="true"/>
  <default><default class="c"><geom type="capsule" size="0.1 0.2" rgba="1 0 0 1"/></default>
  </default>
  <asset><material name="grey" rgba="0.5 0.5 0.5 1"/>
    <mesh name="cut" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>
  <worldbody><geom type="plane" size="1 1 1"/>
    <body name="base"><inertial pos="0 0 0.1" mass="1.5" diaginertia="0.01 0.01 0.01"/>
      <geom type="box" size="0.1 0.2 0.3" material="grey"/><site name="tool" pos="0 0 1"/>
      <body name="tip" pos="0 0 0.3" euler="0 1.57 0" childclass="c">
        <joint name="turn" axis="0 0 1" range="-1 1" ref="0.1" pos="0 0.1 0"/><geom/>
        <geom type="mesh" mesh="cut" mass="1"/><geom type="ellipsoid" size="0.1 0.2 0.3"/>
        <body name="nail"><joint name="slide" type="slide" range="0 0.1"/><geom mass="1"/></body>
      </body>
    </body>
  </worldbody>
  <contact><exclude body1="base" body2="nail"/></contact>
  <tendon><fixed name="t"><joint joint="turn" coef="1"/><joint joint="slide" coef="2"/></fixed>
  </tendon>
  <equality><joint joint1="slide" joint2="turn" polycoef="0 2 0 0 0"/></equality>
  <actuator><motor joint="turn" gear="3" ctrlrange="-2 2"/><position tendon="t" kp="1"/></actuator>
  <keyframe><key name="home" qpos="0.5 0"/></keyframe>
</mujoco>
"""

STRANGE = [
    *("", "0", "-1", "nan", "inf", "-0", "1e308", "1e-320", "9" * 400, "1 2", "1 2 3", "0 0 0"),
    *("upper", "lower", "floating", "continuous", "A" * 3000, "${1/0}", "../../x", "/dev/zero"),
    *("\u0000", "\n", "\u202e", "é"),
]
TAGS = ["<", ">", "</link>", "<!--", "<![CDATA[", '<!DOCTYPE r SYSTEM "x">', "&a;", "<a:b/>"]

ATOMS = (  # noqa: SIM905
    "1;0;2.5;-1;10**9;1e308;'a';'';[];[1, 2];{};{'a': 1};();True;None;pi;x;math;math.pi;xacro;"
    "xacro.load_yaml;python;python.type;__import__;load_yaml('x.yaml');'%s';'{0.__class__}';"
    "lambda: 1;...;open;range(3)"
).split(";")
CALLS = """
len str int float list tuple dict range sum max abs round sin sqrt math.factorial math.pow
radians eval getattr type python.vars xacro.load_yaml xacro.fatal sorted map print
""".split()  # noqa: SIM905
BINARY = ["+", "-", "*", "/", "//", "%", "**", "<<", "@", "==", "<", " and ", " in ", " if x else "]
ATTRIBUTES = ["__class__", "format", "upper", "join", "a", "mro", "gi_frame", "real", "__globals__"]


def wider(inner):
    return st.one_of(
        st.builds("({}{}{})".format, inner, st.sampled_from(BINARY), inner),
        st.builds("{}({})".format, st.sampled_from(CALLS), inner),
        st.builds("{}({}, {})".format, st.sampled_from(CALLS), inner, inner),
        st.builds("{}[{}]".format, inner, inner),
        st.builds("{}.{}".format, inner, st.sampled_from(ATTRIBUTES)),
        st.builds("{}.{}({})".format, inner, st.sampled_from(ATTRIBUTES), inner),
        st.builds("[{} for y in {}]".format, inner, inner),
        st.builds("f'{{{}}}'".format, inner),
        st.builds("-{}".format, inner),
    )


expressions = st.one_of(
    st.recursive(st.sampled_from(ATOMS), wider, max_leaves=12),
    st.text(alphabet="${}()[]'\"\\.+-*/%<>=!,:x1_ \n", max_size=60),
)


@st.composite
def mutated(draw, text, tokens):
    """Generate a text with some parts cut, doubled, moved or replaced."""
    for _ in range(draw(st.integers(1, 5))):
        size = len(text)
        start = draw(st.integers(0, size))
        end = min(size, start + draw(st.integers(0, 40)))
        match draw(st.sampled_from(["cut", "token", "double", "many", "move"])):
            case "cut":
                text = text[:start] + text[end:]
            case "token":
                text = text[:start] + draw(st.sampled_from(tokens)) + text[end:]
            case "double":
                text = text[:end] + text[start:]
            case "many":
                text = text[:start] + text[start:end] * draw(st.integers(2, 3000)) + text[end:]
            case "move":
                place = draw(st.integers(0, size))
                text = text[:place] + text[start:end] + text[place:]
    return text


@st.composite
def broken_xml(draw, text):
    """Generate a description with invalid values, tags and bytes."""
    for _ in range(draw(st.integers(0, 3))):
        values = [i for i, letter in enumerate(text) if letter == '"']
        first = 2 * draw(st.integers(0, len(values) // 2 - 1))
        start, end = values[first] + 1, values[first + 1]
        text = text[:start] + draw(st.sampled_from(STRANGE)) + text[end:]
    if draw(st.booleans()):
        text = draw(mutated(text, TAGS))
    data = text.encode(draw(st.sampled_from(["utf-8", "utf-8", "utf-16", "utf-8-sig"])))
    for _ in range(draw(st.integers(0, 3))):
        where = draw(st.integers(0, len(data)))
        data = data[:where] + draw(st.binary(max_size=4)) + data[where + draw(st.integers(0, 3)) :]
    return data


GRAMMARS = [
    (TEMPLATES / "grammars" / f"{name}.grammar").read_text(encoding="utf-8")
    for name in sorted(grammar_names())
]
WORDS = [
    *("{1,1000000000}", "{999999999}", "{0,0}", "robot -> robot robot\n", "| robot robot"),
    *("not " * 50, "(" * 2000, "-" * 2000, "1+" * 2000, "1e400", "9" * 5000, "\x00", "->", "\n"),
    *("uniform(1, 0)", "uniform(0, 1e308)", "where ", "let a = a\n", 'include "/etc/hostname"\n'),
    *("include arm3\n", "@weight(0)", "ur5", "plane", "mount_yaw=1"),
]
grammars = st.sampled_from(GRAMMARS).flatmap(lambda text: mutated(text, WORDS))


@pytest.fixture(scope="module")
def runner(tmp_path_factory):
    made = Runner(tmp_path_factory.mktemp("fuzz"))
    yield made
    made.close()


def require_good_manners(answer, context):
    assert answer["code"] in (0, 1, 2), (context, answer["err"])
    assert "Traceback" not in answer["err"], (context, answer["err"])
    assert answer["mib"] < MEMORY_MIB, context
    if answer["code"] == 2:
        assert answer["err"].count("\n") == 1, (context, answer["err"])
        assert answer["err"].startswith("morphgen: "), (context, answer["err"])


def manners(max_examples):
    same = {"derandomize": True, "database": None, "suppress_health_check": list(HealthCheck)}
    return settings(max_examples=max_examples, **same)


@pytest.mark.slow
@manners(250)
@given(expression=expressions)
def test_xacro_expressions(runner, expression):
    quoted = expression.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    path = runner.folder / "robot.urdf.xacro"
    path.write_text(
        '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">'
        '<xacro:property name="x" value="3"/>'
        f'<link name="a"/><xacro:if value="${{{quoted}}}"><link name="${{{quoted}}}"/></xacro:if>'
        "</robot>",
        encoding="utf-8",
    )
    require_good_manners(runner.run("check", path), expression)


@pytest.mark.slow
@manners(250)
@given(data=broken_xml(ROBOT), command=st.sampled_from(["check", "show"]))
def test_urdf_bytes(runner, data, command):
    path = runner.folder / "robot.urdf"
    path.write_bytes(data)
    require_good_manners(runner.run(command, path), data)


@pytest.mark.slow
@manners(250)
@given(data=broken_xml(MODEL), command=st.sampled_from(["check", "show"]))
def test_mjcf_bytes(runner, data, command):
    path = runner.folder / "robot.xml"
    path.write_bytes(data)
    require_good_manners(runner.run(command, path), data)


@pytest.mark.slow
@manners(200)
@given(text=grammars, command=st.sampled_from(["check", "count", "print"]))
def test_grammar_text(runner, text, command):
    path = runner.folder / "some.grammar"
    path.write_text(text, encoding="utf-8")
    require_good_manners(runner.run("grammar", command, path), text)
