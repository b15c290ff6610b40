"""``morphgen view`` serves, warns and refuses."""

import signal
import urllib.request

import pytest

from commands import start
from morphgen.formats.bundle import write_bundle
from robots import arm


def address(process):
    """Where a started viewer listens; the line that says so."""
    for line in process.stdout:
        if line.startswith("http://"):
            return line.split()[0]
    raise AssertionError(process.stderr.read())


def test_a_bundle_is_served_until_interrupted(tmp_path):
    write_bundle(arm(), tmp_path / "arm", picture=False)
    viewing = start("view", tmp_path / "arm", "--port", "8931")
    page = urllib.request.urlopen(address(viewing), timeout=60)
    assert b"<html" in page.read().lower()
    viewing.send_signal(signal.SIGINT)
    _, errors = viewing.communicate(timeout=60)
    assert viewing.returncode == 0
    assert "Traceback" not in errors


def test_another_host_is_warned_of(tmp_path):
    viewing = start("view", "--host", "0.0.0.0", "--port", "8932")
    address(viewing)
    viewing.send_signal(signal.SIGINT)
    _, errors = viewing.communicate(timeout=60)
    assert "warning: --host 0.0.0.0" in errors
    assert "no password" in errors


@pytest.mark.parametrize(
    ("name", "why"),
    [("some.npz", "is no episode of morphgen view"), ("some.pt", "is not a checkpoint")],
)
def test_a_file_that_cannot_be_played_is_refused(refused, tmp_path, name, why):
    (tmp_path / name).write_text("something else")
    assert why in refused("view", tmp_path / name)


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["nowhere"], "no such file or folder, no split and no grammar"),
        (["arm=ur6"], "unknown arm 'ur6'"),
        (["--host", "8.8.8.8"], "cannot serve at '8.8.8.8'"),
        (["--host", "nosuch.invalid"], "cannot serve at"),
        (["--port", "0"], "--port 0: expected 1 to 65535"),
        (["--library", "nowhere"], "library folder"),
    ],
)
def test_what_cannot_be_served_is_refused(refused, words, why):
    assert why in refused("view", *words)
