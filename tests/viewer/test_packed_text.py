"""Packing of texts into URLs, and rejection of invalid packed texts."""

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
    Address,
    AddressError,
    pack_text,
    parse_address,
    unpack_text,
)


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
