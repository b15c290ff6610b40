"""Texts that fit into an address come back from it; others are refused."""

import base64
import random
import string
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from morphgen.viewer.address import Address, AddressError, parse_address
from morphgen.viewer.packed_text import LARGEST, LONGEST, packed, unpacked


@given(st.text(max_size=300))
def test_a_text_comes_back_from_an_address(text):
    address = Address("compose", ("chain",), {"text": packed(text)})
    assert "%" not in address.query
    assert unpacked(parse_address(address.query).state["text"]) == text


def test_a_text_that_is_too_long_is_refused():
    letters = random.Random(0).choices(string.printable, k=2 * LONGEST)
    with pytest.raises(AddressError, match=f"too long for the page's address.*at most {LONGEST}"):
        packed("".join(letters))
    with pytest.raises(AddressError, match=f"at most {LONGEST} are read"):
        unpacked("A" * (LONGEST + 1))


def letters_of(data):
    return base64.urlsafe_b64encode(data).decode().rstrip("=")


@pytest.mark.parametrize(
    ("content", "why"),
    [
        ("!!", "no text that can be read"),
        (letters_of(b"no zlib"), "no text that can be read"),
        (letters_of(zlib.compress(b"a text")[:-3]), "no whole text"),
        (letters_of(zlib.compress(b"\xff\xfe")), "no text that can be read"),
        (letters_of(zlib.compress(b"a" * (LARGEST + 1))), f"more than {LARGEST} bytes"),
    ],
    ids=["letters", "zlib", "cut", "utf-8", "bomb"],
)
def test_what_is_no_packed_text_is_refused(content, why):
    with pytest.raises(AddressError, match=why):
        unpacked(content)
