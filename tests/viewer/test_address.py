"""Addresses of pages are parsed and formatted consistently, and hold packed texts."""

import base64
import random
import string
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from morphgen.viewer.app.address import (
    MAX_PACKED,
    MAX_UNPACKED,
    PAGES,
    Address,
    AddressError,
    load_page,
    pack_text,
    parse_address,
    unpack_text,
)

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


@given(st.text(max_size=300))
def test_text_is_restored_from_a_url(text):
    address = Address("compose", ("chain",), {"text": pack_text(text)})
    assert "%" not in address.query
    assert unpack_text(parse_address(address.query).state["text"]) == text


def test_a_text_that_is_too_long_is_rejected():
    letters = random.Random(0).choices(string.printable, k=2 * MAX_PACKED)
    with pytest.raises(AddressError, match=f"too long for the page.*at most {MAX_PACKED}"):
        pack_text("".join(letters))
    with pytest.raises(AddressError, match=f"at most {MAX_PACKED} are read"):
        unpack_text("A" * (MAX_PACKED + 1))


def letters_of(data):
    return base64.urlsafe_b64encode(data).decode().rstrip("=")


@pytest.mark.parametrize(
    ("content", "why"),
    [
        ("!!", "no readable text"),
        (letters_of(b"no zlib"), "no readable text"),
        (letters_of(zlib.compress(b"a text")[:-3]), "an incomplete text"),
        (letters_of(zlib.compress(b"\xff\xfe")), "no readable text"),
        (letters_of(zlib.compress(b"a" * (MAX_UNPACKED + 1))), f"more than {MAX_UNPACKED} bytes"),
    ],
    ids=["letters", "zlib", "cut", "utf-8", "bomb"],
)
def test_an_invalid_packed_text_is_rejected(content, why):
    with pytest.raises(AddressError, match=why):
        unpack_text(content)
