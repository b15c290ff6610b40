"""Version, supported Pythons, continuous integration and the distributions fit together."""

import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
TESTED = ("benchmarks", "docs", "examples", "results", "tests")
"""Folders that the tests need, besides the package."""


def read_yaml(path):
    return yaml.safe_load((ROOT / path).read_text(encoding="utf-8"))


def make_targets(text):
    """Return the targets of the calls of make in a script."""
    calls = re.findall(r"(?m)^\s*make (.*)$", text)
    return {word for call in calls for word in call.split() if "=" not in word}


def test_the_version_is_the_same_everywhere():
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    newest = re.search(r"(?m)^## \[?(\d+\.\d+\.\d+)", changelog)[1]
    assert PROJECT["version"] == read_yaml("CITATION.cff")["version"] == newest


def test_the_readme_names_the_version_of_torch_in_the_constraints():
    """With another version installed, pip would replace the CPU build by the CUDA build."""
    constraints = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    (torch,) = [line for line in constraints if line.startswith("torch==")]
    assert f"`{torch}`" in (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_workflow_runs_what_the_script_runs_on_every_python():
    jobs = read_yaml(".github/workflows/ci.yml")["jobs"]
    scripts = {
        name: "\n".join(step.get("run", "") for step in job["steps"]) for name, job in jobs.items()
    }
    targets = {
        row["python"]: make_targets(
            scripts["test"].replace("${{ matrix.targets }}", row["targets"])
        )
        for row in jobs["test"]["strategy"]["matrix"]["include"]
    }
    pythons = [re.search(r":: (3\.\d+)$", text) for text in PROJECT["classifiers"]]
    assert list(targets) == [match[1] for match in pythons if match]
    assert PROJECT["requires-python"] == f">={min(targets)}"
    script = make_targets((ROOT / ".ci" / "run").read_text(encoding="utf-8"))
    assert {"check", "test"} == script <= targets["3.11"]
    assert all("test" in each for each in targets.values())
    assert "dist" in make_targets(scripts["dist"])
    phony = re.search(r"(?m)^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(encoding="utf-8"))[1]
    assert set().union(*targets.values(), make_targets(scripts["dist"])) <= set(phony.split())


@pytest.mark.parametrize("name", ["bug", "part", "question"])
def test_issue_forms_have_fields_with_a_label(name):
    form = read_yaml(f".github/ISSUE_TEMPLATE/{name}.yml")
    assert {"name", "description", "body"} <= set(form)
    assert all(field["attributes"]["label"] for field in form["body"])


@pytest.mark.slow
def test_distributions_have_all_files(tmp_path):
    """The source distribution has what the tests need; the wheel has the package and its data."""
    pytest.importorskip("setuptools")
    source = tmp_path / "source"
    junk = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info", "build", "dist", "robots")
    shutil.copytree(ROOT, source, symlinks=True, ignore=junk)
    for name in (".ci", ".github"):
        shutil.copytree(ROOT / name, source / name)
    code = (
        "from setuptools import build_meta as build\n"
        f"print(build.build_sdist({str(tmp_path)!r}), build.build_wheel({str(tmp_path)!r}))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=source, capture_output=True, text=True, check=True
    )
    sdist, wheel = done.stdout.splitlines()[-1].split()
    with tarfile.open(tmp_path / sdist) as archive:
        packed = {name.partition("/")[2] for name in archive.getnames()}
    expected = {
        path.relative_to(source).as_posix()
        for folder in (*TESTED, ".ci", ".github")
        for path in (source / folder).rglob("*")
        if path.is_file()
    }
    assert expected - packed == set()
    with zipfile.ZipFile(tmp_path / wheel) as archive:
        names = set(archive.namelist())
    package = {
        f"morphgen/{path.relative_to(source).as_posix()}"
        for folder in ("rl", "robots_real", "tasks", "templates", "viewer")
        for path in (source / folder).rglob("*")
        if path.is_file()
    }
    assert package - names == set()
    assert not any(name.startswith(TESTED) for name in names)
