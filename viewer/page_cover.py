"""The cover that hides viser's empty page, until a page of the viewer has its content."""

from __future__ import annotations

import gzip
from functools import lru_cache

from websockets.http11 import Response

COVER_SECONDS = 20
"""Time after which the browser removes the cover itself, if the server never does [s]."""
REVEAL = 'requestAnimationFrame(() => document.getElementById("morphgen-cover")?.remove());'
"""JavaScript that removes the cover, after the content before it has been drawn."""
_COVER = f"""<div id="morphgen-cover"><style>
#root{{visibility:hidden}}
#morphgen-cover{{position:fixed;inset:0;display:flex;align-items:center;justify-content:center;
font:500 17px system-ui,sans-serif;letter-spacing:.04em;color:#868e96;background:#f1f3f5}}
@media(prefers-color-scheme:dark){{#morphgen-cover{{background:#25282d}}}}
</style><span>morphgen</span><script>
setTimeout(() => document.getElementById("morphgen-cover")?.remove(), {1000 * COVER_SECONDS});
</script></div>"""
_BEFORE = b'<div id="root">'


def cover_page(response: Response) -> None:
    """Put the cover into a response with viser's page.

    Raises:
        RuntimeError: If the installed viser has another page.
    """
    is_packed = response.headers.get("Content-Encoding") == "gzip"
    response.body = _covered(bytes(response.body), is_packed=is_packed)
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))


@lru_cache(maxsize=2)
def _covered(body: bytes, *, is_packed: bool) -> bytes:
    """Return the page with the cover; cached, because packing takes a tenth of a second."""
    page = gzip.decompress(body) if is_packed else body
    if page.count(_BEFORE) != 1:
        raise RuntimeError("this version of viser has another page; see viewer/page_cover.py")
    covered = page.replace(_BEFORE, _COVER.encode() + _BEFORE)
    return gzip.compress(covered) if is_packed else covered
