"""The documentation pages match the code, and build as a site."""

import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

from morphgen.benchmark.scores.submission import EvalProtocol
from morphgen.cli import build_parser, main
from morphgen.cli.command import parse
from morphgen.grammar.library import default_library
from morphgen.tasks.registry import register_gym_envs

ROOT = Path(__file__).parent.parent
PAGES = [
    *(ROOT / name for name in ("README.md", "benchmarks/README.md", "examples/README.md")),
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "results").glob("*.md")),
]
BLOCK = re.compile(
    r"(?:(?P<file>\S+)`:\n\n)?```(?P<language>\w*)\n(?P<code>.*?)```\n"
    r"|(?P<commands>(?:^    [^\n]*\n)+)",
    re.DOTALL | re.MULTILINE,
)
"""A fenced block, with the name of the file that it is to be saved as, or indented lines."""

SLOW_PAGES = ("similarity", "splits", "tasks")
"""Pages whose Python examples take seconds."""


_MJCF = """<mujoco model="{name}"><worldbody>
  <body name="base"><geom size="0.1"/>
    <body name="leg" pos="0 0 {length}">
      <joint name="a" axis="0 1 0" range="-1 1"/><geom size="0.1"/>
      <body name="torso" pos="0 0 {length}">
        <joint name="b" axis="1 0 0" range="-1 1"/><geom size="0.05"/>
        <site name="tool" pos="0 0 0.2"/>
      </body>
    </body>
  </body>
</worldbody></mujoco>"""
_LINK = """<link name="{}"><inertial><mass value="1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><sphere radius="0.05"/></geometry></collision></link>"""
_DESCRIPTION = f"""<robot name="z1_description">{_LINK.format("link00")}{_LINK.format("link06")}
  <joint name="j" type="revolute"><parent link="link00"/><child link="link06"/>
    <origin xyz="0 0 0.3"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


def add_outside_robots(folder, monkeypatch):
    """Write the robots below a folder, and let the collections find them there."""
    packages = folder / "outside" / "packages"
    collection = packages / "robot_descriptions"
    lengths = {
        collection / "ur5e.xml": 0.3,
        **{folder / "bodies" / f"body_{i}.xml": 0.2 + 0.02 * i for i in range(1, 23)},
    }
    for path, length in lengths.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(_MJCF.format(name=path.stem, length=length))
    (collection / "z1.urdf").write_text(_DESCRIPTION)
    (collection / "__init__.py").touch()
    (collection / "z1_description.py").write_text(f"URDF_PATH = {str(collection / 'z1.urdf')!r}\n")
    mjcf = f"MJCF_PATH = {str(collection / 'ur5e.xml')!r}\n"
    (collection / "ur5e_mj_description.py").write_text(mjcf)
    monkeypatch.syspath_prepend(str(packages))


def codes_in_source():
    paths = (ROOT / "morphgen" / room / "findings.yaml" for room in ("checks", "formats"))
    return {row.split("/")[0] for path in paths for row in yaml.safe_load(path.read_text("utf-8"))}


def test_every_finding_code_is_documented():
    page = (ROOT / "docs" / "findings.md").read_text(encoding="utf-8")
    codes = codes_in_source()
    assert len(codes) > 60
    assert {code for code in codes if f"`{code}`" not in page} == set()


def test_readme_part_counts_are_correct():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    arms, ees = re.search(r"(\d+) arms and (\d+) end-effectors", text).groups()
    library = default_library()
    assert int(arms) == len(library.names("arm"))
    assert int(ees) == len(set(library.names("ee")) - {"none"})


@pytest.fixture(scope="module")
def parser():
    return build_parser()


def blocks(page):
    """Return the matches of ``BLOCK`` in a page; comments of HTML are no part of it."""
    return list(BLOCK.finditer(page.read_text(encoding="utf-8")))


def code(page, language):
    return [block["code"] for block in blocks(page) if block["language"] == language]


def commands(block):
    """Return the morphgen commands of a block, without comments and placeholders."""
    text = (block["commands"] or (block["code"] if not block["language"] else "")) or ""
    lines = text.replace("\\\n", " ").splitlines()
    found = [re.match(r"\s*(?:\$ )?(?:\w+=\S+ )*morphgen (.*)", line) for line in lines]
    texts = [re.sub(r"\[--.*?\]| \.\.\.", "", match[1]) for match in found if match]
    return [shlex.split(text, comments=True) for text in texts]


def test_pages_are_short_enough_to_be_read():
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    words = {page.name: len(page.read_text(encoding="utf-8").split()) for page in pages}
    assert words["README.md"] < 900
    assert max(words.values()) <= 2500
    assert sum(words.values()) < 26000


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_between_pages_are_valid(page):
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
        if not target.startswith("https://"):
            path = (page.parent / target).resolve()
            # A source distribution has tasks, rl and viewer only inside of morphgen.
            packaged = ROOT / "morphgen" / path.relative_to(ROOT)
            assert path.exists() or packaged.exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_documented_commands_have_valid_options(page, parser):
    for block in blocks(page):
        for words in commands(block):
            # `play` accepts a path as policy only if it exists.
            words = [str(ROOT) if re.match("(runs|study)/", word) else word for word in words]
            if words != ["COMMAND", "--help"]:
                parse(parser, words)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_yaml_and_toml_can_be_read(page):
    assert all(yaml.safe_load(text) or text.startswith("#") for text in code(page, "yaml"))
    assert all(tomllib.loads(text) for text in code(page, "toml"))


EXAMPLES = [
    pytest.param(text, id=f"{page.stem}-{i}", marks=[pytest.mark.slow] * (page.stem in SLOW_PAGES))
    for page in PAGES
    for i, text in enumerate(code(page, "python"))
    if page.stem not in ("own-parts", "releases", "tutorial")  # their examples need each other
]


@pytest.mark.parametrize("text", EXAMPLES)
def test_python_examples_run(text, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    if "import gymnasium" in text:  # which finds the environments if it is imported first
        register_gym_envs()
    exec(text, {"__name__": "__main__"})


@pytest.mark.slow
@pytest.mark.parametrize("name", ["own-parts", "releases", "tutorial"])
def test_pages_work_from_top_to_bottom(name, tmp_path, monkeypatch, capsys):
    """Save the files of a page, run its commands and examples; training is shortened.

    A block without a language, below commands, is what the last of them prints.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    add_outside_robots(tmp_path, monkeypatch)
    simulator, _, *defaults = EvalProtocol.__init__.__defaults__
    monkeypatch.setattr(EvalProtocol.__init__, "__defaults__", (simulator, 2, *defaults))
    _, _, text = (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8").partition("\n## ")
    printed, is_shortened = "", False
    for block in BLOCK.finditer(text):
        if printed and block["code"] and not block["language"] and not block["file"]:
            form = rounded if is_shortened else str
            for line in form(block["code"]).splitlines():  # which may end in dots
                expected = re.escape(line.removesuffix("...")) + ".*" * line.endswith("...")
                assert re.search(f"^{expected}$", form(printed), re.MULTILINE), line
        if block["file"]:
            path = Path(block["file"].strip("`"))
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block["code"], encoding="utf-8")
        elif block["language"] == "python":
            exec(block["code"], {"__name__": "__main__"})
        for archive in re.findall(r"^ +unzip -q (\S+)$", block["commands"] or "", re.MULTILINE):
            shutil.unpack_archive(archive)
        for words in commands(block):
            for each in looped(words):
                assert main([*each, *shortened(each)]) == 0, each
            printed = "\n".join(capsys.readouterr()) if block["commands"] else ""
            is_shortened |= words[0] == "train"  # what follows depends on it


def rounded(text):
    """Return a text without what a shortened training changes: numbers and successes."""
    text = re.sub(r"-?\d[\d.,]*|unknown|nan", "N", text).replace("N%", "N")
    return re.sub(r": (success|failure), ", ": ended, ", text)


def looped(words):
    """Return the commands of a shell's loop over bodies, or the command alone."""
    if not any("$body" in word for word in words):
        return [words]
    bodies = sorted(path.stem for path in Path("bodies").glob("*.xml"))
    return [[word.replace("$body", body) for word in words] for body in bodies]


def shortened(words):
    """Return options that shorten a command; all rules of submissions ask for two episodes."""
    if words[0] == "train":
        return ["--steps", "640", "--envs", "10"]
    if words[0] == "eval" or words[:2] == ["split", "release"]:
        return ["--episodes", "2"]
    return []


@pytest.mark.parametrize("name", ["part_manifest", "parts"])
def test_generated_page_is_current(name):
    script = runpy.run_path(str(ROOT / "docs" / f"{name}.py"))
    assert script["PAGE"].read_text(encoding="utf-8") == script["page"]()


@pytest.mark.slow
def test_site_builds_without_a_warning_and_loads_nothing_from_elsewhere(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=quiet)
    assert done.returncode == 0, done.stderr
    pages = {path.stem: path.read_text(encoding="utf-8") for path in tmp_path.glob("*.html")}
    assert {page.stem for page in PAGES if page.parent.name == "docs"} <= set(pages)
    for text in pages.values():
        assert re.findall(r"<(?:script|img|iframe)[^>]* src=\"?(?:https?:)?//[^>]*>", text) == []
        assert re.findall(r"<link[^>]* href=\"?(?:https?:)?//[^>]*>", text) == []
    commands = build_parser()._subparsers._group_actions[0].choices
    assert all(f'id="{name}"' in pages["cli"] for name in commands)
    assert 'id="morphgen.compose"' in pages["api"]
    assert "In this repository" not in pages["cli"]
