"""Fixtures: a viewer with small robots and a headless browser."""

import os
import shutil

import pytest

from helpers.robots import arm
from morphgen.formats.bundle import write_bundle
from morphgen.grammar.grammar_file import find_grammar, grammar_text, load_grammar
from morphgen.grammar.library import default_library
from morphgen.grammar.sampling import SetConfig, make_set
from morphgen.viewer.app.app import serve
from morphgen.viewer.robot_uri import FileAccess

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
NO_WARNING = """
new MutationObserver(() => {
  for (const note of document.querySelectorAll(".mantine-Notification-root"))
    if (note.textContent.includes("Software WebGL")) note.remove();
}).observe(document, {childList: true, subtree: true});
"""
"""viser's notice that there is no GPU would lie over the page."""
WAIT = 120_000
"""How long a page may take on a busy machine, milliseconds."""


@pytest.fixture(scope="session")
def chromium():
    """A shared browser; every test opens its own pages."""
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        pytest.skip("there is no chromium (apt-get install chromium)")
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed (pip install playwright)"
    )
    options = [*SOFTWARE_GL, *(() if os.geteuid() else ("--no-sandbox",))]
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=path, args=options)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """A folder with a set of robots, and one of bundles of which one is broken."""
    root = tmp_path_factory.mktemp("here")
    library = default_library()
    grammar = load_grammar(find_grammar("prims", library.folders), library.folders)
    plan = SetConfig(
        root / "robots" / "prims", "prims", grammar_text(grammar), 0, (), True, False, ()
    )
    make_set(plan, 30)
    write_bundle(arm(), root / "robots" / "some-arm", picture=False)
    broken = write_bundle(arm(), root / "robots" / "broken", picture=False)
    text = (broken / "robot.urdf").read_text()
    (broken / "robot.urdf").write_text(text.replace('<child link="lower"', '<child link="lost"'))
    return root


@pytest.fixture(scope="session")
def files(folder):
    """The files of a viewer in the folder."""
    return FileAccess(default_library().folders, (folder.resolve(),), folder / "none")


@pytest.fixture
def access(tmp_path):
    """The files of a viewer without uploads."""
    uploads = tmp_path / "uploads"
    uploads.mkdir()
    return FileAccess(default_library().folders, (tmp_path.resolve(),), uploads.resolve())


@pytest.fixture(scope="session")
def thumbnails(tmp_path_factory):
    """The cache of all viewers, so that their workers draw a thumbnail once."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="session")
def shared_viewer(folder, thumbnails):
    """A viewer in the folder for tests that ask nothing about the viewer itself."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("XDG_CACHE_HOME", str(thumbnails))
        viewer = serve(port=0)
    yield viewer
    viewer.stop()


@pytest.fixture
def viewer(folder, monkeypatch, thumbnails):
    """Start viewers in the folder; they are stopped after the test."""
    monkeypatch.chdir(folder)
    monkeypatch.setenv("XDG_CACHE_HOME", str(thumbnails))
    started = []

    def start(*words, **options):
        started.append(serve(words, port=0, **options))
        return started[-1]

    yield start
    for each in started:
        each.stop()


@pytest.fixture
def see(chromium, viewer):
    """Open the page of a query, of a new viewer unless one is given."""
    contexts = []

    def open_page(query="", *, on=None, width=1400, height=900):
        on = on or viewer()
        contexts.append(chromium.new_context(viewport={"width": width, "height": height}))
        contexts[-1].set_default_timeout(WAIT)
        contexts[-1].add_init_script(NO_WARNING)
        page = contexts[-1].new_page()
        page.failures = []
        page.on("pageerror", lambda error: page.failures.append(str(error)))
        page.goto(f"http://127.0.0.1:{on.port}/{query}")
        return page

    yield open_page
    for context in contexts:
        context.close()


@pytest.fixture
def quiet(capfd):
    """Require that the viewer prints nothing, such as a traceback."""
    yield
    assert capfd.readouterr() == ("", "")
