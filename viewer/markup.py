"""HTML that several pages share; every text that comes from outside is escaped."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from html import escape

from morphgen.model.findings import Finding
from morphgen.viewer.app.address import Address

SELECTED = "#00bedc"
"""Colour of what belongs to the selected link: ``scene_selection.SELECTED``."""
STYLE = """<style>
.mg{font-size:13px;line-height:1.45;padding:0 .8em .3em .8em;color:inherit}
.mg a{color:#1864ab;text-decoration:none}.mg a:hover{text-decoration:underline}
.mg h2{font-size:17px;margin:.8em 0 .3em 0;font-weight:600}
.mg a.button,.mg a.button:hover{display:inline-block;background:#1864ab;color:#fff!important;
padding:5px 14px;border-radius:5px;font-weight:600;text-decoration:none}
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
.mg .cell{position:relative}.mg .cell .choose{position:absolute;top:6px;left:6px;opacity:.35}
.mg .cell:hover .choose,.mg .choose:has(:checked){opacity:1}
.mg .choose{cursor:pointer;white-space:nowrap}
.mg .choose input{margin:0;vertical-align:-2px;width:16px;height:16px;
accent-color:#1864ab;cursor:pointer}
.mg .cell:has(:checked) a.card{border-color:#1864ab;box-shadow:0 0 0 1px #1864ab}
.mg a.card{display:block;border:1px solid #8883;border-radius:6px;overflow:hidden;color:inherit;
background:#fff}
.mg a.card:hover{border-color:#339af0;text-decoration:none;box-shadow:0 1px 6px #0002}
.mg .picture{overflow:hidden;background:#fff}.mg .picture img{transform-origin:50% 96%}
.mg .card img,.mg .card .empty{display:block;width:100%;aspect-ratio:4/3;object-fit:cover;
background:#f1f3f5}
.mg .card .empty{display:flex;align-items:center;justify-content:center;color:#adb5bd;
font-size:11px}
.mg .card .text{padding:5px 8px 7px 8px}.mg .card .name{font-weight:600;overflow-wrap:anywhere}
.mg .selected{border-left:4px solid #00bedc;padding-left:8px;background:#00bedc18;
margin:4px 0 8px 0}
.mg .selected th{color:inherit}
.mg .scale{height:10px;border-radius:2px;margin-top:4px}
.mg .ends{display:flex;justify-content:space-between;font-size:11.5px}
.mg .offspring{display:grid;grid-template-columns:repeat(3,1fr);gap:8px;margin-top:.5em}
.mg .offspring>div{border:1px solid #8883;border-radius:6px;padding:5px 8px;overflow-wrap:anywhere}
.mg [data-do]{cursor:pointer}
.mg .dim{color:#868e96;font-size:11.5px}.mg .bar{height:3px;background:#8882;margin-top:3px}
.mg .bar div{height:3px;background:#339af0}
[data-mantine-color-scheme="dark"] .mg a{color:#74c0fc}
[data-mantine-color-scheme="dark"] .mg a.card{background:#2c3036;color:inherit}
[data-mantine-color-scheme="dark"] .mg .card .picture{background:#98a1ab;isolation:isolate}
[data-mantine-color-scheme="dark"] .mg .card .empty{background:#343a40}
[data-mantine-color-scheme="dark"] .mg .card img{background:none;mix-blend-mode:multiply}
</style>"""


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
    box = f'<input type="checkbox" data-choose="{escape(uri)}">'
    return f'<label class="choose" title="choose">{box} {escape(label)}</label>'


def breadcrumbs(*steps: tuple[str, Address | None]) -> str:
    """Return the path from the library to a page; steps without address are plain text."""
    library = ("Library", Address("library"))
    parts = [
        link(address, text) if address else escape(text) for text, address in (library, *steps)
    ]
    return framed(f'<div class="crumbs">{" / ".join(parts)}</div>')


def tag(text: str, style: str = "") -> str:
    """Return a word in a coloured box; the style is a class of ``STYLE``, such as ``error``."""
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
