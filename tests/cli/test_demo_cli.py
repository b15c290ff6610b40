"""``morphgen demo`` runs the first commands of the README, and stops at one that fails."""

from pathlib import Path

from morphgen.checks.readers import LOADERS


def test_demo_composes_checks_and_loads_a_robot(run):
    code, out, err = run("demo")
    assert (code, err) == (0, "")
    commands = [line for line in out.splitlines() if line.startswith("$ ")]
    assert commands == [
        "$ morphgen compose arm=ur5 ee=plane --out robots",
        "$ morphgen check robots/ur5-plane --strict",
        "$ morphgen conform robots/ur5-plane",
    ]
    assert "robots/ur5-plane: 0 error, 0 warning, 0 info\n" in out
    assert all(f"ur5-plane  bundle  {loader.name} " in out for loader in LOADERS)
    *_, last = out.splitlines()
    assert last == "The robot is in robots/ur5-plane; its picture is robots/ur5-plane/preview.png"
    assert Path("robots/ur5-plane/preview.png").is_file()


def test_demo_prints_one_line_if_it_cannot_write(run):
    Path("file").write_text("")
    code, out, err = run("demo", "--out", "file")
    assert (code, out) == (2, "$ morphgen compose arm=ur5 ee=plane --out file\n")
    assert err.startswith("morphgen: ")
    assert err.count("\n") == 1
