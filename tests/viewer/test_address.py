"""Viewer URLs are parsed and formatted consistently."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from morphgen.viewer.app.address import PAGES, Address, AddressError, load_page, parse_address

KEYS = st.from_regex(r"[a-z][a-z_ ]{0,8}", fullmatch=True)
TEXTS = st.text(st.characters(codec="utf-8"), max_size=20)


@pytest.mark.slow
@given(
    st.sampled_from(tuple(PAGES)),
    st.lists(TEXTS, min_size=1, max_size=4),
    st.dictionaries(KEYS.filter(lambda key: key not in PAGES), TEXTS.filter(bool)),
)
def test_formatted_url_is_parsed_back(page, subjects, state):
    address = Address(page, tuple(subjects), state)
    assert parse_address(address.query) == address


@given(st.lists(TEXTS, max_size=3), st.dictionaries(st.just("seed"), TEXTS.filter(bool)))
def test_robots_of_a_rollout_url_keep_their_order(robots, state):
    address = Address("play", ("reach",), state, tuple(robots))
    assert parse_address(address.query) == address


def test_robot_uri_stays_readable():
    address = Address("robot", ("words:arm=ur5 ee=plane",), {"q": "0.1,-2"})
    assert address.query == "?robot=words:arm=ur5%20ee=plane&q=0.1,-2"


def test_empty_query_is_the_first_page():
    assert parse_address("") is None
    assert parse_address("?") is None


@pytest.mark.parametrize(
    ("query", "why"),
    [
        ("?robbot=a", "did you mean 'robot'"),
        ("?robot=a&split=b", "two pages: robot and split"),
        ("?play=reach&robot=a&split=b", "two pages: split and play"),
    ],
)
def test_invalid_url_is_rejected(query, why):
    with pytest.raises(AddressError, match=why):
        parse_address(query)


def test_default_state_is_omitted():
    address = Address("gallery", ("robots",), {"n": "2", "sort": "name"})
    assert address.with_state(n="", sort="-mass").query == "?gallery=robots&sort=-mass"


@pytest.mark.parametrize("page", PAGES)
def test_every_registered_page_can_be_loaded(page):
    assert callable(load_page(page))
