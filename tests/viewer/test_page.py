"""The page of one robot is served, and its sliders start at home."""

import urllib.request

import pytest

from morphgen.errors import FormatError, MorphgenError
from morphgen.formats.bundle import write_bundle
from morphgen.viewer.page import serve
from robots import arm


def test_a_bundle_is_served(tmp_path):
    server = serve(write_bundle(arm(), tmp_path / "arm", picture=False), port=8923)
    try:
        page = urllib.request.urlopen(f"http://127.0.0.1:{server.get_port()}", timeout=20)
        assert page.status == 200
        assert b"<html" in page.read().lower()
    finally:
        server.stop()


@pytest.mark.parametrize("host", ["8.8.8.8", "nosuch.invalid"])
def test_an_address_of_another_machine_is_refused(tmp_path, host):
    with pytest.raises(MorphgenError, match="cannot serve at"):
        serve(write_bundle(arm(), tmp_path / "arm", picture=False), host=host)


def test_what_is_no_bundle_is_refused_before_anything_is_served(tmp_path):
    with pytest.raises(FormatError, match="no bundle"):
        serve(tmp_path)
