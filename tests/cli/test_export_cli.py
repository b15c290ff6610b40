"""``morphgen export``."""

import pytest

from helpers.robots import arm
from morphgen.formats.bundle import file_findings, write_bundle


def test_bundles_get_their_web_page_and_stay_valid(run, tmp_path):
    folders = [write_bundle(arm(), tmp_path / name, picture=False) for name in ("a", "b")]
    code, out, _ = run("export", *folders)
    assert code == 0
    assert out.split() == [str(folder / "robot.html") for folder in folders]
    for folder in folders:
        assert b"__VISER_EMBED_DATA__" in (folder / "robot.html").read_bytes()
        assert file_findings(folder) == ()


def test_other_robots_are_written_into_the_output_folder(run, tmp_path):
    code, out, _ = run("export", "base=planar", "ee=cube", "--out", tmp_path, "--dark")
    assert code == 0
    (path,) = tmp_path.iterdir()
    assert out.strip() == str(path)
    assert path.suffix == ".html"
    assert b"darkMode:true" in path.read_bytes()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--format", "gif", "--dark"), "--dark: a gif has no dark page"),
        (("--out", "nowhere"), "--out nowhere: no such folder"),
        (("--format", "pdf"), "gif, html, mp4"),
    ],
)
def test_invalid_options_are_refused(run, words, message):
    code, _, err = run("export", "base=planar", "ee=cube", *words)
    assert code == 2
    assert message in err.replace("'", "")
