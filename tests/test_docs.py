"""The documentation pages match the code."""

import re
from pathlib import Path

import pytest

from morphgen.cli import build_parser
from morphgen.grammar.library import default_library

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def codes_in_source():
    codes = set()
    for room in ("checks", "formats"):
        for path in (ROOT / "morphgen" / room).glob("*.py"):
            text = path.read_text(encoding="utf-8")
            codes |= set(re.findall(r'"([a-z]+(?:-[a-z]+)+)",\s+"(?:error|warning|info)"', text))
            codes |= set(re.findall(r'finding\(\s*\w+,\s*"([a-z]+(?:-[a-z]+)*)"', text))
    return codes


def test_every_finding_code_is_documented():
    page = (ROOT / "docs" / "findings.md").read_text(encoding="utf-8")
    codes = codes_in_source()
    assert len(codes) > 30
    assert {code for code in codes if f"`{code}`" not in page} == set()


def test_readme_part_counts_are_correct():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    arms, ees = re.search(r"(\d+) arms and (\d+) end-effectors", text).groups()
    library = default_library()
    assert int(arms) == len(library.names("arm"))
    assert int(ees) == len(set(library.names("ee")) - {"none"})


def indented(text):
    return "\n".join(line for line in text.splitlines() if line.startswith("    "))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_between_pages_are_valid(page):
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
        if not target.startswith("https://"):
            assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_documented_command_exists(page):
    commands = build_parser()._subparsers._group_actions[0].choices
    text = page.read_text(encoding="utf-8")
    blocks = "\n".join([*re.findall(r"```\w*\n(.*?)```", text, re.DOTALL), indented(text)])
    for command in re.findall(r"(?m)^\s*morphgen ([a-z]+)", blocks):
        assert command in commands


def test_readme_example_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(
        r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL
    )
    exec(code, {})
    assert len(list((tmp_path / "robots").iterdir())) == 1
