"""``morphgen view``: serving, warnings and rejected input."""

import os
import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest
from websockets.exceptions import InvalidStatus

from helpers.commands import start
from helpers.viser_client import PlainClient


def address(process):
    """Return the URL that a started viewer prints."""
    for line in process.stdout:
        if line.startswith("http://"):
            return line.split()[0]
    raise AssertionError(process.stderr.read())


def stop(viewing, end=signal.SIGTERM):
    """Stop a viewer by a signal; return its exit code and what it printed as errors."""
    viewing.send_signal(end)
    _, errors = viewing.communicate(timeout=60)  # which ends once its workers have ended, too
    return viewing.returncode, errors


@pytest.mark.slow
@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_viewer_serves_until_a_signal_and_deletes_uploads(tmp_path, monkeypatch, end):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    viewing = start("view", "--port", "8933")
    url = address(viewing)
    assert b"<html" in urllib.request.urlopen(url, timeout=60).read().lower()
    with PlainClient(int(re.search(r":(\d+)", url)[1])) as client:
        client.upload("a.urdf", b'<robot name="r"><link name="a"/></robot>')
        client.sent_to()
    (folder,) = tmp_path.glob("morphgen-uploads-*")
    assert [path.name for path in folder.rglob("*.urdf")] == ["a.urdf"]
    assert stop(viewing, end) == (0, "")
    assert list(tmp_path.glob("morphgen-uploads-*")) == []


STUCK = {
    "thread": "ThreadPoolExecutor(1).submit(os.read, os.pipe()[0], 1)",
    "pipe that is opened": "ThreadPoolExecutor(1).submit(open, PIPE)",
    "worker": "viewer.workers.submit(time.sleep, 10_000)",
    "worker that opens a pipe": "viewer.workers.submit(os.open, PIPE, os.O_RDONLY)",
}
"""Work that never ends, which a viewer has begun."""


@pytest.mark.parametrize(
    "stuck",
    [
        pytest.param(work, id=name, marks=[] if name == "worker" else [pytest.mark.slow])
        for name, work in STUCK.items()
    ],
)
def test_work_that_hangs_does_not_keep_the_viewer_running(tmp_path, monkeypatch, stuck):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "stuck.py").write_text(
        f"""
import os, time
from concurrent.futures import ThreadPoolExecutor
from morphgen.cli import main
from morphgen.viewer.app import app
PIPE = {str(tmp_path / "pipe")!r}
if __name__ == "__main__":
    serve = app.serve
    def serve_stuck(*arguments):
        viewer = serve(*arguments)
        {stuck}
        return viewer
    app.serve = serve_stuck
    raise SystemExit(main(["view", "--port", "8936"]))
"""
    )
    viewing = subprocess.Popen(
        [sys.executable, tmp_path / "stuck.py"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    address(viewing)
    (folder,) = tmp_path.glob("morphgen-uploads-*")
    assert stop(viewing)[0] == 0
    assert not folder.exists()


@pytest.mark.slow
def test_allowed_origins_are_served(tmp_path):
    site = "https://hub.example.com"
    viewing = start("view", "--port", "8934", "--allow-origin", site)
    port = int(re.search(r":(\d+)", address(viewing))[1])
    with PlainClient(port, origin=site, host="hub.example.com") as client:
        client.shows("Grammars")
    with pytest.raises(InvalidStatus):
        PlainClient(port, origin="https://other.example.com")
    lines = stop(viewing)[1].splitlines()
    assert [line for line in lines if not re.search(r", \d+ s$", line)] == []  # progress aside


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/net/if_inet6").exists(), reason="no IPv6 here")
def test_ipv6_address_is_served(tmp_path):
    viewing = start("view", "--port", "8935", "--host", "::1")
    where = address(viewing)
    port = int(where.rpartition(":")[2])
    assert where == f"http://[::1]:{port}"
    with PlainClient(port, address="::1", origin=where) as client:
        client.shows("Grammars")
    assert stop(viewing) == (0, "")


@pytest.mark.slow
def test_non_local_host_prints_a_warning(tmp_path):
    viewing = start("view", "--host", "0.0.0.0", "--port", "8932")
    address(viewing)
    _, errors = stop(viewing, signal.SIGINT)
    assert "warning: --host 0.0.0.0" in errors
    assert "no password" in errors
