"""Pages in a browser: composing, playback, navigation."""

import re
import threading

import pytest

from helpers.pages import choose, field, nodes, press, wait_until
from helpers.runs import QUIET, small_config, small_source
from morphgen.formats.bundle import read_bundle
from morphgen.rl.runs.training import train
from morphgen.splits.split import read_split

pytestmark = pytest.mark.slow


def test_parts_that_do_not_fit_show_an_error_and_keep_the_robot(see):
    page = see("?compose=base=gantry ee=stick")
    page.get_by_text("DoF").first.wait_for()
    choose(page, "ee", "(none)", nth=1)
    page.get_by_text(re.compile("nothing to compose")).wait_for()
    assert page.get_by_text("gantry-stick").is_visible()


def test_robot_is_written_to_a_bundle(see, folder):
    page = see("?compose=base=planar ee=cube")
    page.get_by_text("DoF").first.wait_for()
    page.get_by_role("tab", name="Get").click()
    field(page, "name").fill("by-hand")
    press(page, "Write to robots/")
    page.get_by_text("Written", exact=True).wait_for()
    assert read_bundle(folder / "robots" / "by-hand").name == "by-hand"
    assert (folder / "robots" / "by-hand" / "preview.png").is_file()


def test_an_edited_grammar_is_sampled_and_kept_in_the_url(see):
    page = see("?compose=planar_arm")
    page.get_by_text("DoF").first.wait_for()
    text = page.locator("textarea").first
    edited = f"# my own\n{text.input_value()}"
    text.fill(edited)
    page.wait_for_url(re.compile(r"compose=planar_arm&text=[\w-]+$"))
    press(page, "next")
    page.wait_for_url(re.compile(r"text=[\w-]+&seed=0&number=1$"))
    page.reload()
    page.get_by_text("planar_arm-000001").wait_for()
    assert page.locator("textarea").first.input_value() == edited
    text.fill(edited + "".join(f"# {i**9:x}\n" for i in range(1000)))
    page.get_by_text(re.compile("too long for the page's address")).wait_for()
    page.wait_for_url(re.compile(r"compose=planar_arm$"))


def camera_distance(viewer):
    (session,) = viewer.sessions.values()
    camera = session.client.camera
    return float(sum((camera.position - camera.look_at) ** 2) ** 0.5)


def test_the_camera_follows_a_robot_that_outgrows_the_view(see, viewer):
    on = viewer()
    page = see("?compose=arm=arm3 ee=plane arm.length=0.1", on=on)
    page.get_by_text("DoF").first.wait_for()
    page.wait_for_timeout(1000)
    before = camera_distance(on)
    field(page, "length (m)").last.fill("0.5")
    page.get_by_text(re.compile(r"changed: reach 0\.\d\d to 1\.\d\d m, mass \+")).wait_for()
    page.wait_for_function("true")
    page.wait_for_timeout(1000)
    assert camera_distance(on) > 1.5 * before
    robots = [name for name in nodes(on) if re.fullmatch(r"/robot\d", name)]
    assert len(robots) == 2  # the robot and the ghost of the one before
    field(page, "length (m)").last.fill("0.25")
    page.wait_for_url(re.compile(r"arm\.length=0\.25$"))
    assert page.failures == []


def test_the_grammar_is_redrawn_while_typing_and_marks_errors_in_place(see):
    page = see("?compose=planar_arm")
    page.get_by_text("DoF").first.wait_for()
    text = page.locator("textarea").first
    assert "monospace" in text.evaluate("each => getComputedStyle(each).fontFamily")
    whole = text.input_value()
    text.fill(whole.replace("uniform(0.1, 0.5)", "uniform(0.4, 0.5)"))
    page.get_by_text(re.compile(r"changed: ")).wait_for()
    assert text.evaluate("each => each.scrollWidth <= each.clientWidth")  # long rules wrap
    wrong = whole.replace("->", "-> nosuchpart |", 1)
    text.fill(wrong)
    page.get_by_text(re.compile(r"planar_arm:\d+:\d+")).first.wait_for()
    mark = page.locator("#morphgen-mark")
    mark.wait_for(state="attached")
    line = wrong[: wrong.index("nosuchpart")].count("\n")
    place = text.evaluate(
        """(each, line) => {
            const mark = document.getElementById("morphgen-mark").style, is = parseFloat;
            const style = getComputedStyle(each), height = is(style.lineHeight);
            const rows = (is(mark.top) - each.offsetTop - is(style.paddingTop) + each.scrollTop);
            return [rows / height, is(mark.width)];
        }""",
        line,
    )
    assert place[0] == pytest.approx(line, abs=0.05)
    assert place[1] > 10
    text.fill(whole)
    mark.wait_for(state="detached")


CUBE = "words:base=planar ee=cube"


def wait_for_end(page, seconds="6.00"):
    page.get_by_text(re.compile(rf"^{seconds} s; simulated: {seconds} s")).wait_for()


def players():
    """Return the player threads of all browsers."""
    return [each for each in threading.enumerate() if each.name == "morphgen-player"]


def test_url_is_shown_and_new_episodes_have_other_seeds(see, viewer):
    page = see(f"?play=reach&robot={CUBE}&policy=random")
    page.wait_for_url(re.compile(r"policy=random$"))
    page.get_by_text(re.compile(r"simulated: [1-9]")).wait_for()
    press(page, "New episode")
    page.wait_for_url(re.compile(r"seed=1"))
    assert field(page, "seed").last.input_value() == "1"
    choose(page, "policy", "ik")
    page.wait_for_url(re.compile(r"policy=ik&seed=1"))
    wait_for_end(page)
    page.get_by_text("success", exact=True).wait_for()


def test_robots_are_replaced_added_and_removed(see, viewer):
    page = see("?play=reach&robot=robots/prims/prims-000001&policy=ik")
    page.get_by_text(re.compile(r"simulated: [1-9]")).wait_for()
    choose(page, "robot", "prims-000002")
    page.wait_for_url(re.compile(r"robot=robots/prims/prims-000002&policy=ik"))
    field(page, "or words").last.fill("base=planar ee=cube")
    press(page, "add")
    page.wait_for_url(re.compile(r"prims-000002&robot=words:base=planar%20ee=cube"))
    page.get_by_role("cell", name="planar-cube").wait_for()
    press(page, "only")
    page.wait_for_url(re.compile(r"play=reach&robot=robots/prims/prims-000002&policy"))


def test_robot_that_cannot_do_the_task_shows_the_reason(see, viewer):
    page = see(f"?play=push&robot={CUBE}")
    page.get_by_text(re.compile("robot 'planar-cube' can hardly push")).wait_for()
    choose(page, "task", "reach")
    page.wait_for_url(re.compile(r"play=reach.*policy=zero-shot$"))
    wait_for_end(page)
    assert page.get_by_text("can hardly push").count() == 0


def test_checkpoint_starts_with_its_training_robot(see, viewer, folder, tmp_path):
    train(folder / "runs" / "small", small_config(small_source()), execution=QUIET)
    on = viewer("runs/small")
    page = see(on=on)
    page.wait_for_url(re.compile(r"play=reach&robot=derivation:.*policy=runs/small$"))
    page.get_by_text(re.compile(r"simulated: [1-9]")).wait_for()
    page.get_by_role("cell", name=re.compile("^planar-cube")).wait_for()
    page.get_by_text("obstacles", exact=True).click()
    page.get_by_text(re.compile("the checkpoint is for other observations: obstacles 0")).wait_for()


def test_player_ends_when_its_browser_leaves_the_page(see, viewer, capfd):
    on = viewer()
    page = see(f"?play=reach&robot={CUBE}&policy=random", on=on)
    page.get_by_text(re.compile(r"simulated: [1-9]")).wait_for()
    other = see(f"?robot={CUBE}", on=on)
    other.get_by_text("no self-collision").wait_for()
    (player,) = players()
    other.get_by_role("link", name="reach", exact=True).click()
    other.get_by_text(re.compile(r"simulated: [1-9]")).wait_for()
    assert len(players()) == 2
    page.goto(f"http://127.0.0.1:{on.port}/?robot={CUBE}")
    page.get_by_text("no self-collision").wait_for()
    player.join(30)
    assert not player.is_alive()
    other.close()
    wait_until(lambda: players() == [])
    assert "Traceback" not in capfd.readouterr().err


def test_a_paused_episode_is_stepped_and_scrubbed_and_its_time_is_in_the_address(see):
    page = see(f"?play=reach&robot={CUBE}&policy=jacobian&t=1.5")
    page.get_by_text("1.50 s; simulated: 1.50 s").wait_for()
    press(page, "step")
    page.wait_for_url(re.compile(r"&t=1\.52$"))
    page.reload()
    page.get_by_text("1.52 s; simulated: 1.60 s").wait_for()
    press(page, "play")
    page.wait_for_url(re.compile(r"policy=jacobian$"))
    wait_for_end(page)
    field(page, "time (s)").last.fill("2")
    page.wait_for_url(re.compile(r"&t=2$"))
    press(page, "back")
    page.get_by_text("1.98 s; simulated: 6.00 s").wait_for()
    assert page.failures == []


TRAY = "#morphgen-tray"


def bar(page, label):
    return page.locator("#morphgen-bar").get_by_role("link", name=label, exact=True)


@pytest.fixture
def same(see):
    """Open a page and mark it; the mark is lost if the browser loads the client again."""

    def open_marked(query, **options):
        page = see(query, **options)
        page.locator("#morphgen-cover").wait_for(state="detached")
        page.evaluate("window.mark = true")
        return page

    return open_marked


def test_robots_are_chosen_compared_played_and_split(same, folder):
    page = same("?gallery=robots/prims")
    page.locator(".card img").nth(5).wait_for()
    boxes = page.locator("input[data-choose]")
    for i in (0, 3, 5):
        boxes.nth(i).click()
    page.locator(TRAY).get_by_text("3 chosen").wait_for()
    page.wait_for_url(re.compile("gallery=robots/prims&(chosen=[^&]*&){2}chosen=[^&]*000005$"))
    page.locator("a.card").nth(3).click()
    page.get_by_text("no self-collision").or_(page.get_by_text("collide")).first.wait_for()
    page.locator("input[data-choose]:checked").wait_for(state="attached")
    page.go_back()
    page.get_by_text("30 robots · page 1 of 2").wait_for()
    page.wait_for_function("document.querySelectorAll('input[data-choose]:checked').length == 3")
    page.locator(TRAY).get_by_text("compare").click()
    page.get_by_text(re.compile("prims-000000 and prims-000003")).wait_for()
    page.wait_for_url(re.compile(r"\?compare=[^&]*000000&compare=[^&]*000003&compare=[^&]*000005&"))
    page.go_back()
    page.get_by_role("checkbox", name="choose robots/prims/prims-000003").click()
    page.locator(TRAY).get_by_text("2 chosen").wait_for()
    page.locator(TRAY).get_by_text("split").click()
    page.get_by_text("test (1)").wait_for()
    field(page, "split name").last.fill("from/tray")
    press(page, "Save")
    page.get_by_text("morphgen split audit splits/from/tray.yaml").wait_for()
    split = read_split(folder / "splits" / "from" / "tray.yaml")
    assert [member.name for member in split.test] == ["prims-000005"]
    press(page, "Save")
    page.get_by_text(re.compile("exists; choose another name")).first.wait_for()
    with page.expect_download() as download:
        page.locator(TRAY).get_by_text("download").click()
    assert download.value.suggested_filename == "robots.zip"
    page.locator(TRAY).get_by_text("clear").click()
    page.locator(TRAY).wait_for(state="hidden")
    assert page.evaluate("window.mark") is True
    assert page.failures == []


def test_the_bar_leads_everywhere_and_back_returns(same):
    page = same("?library=")
    page.locator(".card").first.wait_for()
    for label, text in (
        ("Gallery", "Open the gallery of which robots?"),
        ("Population", "Show which robots on one ground?"),
        ("Splits", "Open which split?"),
        ("Compare", "Compare two to four robots"),
        ("Compose", "DoF"),
    ):
        bar(page, label).click()
        page.get_by_text(text).first.wait_for()
        assert bar(page, label).get_attribute("class") == "current"
    for text in ("Compare two to four robots", "Open which split?"):
        page.go_back()
        page.get_by_text(text).wait_for()
    page.go_forward()
    page.get_by_text("Compare two to four robots").wait_for()
    assert page.evaluate("window.mark") is True
    assert page.failures == []


def test_the_theme_changes_without_a_new_page(same):
    page = same("?compare=robots/some-arm&joint1=0.5")
    page.get_by_text("1 robot", exact=True).wait_for()
    bar(page, "dark").click()
    page.locator('html[data-mantine-color-scheme="dark"]').wait_for(state="attached")
    page.wait_for_url(re.compile(r"compare=robots/some-arm&joint1=0\.5$"))
    assert page.evaluate("window.mark") is True
    page.reload()  # the browser remembers it
    page.locator('html[data-mantine-color-scheme="dark"]').wait_for(state="attached")


def test_the_open_tab_is_in_the_address_and_back_returns_to_it(same):
    page = same("?robot=robots/prims/prims-000001")
    page.get_by_role("tab", name="Links").click()
    page.wait_for_url(re.compile(r"&tab=Links$"))
    page.get_by_role("link", name="robots/prims").click()
    page.locator(".card").first.wait_for()
    page.go_back()
    page.locator('[role=tab][aria-selected=true][title="Links"]').wait_for()
    page.get_by_role("tab", name="Move").click()
    page.wait_for_url(re.compile(r"prims-000001$"))
    assert page.failures == []
