"""Galleries and populations of robots, comparisons, and splits."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from helpers.pages import click_on, nodes
from helpers.robots import arm
from helpers.viser_client import PlainClient
from morphgen.errors import BenchmarkError
from morphgen.grammar.compose import compose
from morphgen.grammar.library import default_library
from morphgen.grammar.request import parse_words
from morphgen.model.inertia import fit_camera
from morphgen.model.kinematics import forward_kinematics, joint_limits
from morphgen.model.mesh import load_mesh
from morphgen.splits.split import find_split, read_split
from morphgen.viewer.app.address import AddressError
from morphgen.viewer.pages import population as population_page
from morphgen.viewer.pages.gallery import parse_range
from morphgen.viewer.pages.population import (
    compare_robots,
    find_source,
    format_selection,
    parse_selection,
    read_robots,
    selection_text,
    similarity_table,
)
from morphgen.viewer.pages.split import make_member, map_svg, save_split
from morphgen.viewer.robot_rows import Row
from morphgen.viewer.robot_uri import member_uri, read_robot_uri
from morphgen.viewer.scene import population as populations
from morphgen.viewer.scene.population import (
    ReadRobot,
    make_population,
    numbered_joints,
    shape_poses,
)
from morphgen.viewer.scene.robot import robot_bounds
from morphgen.viewer.scene.stage import project_points


def test_cards_of_a_gallery_lead_to_their_robots(shared_viewer):
    with PlainClient(shared_viewer.port, "?gallery=robots/prims") as client:
        client.shows("30 robots · page 1 of 2")
        client.until(lambda: 'href="?robot=' in client.text)
        hrefs = re.findall(r'class="card" href="([^"]*)"', client.text)[:24]
        assert hrefs == [f"?robot=robots/prims/prims-{i:06d}" for i in range(24)]


def test_the_library_counts_parts(shared_viewer):
    with PlainClient(shared_viewer.port, "?library=") as client:
        client.shows(" parts · page 1 of")
        client.control("Dropdown", "Kind of part")
        kind = "GuiDropdownMessage"
        dropdowns = [each["props"] for each in client.messages if each["type"] == kind]
        (orders,) = [each["options"] for each in dropdowns if each["label"] == "Sort by"]
        assert {"order, last first", "name, Z to A", "reach, largest first"} <= {*orders}


def card_names(client):
    """Return the names on the cards that are shown last."""
    grids = re.findall(r'<div class="columns">.*', client.text)
    return re.findall(r'class="name">([^<]*)', grids[-1]) if grids else []


def test_search_order_and_page_of_a_gallery_are_in_the_address(shared_viewer):
    with PlainClient(shared_viewer.port, "?gallery=robots/prims&sort=-name") as client:
        client.until(lambda: card_names(client)[:1] == ["prims-000029"])
        client.change(client.control("ButtonGroup", "Page"), "next")
        client.shows("page 2 of 2")
        client.until(lambda: card_names(client) == [f"prims-{i:06d}" for i in range(5, -1, -1)])
        assert client.addresses[-1] == (0, "?gallery=robots/prims&sort=-name&n=2")
        client.change(client.control("Text", "Search"), "00000")
        client.shows("10 of 30 robots · page 1 of 1")
        client.until(lambda: client.addresses[-1][1].endswith("&sort=-name&search=00000"))


@pytest.mark.slow
def test_thumbnails_are_rendered_by_workers_and_broken_robots_show_an_error(see):
    page = see("?gallery=robots")
    page.locator(".card").first.wait_for()
    page.wait_for_selector(".card:has-text('some-arm') img")
    page.wait_for_selector(".card:has-text('broken') .tag.error")
    title = page.locator(".card", has_text="broken").first.get_attribute("title")
    assert "no link 'lost'" in title or "lost" in title


@pytest.mark.slow
def test_controls_have_names_and_the_space_bar_ticks_a_card(see):
    page = see("?gallery=robots/prims")
    card = page.locator("a.card").nth(1)
    card.wait_for()
    page.get_by_role("textbox", name="Search", exact=True).wait_for()
    page.get_by_role("heading", level=1, name="robots/prims").wait_for(state="attached")
    card.focus()
    page.keyboard.press("Space")
    box = page.get_by_role("checkbox", name="choose robots/prims/prims-000001")
    page.wait_for_url(re.compile("chosen=robots/prims/prims-000001"))
    assert box.is_checked()
    page.keyboard.press("Tab")  # to the next card, not to the box
    assert page.evaluate("document.activeElement.className") == "card"
    assert page.failures == []


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0.7..1", (0.7, 1.0)),
        ("0..1", (0.5, 1.0)),
        ("1..inf", (1.0, 1.5)),
        ("1.5..9", (1.5, 1.5)),
    ],
)
def test_a_range_is_clipped_to_the_values_of_the_robots(text, expected):
    assert parse_range("reach", text, (0.5, 1.5)) == expected


@pytest.mark.parametrize(
    ("text", "limits", "message"),
    [
        ("5..9", (0.5, 1.5), r"reach=5\.\.9 was left out; expected LOW\.\.HIGH that overlaps"),
        ("0..0.2", (0.5, 0.5), r"overlaps 0\.5 m"),
        ("1.2..0.8", (0.5, 1.5), r"overlaps 0\.5 to 1\.5 m"),
        ("nan..1", (0.5, 1.5), "was left out"),
        ("0.7..nan", (0.5, 1.5), "was left out"),
        ("much", (0.5, 1.5), "was left out"),
        ("0..1", None, "no robot here has a known reach"),
    ],
)
def test_a_range_that_cannot_be_used_is_refused(text, limits, message):
    with pytest.raises(AddressError, match=message):
        parse_range("reach", text, limits)


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("reach=50..90", "reach=50..90 was left out; expected LOW..HIGH that overlaps"),
        ("sort=colour", "sort=colour was left out; expected order, -order, name"),
        ("findings=some", "findings=some was left out; expected all, with, without"),
        ("role=train", "role=train was left out; expected all"),
    ],
)
def test_a_page_says_which_value_of_its_address_it_leaves_out(shared_viewer, query, message):
    with PlainClient(shared_viewer.port, f"?gallery=robots/prims&{query}") as client:
        client.shows(message)
        client.shows("30 robots · page 1 of 2")


def test_a_page_number_beyond_the_last_is_that_of_the_last(shared_viewer):
    with PlainClient(shared_viewer.port, "?gallery=robots/prims&n=9") as client:
        client.shows("30 robots · page 2 of 2")


def test_an_empty_gallery_says_why(shared_viewer):
    query = "?gallery=robots/prims&search=lost&findings=without"
    with PlainClient(shared_viewer.port, query) as client:
        client.shows("No robot passes the filter")
        client.shows("0 of 30 robots")


@pytest.fixture
def population(folder, files):
    uris = [f"robots/prims/prims-{i:06d}" for i in range(6)] + ["robots/some-arm"]
    robots = [read_robot_uri(uri, files) for uri in uris]
    bounds = [np.array(robot_bounds(robot)) for robot in robots]
    rows = [Row(uri, uri, order=i) for i, uri in enumerate(uris)]
    return make_population([ReadRobot(*each) for each in zip(rows, robots, bounds, strict=True)])


def test_poses_of_all_robots_equal_those_of_each(population):
    q = np.random.default_rng(0).uniform(population.lower, population.upper)
    poses, instances = shape_poses(population, q), population.instances
    for i, robot in enumerate(population.robots):
        T_root_link = forward_kinematics(robot, q[i, : robot.dof])
        mine = instances.robot == i
        expected = T_root_link[instances.link[mine]] @ instances.T_link_shape[mine]
        np.testing.assert_allclose(poses[mine], expected, atol=1e-5)


def test_large_meshes_are_simplified_although_their_arrays_are_read_only():
    links = robot_of("arm=panda ee=none").links
    shapes = [shape.geometry for link in links for shape in link.visuals]
    large = next(shape for shape in shapes if len(load_mesh(shape).faces) > populations.MAX_FACES)
    for array in (load_mesh(large).vertices, load_mesh(large).faces):
        array.flags.writeable = False
    assert len(populations.surface(large)[1]) <= populations.MAX_FACES


def test_a_joint_moves_in_every_robot_by_the_same_share(population):
    q = populations.move_joints(population, population.home, {1: 1.0, 2: 0.25})
    for i, robot in enumerate(population.robots):
        expected, (low, high) = np.array(robot.home), joint_limits(robot).T
        for k, share in zip(numbered_joints(robot), (1.0, 0.25), strict=False):
            expected[k] = low[k] + share * (high[k] - low[k])
        np.testing.assert_allclose(q[i, : robot.dof], expected)
    still = populations.move_joints(population, population.home, {})
    np.testing.assert_array_equal(still, population.home)


ARM = arm()


def plain(sizes, reaches):
    """Return a population of robots without shapes that take boxes (n, 3) [m] on the ground."""
    rows = [Row(f"{i}", f"{i}", reach=reach, order=i) for i, reach in enumerate(reaches)]
    bounds = [np.array([np.zeros(3), size]) for size in sizes]
    return make_population([ReadRobot(row, ARM, b) for row, b in zip(rows, bounds, strict=True)])


def test_rows_are_sorted_and_labelled_by_their_first_robot():
    positions, labels = populations.arrange(plain(np.ones((4, 3)), (3, 1, None, 2)), "reach")
    assert np.lexsort((positions[:, 0], -positions[:, 1])).tolist() == [1, 3, 0, 2]
    assert [text for text, _ in labels] == ["1 m", "3 m"]


def test_robots_in_rows_take_their_own_width_so_that_a_large_one_does_not_spread_the_others():
    size = np.tile([0.3, 0.1, 0.2], (300, 1))
    size[::50] = [3.0, 0.1, 0.2]
    places, labels = populations.arrange(plain(size, [None] * len(size)))
    assert labels == []
    left, right = places[:, 0], places[:, 0] + size[:, 0]
    for y in np.unique(places[:, 1]):
        row = places[:, 1] == y
        assert (left[row][1:] > right[row][:-1]).all()
    assert np.ptp(left) * np.ptp(places[:, 1]) < 1.6 * (size[:, 0] * 0.15).sum()


def test_a_camera_has_all_points_in_its_picture_and_touches_the_strictest_sides():
    points = np.random.default_rng(0).normal(size=(100, 3))
    tangents = np.array([0.5, 0.3])
    camera = fit_camera(points, tangents)
    offset = points - camera
    share = offset[:, :2] / (tangents * offset[:, 2:])
    assert np.abs(share).max() == pytest.approx(1)
    low, high = share.min(axis=0), share.max(axis=0)
    strictest = int(np.argmax(high - low))
    assert (low[strictest], high[strictest]) == pytest.approx((-1, 1))


def test_points_are_projected_to_the_picture():
    down = SimpleNamespace(position=np.array([0, 0, 5.0]), wxyz=np.array([0, 1.0, 0, 0]))
    down.fov, down.aspect = 2 * np.arctan(0.5), 1.5  # 5 m high, 7.5 m wide
    points, depth = project_points(down, np.array([[0, 0, 0], [1.5, 0, 0], [0, 1, 0]]))
    np.testing.assert_allclose(points, [(0.5, 0.5), (0.7, 0.5), (0.5, 0.3)])
    np.testing.assert_allclose(depth, 5)


def test_selections_survive_the_address():
    selected = np.array([True, True, True, False, False, True, False])
    assert format_selection(selected) == "0-2,5"
    np.testing.assert_array_equal(parse_selection("0-2,5", 7), selected)
    assert not parse_selection("", 7).any()
    assert parse_selection("5-99,x,3-", 7).tolist() == [False] * 5 + [True] * 2
    assert format_selection(np.zeros(3, bool)) == ""


def test_the_text_of_a_selection_has_links_and_facts():
    one = Row("<img>", "x", reach=0.5, mass=2.0, dof=3, findings=("axis",))
    text = selection_text([one])
    assert '<a href="?robot=x">&lt;img&gt;</a> 3 DoF · 0.50 m · 2 kg axis' in text
    many = selection_text([one, Row("b", "y", reach=0.7)] + 5 * [one])
    assert "7 selected" in many
    assert "..." in many


def test_folders_and_splits_are_populations(files):
    assert len(find_source("robots/prims", files).rows) == 30
    split = "extrapolation/primitives/reach"
    assert len(find_source(split, files).rows) == 12


def test_broken_robots_are_reported_with_their_reason(files):
    rows = find_source("robots", files).rows
    results = read_robots(rows, files)
    read = {result.row.name: result for result in results if isinstance(result, ReadRobot)}
    ((name, error),) = [result for result in results if not isinstance(result, ReadRobot)]
    assert name == "broken"
    assert "lost" in error
    assert read["some-arm"].row.reach is not None


@pytest.mark.slow
def test_a_large_population_says_that_it_has_no_shadows(shared_viewer, monkeypatch):
    for module in (populations, population_page):
        monkeypatch.setattr(module, "MAX_SHADOWS", 10)
    with PlainClient(shared_viewer.port, "?population=robots/prims") as client:
        client.shows("without shadows: more than 10 robots")
        batches = [m for m in client.messages if m["type"] == "BatchedMeshesMessage"]
        assert batches
        assert not any(message["props"]["cast_shadow"] for message in batches)


def test_clicks_rectangles_and_buttons_select_robots(viewer):
    on = viewer()
    query = "?population=robots/prims&arrange=reach&joint1=0.25&select=2,4-5"
    with PlainClient(on.port, query) as client:
        client.shows("3 selected")
        client.until(lambda: client.addresses[-1] == (0, query))
        batches = client.until(
            lambda: [m for m in client.messages if m["type"] == "BatchedMeshesMessage"]
        )
        click = click_on(batches[0], instance_index=0)
        for index in (-1, 10**6, None):
            client.send({**click, "instance_index": index})
        client.send(click)
        client.shows("1 selected")
        client.shows("joint1=0.25&select=0")
        last = len(nodes(on)[batches[0]["name"]].batched_positions) - 1
        client.send({**click, "instance_index": last, "modifier": "shift"})
        client.shows("2 selected")
        client.change(client.control("Button", "Choose"))
        client.shows("2 chosen")
        client.change(client.control("Button", "Home"))
        client.until(lambda: "joint1" not in client.addresses[-1][1])
        whole = {"event_type": "rect-select", "screen_pos": [[-99.0, -99.0], [99.0, 99.0]]}
        rays = {"modifier": "shift", "ray_origin": None, "ray_direction": None}
        client.send({"type": "ScenePointerMessage", **whole, **rays})
        client.shows("30 selected")
        client.change(client.control("ButtonGroup", "Select"), "none")
        client.until(lambda: "select" not in client.addresses[-1][1])
        client.change(client.control("Button", "Choose"))
        client.shows("no robot is selected: drag a rectangle")


LIBRARY = default_library()


def robot_of(words):
    derivation, name = parse_words(words.split(), LIBRARY)
    return compose(derivation, LIBRARY, name)


def test_joints_on_the_path_to_the_tool_are_numbered_or_else_all():
    assert numbered_joints(arm()) == (0, 1, 2)
    assert numbered_joints(replace(arm(), frames=())) == (0, 1, 2, 3)


def test_robot_compared_with_itself_is_identical():
    robots = [robot_of("base=planar ee=cube"), robot_of("base=gantry ee=plane")]
    similarity = compare_robots(robots, LIBRARY.folders)
    assert similarity["cosine"].diagonal() == pytest.approx([1, 1])
    assert similarity["tree"].diagonal() == pytest.approx([0, 0])
    assert similarity["tree"][0, 1] > 0
    table = similarity_table(["<a>", "b"], similarity)
    assert "&lt;a&gt; and b" in table


def test_compared_robots_stand_in_a_row_and_positions_are_clipped_or_left_out(viewer):
    on = viewer()
    query = "?compare=robots/some-arm&compare=robots/prims/prims-000001"
    with PlainClient(on.port, f"{query}&joint1=-3&joint2=x&joint3=nan&lost=1") as client:
        client.shows("some-arm and prims-000001")
        client.until(lambda: client.addresses[-1] == (0, f"{query}&joint1=0"))
        labels = [nodes(on)[f"/labels/{i}"] for i in range(2)]
        assert [label.text for label in labels] == ["some-arm", "prims-000001"]
        assert labels[0].position[1] == labels[1].position[1]
        client.change(client.control("Slider", "joint 2"), 0.75)
        client.shows("joint1=0&joint2=0.75")
        client.change(client.control("Button", "Home"))
        client.until(lambda: client.addresses[-1] == (0, query))


def test_figures_link_to_robots_and_escape_names():
    rows = [Row("<a>", "x y", role="train"), Row("b", "z", role="test")]
    text = map_svg(np.array([[0.0, 0.0], [1.0, 0.5]]), rows, {"z": "data:,"})
    assert text.count("<image") == 1
    assert 'href="?robot=x%20y"' in text
    assert "&lt;a&gt;" in text
    assert "<a>" not in text.replace("<a href", "")


@pytest.mark.parametrize(
    "points", [np.random.default_rng(0).normal(size=(60, 2)), np.zeros((60, 2))]
)
def test_pictures_of_a_map_do_not_cover_each_other(points):
    text = map_svg(points, [Row(str(i), str(i), role="test") for i in range(60)], {})
    pattern = r'class="point" x="([\d.]+)" y="([\d.]+)" width="([\d.]+)" height="([\d.]+)"'
    boxes = np.array(re.findall(pattern, text), dtype=float)
    low, high = boxes[:, :2], boxes[:, :2] + boxes[:, 2:]
    overlap = np.minimum(high[:, None], high) - np.maximum(low[:, None], low)
    shared = np.maximum(overlap, 0).prod(axis=2)[~np.eye(60, dtype=bool)]
    assert len(boxes) == 60
    assert shared.max() == 0
    assert np.ptp(low, axis=0).min() > 2 * boxes[0, 2]  # they fill the map


SPLIT = "extrapolation/primitives/reach"


@pytest.mark.slow
def test_split_page_shows_both_sides_the_map_and_the_audit(see):
    page = see(f"?split={SPLIT}")
    page.get_by_text("train (10)").wait_for()
    page.get_by_text("test (2)").wait_for()
    page.wait_for_selector(".card:has-text('chain-000001') img")
    page.get_by_role("tab", name="Audit").click()
    page.get_by_role("heading", name="Findings").wait_for()
    page.get_by_role("tab", name="Map").click()
    point = page.locator("svg a", has=page.locator("title", has_text="chain-000001"))
    point.first.wait_for()
    page.locator("svg image").nth(11).wait_for()
    point.first.locator("image").click()
    page.wait_for_url(re.compile(r"robot=split:.*chain-000001"))
    page.get_by_text("chain-000001").first.wait_for()
    assert page.failures == []


def test_robots_of_a_set_become_members(folder, files, monkeypatch):
    monkeypatch.chdir(folder)
    rows = [Row("", f"robots/prims/prims-{i:06d}", "prims") for i in range(4)]
    members = [make_member("push", False, files, row) for row in rows]
    path = save_split("mine/prims", "interpolation", members[:3], members[3:], files)
    split = read_split(path)
    assert split.train == tuple(members[:3])
    assert {member.task for member in split.train} == {"push"}
    (member, *_) = read_split(find_split(SPLIT)).test
    row = Row(member.name, member_uri(SPLIT, "test", member))
    assert make_member("push", False, files, row) == replace(member, task="push")


def test_empty_sides_and_invalid_names_are_rejected(files):
    with pytest.raises(BenchmarkError, match="0 train and 0 test"):
        save_split("mine", "interpolation", [], [], files)
    with pytest.raises(BenchmarkError, match="use letters"):
        save_split("../mine", "interpolation", [], [], files)
