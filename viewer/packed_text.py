"""Texts that users edited, small enough to be kept in a page's address."""

from __future__ import annotations

import base64
import binascii
import zlib

from morphgen.viewer.address import AddressError

LONGEST = 4000
"""Characters of a packed text. Some browsers and mail programs cut longer addresses off."""
LARGEST = 200_000
"""Bytes of a text that is unpacked."""


def packed(text: str) -> str:
    """A text, compressed and in letters that an address keeps as they are (base64url).

    Raises:
        AddressError: If it is too long for an address.
    """
    content = base64.urlsafe_b64encode(zlib.compress(text.encode(), 9)).decode().rstrip("=")
    if len(content) > LONGEST:
        raise AddressError(
            f"the text is too long for the page's address ({len(content)} characters packed, at "
            f"most {LONGEST}): keep it in a file"
        )
    return content


def unpacked(content: str) -> str:
    """The text that was packed.

    Raises:
        AddressError: If it is none, or too long.
    """
    if len(content) > LONGEST:
        raise AddressError(
            f"the address has a text of {len(content)} characters; at most {LONGEST} are read"
        )
    try:
        data = base64.b64decode(content + "=" * (-len(content) % 4), altchars=b"-_", validate=True)
        unpacking = zlib.decompressobj()
        text = unpacking.decompress(data, LARGEST)
        if not unpacking.eof:
            raise AddressError(
                f"the address has no whole text, or one of more than {LARGEST} bytes"
            )
        return text.decode()
    except (binascii.Error, zlib.error, ValueError) as error:
        raise AddressError(f"the address has no text that can be read: {error}") from error
