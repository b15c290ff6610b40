"""HTML that several pages share; every text that comes from outside is escaped."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from html import escape

from morphgen.model.findings import Finding
from morphgen.viewer.app.address import Address

SELECTED = "#00bedc"
"""Colour of what belongs to the selected link: ``scene.overlays.SELECTED``."""


def framed(*content: str) -> str:
    """Return HTML in the style of the pages."""
    return f'<div class="mg">{"".join(content)}</div>'


def dim(html: str) -> str:
    """Return HTML as a block of small grey text."""
    return f'<div class="dim">{html}</div>'


def link(address: Address, text: str) -> str:
    """Return a link to a page."""
    return f'<a href="{escape(address.query)}">{escape(text)}</a>'


def button_link(address: Address, text: str) -> str:
    """Return a link to a page that looks like a button."""
    return f'<a class="button" href="{escape(address.query)}">{escape(text)}</a>'


def choose_box(uri: str, label: str = "") -> str:
    """Return a check box that puts a robot into the tray, with a label behind it."""
    stop = "" if label else ' tabindex="-1"'  # the card around it is a stop of the Tab key
    name = f'aria-label="choose {escape(uri)}"'
    box = f'<input type="checkbox" data-choose="{escape(uri)}" {name}{stop}>'
    return f'<label class="choose" title="choose">{box} {escape(label)}</label>'


def breadcrumbs(*steps: tuple[str, Address | None]) -> str:
    """Return the path from the library to a page; steps without address are plain text."""
    library = ("Library", Address("library"))
    parts = [
        link(address, text) if address else escape(text) for text, address in (library, *steps)
    ]
    return framed(f'<div class="crumbs">{" / ".join(parts)}</div>')


def tag(text: str, style: str = "") -> str:
    """Return a word in a coloured box; its style is one of the frame, such as ``error``."""
    return f'<span class="tag {escape(style)}">{escape(text)}</span>'


def error(text: str) -> str:
    """Return an error as a framed line."""
    return framed(tag("error", "error"), f" {escape(text)}")


def code(text: str) -> str:
    """Return text to copy: a click selects all of it."""
    return f"<pre>{escape(text)}</pre>"


def command(text: str) -> str:
    """Return the block with the command that repeats a page's robot on the command line."""
    return f"<h3>The same on the command line</h3>{code(text)}"


def table(header: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """Return a table."""
    right = ['class="n"' if i in numbers else "" for i in range(len(header))]

    def row(kind: str, cells: Iterable[str]) -> str:
        line = "".join(f"<{kind} {r}>{c}</{kind}>" for r, c in zip(right, cells, strict=True))
        return f"<tr>{line}</tr>"

    body = "".join(row("td", cells) for cells in rows)
    return f"<table>{row('th', map(escape, header))}{body}</table>"


def findings_table(findings: Sequence[Finding], redact: Callable[[str], str] = str) -> str:
    """Return a table of findings and their repairs; ``redact`` as in ``FileAccess``."""
    if not findings:
        return dim("no findings")
    rows = [
        (
            tag(finding.severity, finding.severity) + f"<br><code>{escape(finding.code)}</code>",
            f"<b>{escape(redact(finding.where))}</b>: {escape(redact(finding.why))}<br>"
            f'<span class="dim">{escape(redact(finding.fix))}</span>',
        )
        for finding in findings
    ]
    return table(("", "finding"), rows)


def status(text: str, fraction: float | None = None) -> str:
    """Return the line of the current activity with a progress bar; empty without a text."""
    if not text:
        return ""
    bar = ""
    if fraction is not None:
        bar = f'<div class="bar"><div style="width:{100 * fraction:.0f}%"></div></div>'
    return framed(dim(escape(text)) + bar)
