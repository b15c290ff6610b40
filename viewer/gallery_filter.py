"""The filter of a gallery: its controls, their values in the address, and what they exclude."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

from morphgen.viewer import figures, markup, parallel_coordinates, robot_rows
from morphgen.viewer.address import AddressError
from morphgen.viewer.gallery_cards import SCALES, Gallery
from morphgen.viewer.population_layout import UNITS

FILTERS = ("search", "category", "role", "findings", *robot_rows.NUMBERS)
"""Keys of the filter's controls, in the address, too."""
_ALL = "all"
_LABELS = {"dof": "DoF", "links": "Links", "reach": "Reach (m)", "mass": "Mass (kg)"}
_COUNTS = ("dof", "links")
"""Facts that are integers."""
_SORT_KEYS = {
    label: key
    for name in robot_rows.SORTS
    for label, key in ((name, name), (f"{name}, largest first", f"-{name}"))
}
"""Keys of ``sort_rows`` by their label in the dropdown."""
_ROUNDING = 1e-9
"""Browsers round the ends of a range."""


def add_filter(gallery: Gallery) -> None:
    """Add the controls in the state that the address gives; note values that it cannot have."""
    gui, state = gallery.session.client.gui, gallery.session.address.state
    gallery.controls["search"] = gui.add_text("Search", state.get("search", ""))
    scales = (gallery.scale, *(name for name in SCALES if name != gallery.scale))
    _add_dropdown(gallery, "scale", "Scale", dict(zip(scales, scales, strict=True)))
    _add_dropdown(gallery, "sort", "Sort by", _SORT_KEYS)
    is_filtered = not state.keys().isdisjoint({*FILTERS[1:], "size"})
    with gui.add_folder("Filter", expand_by_default=is_filtered):
        for key in ("category", "role"):
            choices = [_ALL, *robot_rows.fact_choices(gallery.rows, key)]
            _add_dropdown(gallery, key, key.capitalize(), dict(zip(choices, choices, strict=True)))
        findings = (_ALL, "with", "without")
        _add_dropdown(gallery, "findings", "Findings", dict(zip(findings, findings, strict=True)))
        for fact in robot_rows.NUMBERS:
            _add_range(gallery, fact)
        sizes = list(map(str, robot_rows.PAGE_SIZES))
        _add_dropdown(gallery, "size", "On a page", dict(zip(sizes, sizes, strict=True)))


def passing_rows(gallery: Gallery) -> list[robot_rows.Row]:
    """Return the robots that pass the filter, on all pages, in the order of the set."""
    return robot_rows.sort_rows(filter(_current_filter(gallery).passes, gallery.rows), "order")


def shown_rows(gallery: Gallery) -> list[robot_rows.Row]:
    """Return the robots that pass the filter, on all pages, in the order that is shown."""
    return robot_rows.sort_rows(passing_rows(gallery), control_state(gallery)["sort"] or "order")


def control_state(gallery: Gallery) -> dict[str, str]:
    """Return the values of the controls for the address; empty texts for the first choices."""
    state = dict.fromkeys((*FILTERS, "scale", "sort", "size"), "")
    for key, control in gallery.controls.items():
        if key in robot_rows.NUMBERS:
            state[key] = _range_text(gallery, key)
        elif key == "search":
            state[key] = control.value
        else:
            is_first = control.value == control.options[0]
            value = _SORT_KEYS[control.value] if key == "sort" else control.value
            state[key] = "" if is_first else value
    return state


def clear_filter(gallery: Gallery, key: str) -> None:
    """Let every robot pass a condition of the filter.

    Args:
        gallery: The gallery.
        key: One of ``FILTERS``, or empty for all of them.
    """
    for name, control in gallery.controls.items():
        if name not in FILTERS or key not in ("", name):
            continue
        if name in robot_rows.NUMBERS:
            control.value = (control.min, control.max)
        else:
            control.value = "" if name == "search" else _ALL


def empty_text(gallery: Gallery) -> str:
    """Return what excludes all robots, as HTML with links that clear each condition."""
    lines = []
    for key, value in control_state(gallery).items():
        if key not in FILTERS or not value:
            continue
        alone = sum(map(_filter({key: value}).passes, gallery.rows))
        count = "no robot" if not alone else "1 robot" if alone == 1 else f"{alone} robots"
        name = _LABELS.get(key, key)
        clear = f'<a data-do="clear filter" data-value="{key}">clear</a>'
        lines.append((escape(f"{name}: {value}"), f"{count} of {len(gallery.rows)}", clear))
    table = markup.table(("condition", "passed by", ""), lines)
    clear = '<a data-do="clear filter" data-value="">clear all</a>'
    return f"<h3>No robot passes the filter</h3>{table}<p>{clear}</p>"


def show_histograms(gallery: Gallery) -> None:
    """Show how many robots have each value of a fact; those that the slider lets pass stand out."""
    for fact, handle in gallery.histograms.items():
        values = [float(v) for row in gallery.rows if (v := getattr(row, fact)) is not None]
        control = gallery.controls[fact]
        low, high = control.value
        svg = figures.histogram_svg(values, (control.min, control.max), (low, high))
        handle.content = markup.framed(svg)


def show_coordinates(gallery: Gallery) -> None:
    """Show the facts that vary as parallel coordinates."""
    if gallery.coordinates is None:
        return
    passing = {row.uri for row in passing_rows(gallery)}
    svg = parallel_coordinates.parallel_svg(
        gallery.rows, _axes(gallery), passing, gallery.panel_width
    )
    hint = (
        f"{len(passing)} of {len(gallery.rows)} robots pass the filter. Drag along an axis to "
        "choose a range, click it to clear the range, click a line to open its robot."
    )
    gallery.coordinates.content = markup.framed(markup.dim(hint), svg)


def brush(gallery: Gallery, text: str) -> None:
    """Set a range as the pointer has chosen it at an axis; see ``parse_brush``.

    Raises:
        AddressError: If the text is invalid.
    """
    fact, (low, high) = parallel_coordinates.parse_brush(text, _axes(gallery))
    control = gallery.controls[fact]
    low, high = (round(value / control.step) * control.step for value in (low, high))
    control.value = (max(low, control.min), min(high, control.max))


def parse_range(
    fact: str, text: str, limits: tuple[float, float] | None
) -> tuple[float, float] | None:
    """Parse ``LOW..HIGH`` of an address.

    Args:
        fact: The fact, one of ``NUMBERS``.
        text: The text; if empty, the limits are returned.
        limits: Smallest and largest value of the robots; None if the fact is unknown of all.

    Raises:
        AddressError: If the text is no range, or no value of a robot can be in it.
    """
    if not text:
        return limits
    first, dots, last = text.partition("..")
    try:
        low, high = float(first), float(last if dots else "")
    except ValueError:
        low, high = 1.0, 0.0
    where = f"{fact}={text[:40]}"
    if not low <= high:
        raise AddressError(f"{where} is no range, so it was left out; expected LOW..HIGH")
    if limits is None:
        raise AddressError(f"{where} was left out: no robot here has a known {fact}")
    if low > limits[1] + _ROUNDING or high < limits[0] - _ROUNDING:
        ends = " to ".join(dict.fromkeys(f"{end:.4g}" for end in limits))
        raise AddressError(
            f"{where} excludes every robot, so it was left out: they have {ends} {UNITS[fact]}"
        )
    return max(low, limits[0]), min(high, limits[1])


def _axes(gallery: Gallery) -> dict[str, parallel_coordinates.Axis]:
    """Return the axes of the facts that have a slider, with the range of the slider."""
    return {
        fact: parallel_coordinates.Axis(
            _LABELS[fact],
            (control.min, control.max),
            fact in _COUNTS,
            tuple(control.value) if _range_text(gallery, fact) else None,
        )
        for fact, control in gallery.controls.items()
        if fact in robot_rows.NUMBERS
    }


def _current_filter(gallery: Gallery) -> robot_rows.Filter:
    """Return the filter that the controls are set to."""
    return _filter(control_state(gallery))


def _filter(state: Mapping[str, str]) -> robot_rows.Filter:
    """Return the filter of values of the address."""
    ranges = {}
    for fact in robot_rows.NUMBERS:
        if text := state.get(fact):
            low, _, high = text.partition("..")
            ranges[fact] = (float(low) - _ROUNDING, float(high) + _ROUNDING)
    search, category, role, findings = (state.get(key, "") for key in FILTERS[:4])
    return robot_rows.Filter(search, category, role, findings, ranges)


def _add_dropdown(gallery: Gallery, key: str, label: str, keys: Mapping[str, str]) -> None:
    """Add a dropdown if there is a choice.

    Args:
        gallery: The gallery.
        key: Key of the control.
        label: Its label.
        keys: Values in the address by their labels.
    """
    value = gallery.session.address.state.get(key, "")
    labels = {key: label for label, key in keys.items()}
    if value and value not in labels:
        valid = _listed(list(labels))
        gallery.notices.append(f"{key}={value[:40]} was left out; expected {valid}")
    if len(keys) > 1:
        initial = labels.get(value, next(iter(keys)))
        gallery.controls[key] = gallery.session.client.gui.add_dropdown(
            label, tuple(keys), initial_value=initial
        )


def _listed(values: Sequence[str]) -> str:
    return ", ".join(values[:12]) + (", ..." if len(values) > 12 else "")


def _add_range(gallery: Gallery, fact: str) -> None:
    """Add a slider with two ends for a fact that varies."""
    limits = robot_rows.fact_range(gallery.rows, fact)
    try:
        ends = parse_range(fact, gallery.session.address.state.get(fact, ""), limits)
    except AddressError as error:
        gallery.notices.append(str(error))
        ends = limits
    if limits is None or ends is None or limits[0] == limits[1]:
        return
    step = 1.0 if fact in _COUNTS else 0.001
    low, high = limits[0] - limits[0] % step, limits[1] + (-limits[1]) % step
    initial = (low if ends[0] == limits[0] else ends[0], high if ends[1] == limits[1] else ends[1])
    gui = gallery.session.client.gui
    gallery.histograms[fact] = gui.add_html("")
    gallery.controls[fact] = gui.add_multi_slider(_LABELS[fact], low, high, step, initial)


def _range_text(gallery: Gallery, fact: str) -> str:
    """Return a range slider's value for the address; empty if it lets every known value pass."""
    low, high = gallery.controls[fact].value
    limits = robot_rows.fact_range(gallery.rows, fact)
    if limits is None or (low <= limits[0] and high >= limits[1]):
        return ""
    return f"{low:g}..{high:g}"
