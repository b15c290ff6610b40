"""Pieces of HTML that several pages share; every text that comes from outside is escaped."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from html import escape

from morphgen.model.findings import Finding
from morphgen.viewer.address import Address

STYLE = """<style>
.mg{font-size:13px;line-height:1.45;padding:0 .8em .3em .8em;color:inherit}
.mg a{color:#1864ab;text-decoration:none}.mg a:hover{text-decoration:underline}
.mg h3{font-size:13px;margin:.9em 0 .35em 0;font-weight:600}
.mg table{border-collapse:collapse;width:100%;font-size:12px}
.mg td,.mg th{padding:2px 8px 2px 0;text-align:left;vertical-align:top;
border-bottom:1px solid #8882}
.mg th{font-weight:600;color:#868e96}
.mg td.n,.mg th.n{text-align:right;font-variant-numeric:tabular-nums}
.mg code,.mg pre{font-family:ui-monospace,monospace;font-size:11.5px;background:#8881;
border-radius:3px}
.mg code{padding:0 3px}.mg pre{padding:6px 8px;overflow-x:auto;white-space:pre-wrap;margin:.3em 0;
user-select:all}
.mg .crumbs{color:#868e96;font-size:12.5px;padding-top:.5em}
.mg .tag{display:inline-block;border-radius:3px;padding:0 5px;font-size:11px;background:#8882;
margin-right:3px}
.mg .train{background:#d0ebff;color:#1864ab}.mg .test{background:#ffe8cc;color:#d9480f}
.mg .error{background:#ffe3e3;color:#c92a2a}.mg .warning{background:#fff3bf;color:#e67700}
.mg .info{background:#e7f5ff;color:#1971c2}
.mg .grid{display:grid;grid-template-columns:repeat(auto-fill,minmax(172px,1fr));gap:10px}
.mg .columns{display:flex;gap:20px;align-items:flex-start}.mg .columns>div{flex:1}
.mg a.card{display:block;border:1px solid #8883;border-radius:6px;overflow:hidden;color:inherit;
background:#fff}
.mg a.card:hover{border-color:#339af0;text-decoration:none;box-shadow:0 1px 6px #0002}
.mg .card img,.mg .card .empty{display:block;width:100%;aspect-ratio:4/3;object-fit:cover;
background:#f1f3f5}
.mg .card .empty{display:flex;align-items:center;justify-content:center;color:#adb5bd;
font-size:11px}
.mg .card .text{padding:5px 8px 7px 8px}.mg .card .name{font-weight:600;overflow-wrap:anywhere}
.mg .dim{color:#868e96;font-size:11.5px}.mg .bar{height:3px;background:#8882;margin-top:3px}
.mg .bar div{height:3px;background:#339af0}
</style>"""


def framed(*content: str) -> str:
    """HTML in the style of the pages."""
    return f'<div class="mg">{"".join(content)}</div>'


def link(address: Address, text: str) -> str:
    """A link to another page."""
    return f'<a href="{escape(address.query)}">{escape(text)}</a>'


def crumbs(*steps: tuple[str, Address | None]) -> str:
    """The way from the library to a page; steps without address are no links."""
    home = ("Library", Address("library"))
    parts = [link(where, text) if where else escape(text) for text, where in (home, *steps)]
    return framed(f'<div class="crumbs">{" / ".join(parts)}</div>')


def tag(text: str, kind: str = "") -> str:
    """A word in a coloured box."""
    return f'<span class="tag {escape(kind)}">{escape(text)}</span>'


def code(text: str) -> str:
    """Text to copy: a click marks all of it."""
    return f"<pre>{escape(text)}</pre>"


def table(header: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """A table of cells that are HTML already.

    Args:
        header: Texts of the first row.
        rows: Cells.
        numbers: Columns that are aligned to the right.
    """
    right = ['class="n"' if i in numbers else "" for i in range(len(header))]
    head = "".join(f"<th {r}>{escape(text)}</th>" for r, text in zip(right, header, strict=True))
    body = "".join(
        "<tr>"
        + "".join(f"<td {r}>{cell}</td>" for r, cell in zip(right, row, strict=True))
        + "</tr>"
        for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"


def findings_table(findings: Sequence[Finding], told: Callable[[str], str] = str) -> str:
    """Findings with what to do about them, or that there are none.

    Args:
        findings: What was found.
        told: How a text of them may be shown, see ``FileAccess.told``.
    """
    if not findings:
        return '<div class="dim">no findings</div>'
    rows = [
        (
            tag(finding.severity, finding.severity) + f"<br><code>{escape(finding.code)}</code>",
            f"<b>{escape(told(finding.where))}</b>: {escape(told(finding.why))}<br>"
            f'<span class="dim">{escape(told(finding.fix))}</span>',
        )
        for finding in findings
    ]
    return table(("", "what"), rows)


def status(text: str, share: float | None = None) -> str:
    """A line that says what is being done, with a bar; nothing if there is no text."""
    if not text:
        return ""
    bar = ""
    if share is not None:
        bar = f'<div class="bar"><div style="width:{100 * share:.0f}%"></div></div>'
    return framed(f'<div class="dim">{escape(text)}</div>{bar}')
