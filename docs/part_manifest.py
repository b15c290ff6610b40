"""Write the JSON schema of part manifests, and the tables of ``part-manifest.md``.

The schema follows from the records that read a manifest: their types, defaults and docstrings.

python docs/part_manifest.py
"""

from __future__ import annotations

import ast
import inspect
import json
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import fields

from morphgen.grammar.manifest import (
    REAL_ONLY,
    SCHEMA_FILE,
    TEMPLATE_ONLY,
    FrameSpec,
    Manifest,
    PackageSource,
    Parameter,
    Scaling,
)

PAGE = Path(__file__).with_name("part-manifest.md")
MARK = "<!-- The rest of this page is written by docs/part_manifest.py. -->\n"
RECORDS = {
    "FrameSpec": "Frame",
    "PackageSource": "Source",
    "Scaling": "Scaling of a link",
    "Parameter": "Parameter",
}
"""Heading of the section about each record of the schema."""


def manifest_schema() -> dict[str, Any]:
    """Return the JSON schema of a part's YAML file; ``$defs`` has one entry per record."""
    # The only type that JSON lacks is the path of the YAML file, which is no key of it.
    schema = msgspec.json.schema(Manifest, schema_hook=lambda kind: {"type": "string"})
    records: dict[str, Any] = schema["$defs"]
    for record in (Manifest, FrameSpec, PackageSource, Scaling, Parameter):
        properties = records[record.__name__]["properties"]
        texts = field_docstrings(record)
        for entry in fields(record):
            properties[entry.encode_name]["description"] = texts[entry.name]
    manifest = records["Manifest"]
    properties = manifest["properties"]
    del properties["path"]
    properties["reference"] = dict(properties["citation"])
    manifest["oneOf"] = [
        {"required": [source], "properties": dict.fromkeys(sorted(unused), False)}
        for source, unused in (("source", TEMPLATE_ONLY), ("file", REAL_ONLY))
    ]
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Part of morphgen",
        **schema,
    }


def field_docstrings(record: type[msgspec.Struct]) -> dict[str, str]:
    """Return the docstring of every field of a record, by the field's name."""
    (definition,) = ast.parse(inspect.getsource(record)).body
    assert isinstance(definition, ast.ClassDef)
    return {
        field.target.id: " ".join(str(text.value.value).replace("``", "`").split())
        for field, text in pairwise(definition.body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
    }


def page() -> str:
    """Return the page: its own text up to the mark, then the tables."""
    text, mark, _ = PAGE.read_text(encoding="utf-8").partition(MARK)
    return text + mark + "\n".join(tables())


def tables() -> Iterator[str]:
    """Yield the sections with the keys of a manifest and of the records in it."""
    records = manifest_schema()["$defs"]
    keys = list(records["Manifest"]["properties"])
    sections = {
        "Keys of every part": [k for k in keys if k not in REAL_ONLY | TEMPLATE_ONLY],
        "Keys of a part with `file`": [k for k in keys if k in TEMPLATE_ONLY],
        "Keys of a part with `source`": [k for k in keys if k in REAL_ONLY],
    }
    for title, names in sections.items():
        yield from table(title, records["Manifest"], names)
    for name, title in RECORDS.items():
        yield from table(title, records[name], list(records[name]["properties"]))


def table(title: str, record: dict[str, Any], keys: list[str]) -> Iterator[str]:
    """Yield a section with a row for each key."""
    yield f"\n## {title}\n\n| key | value | meaning |"
    yield "|---|---|---|"
    for key in keys:
        schema = record["properties"][key]
        unit = "".join(f" [{name}]" for name in re.findall(r" \[(.*?)\]", schema["description"]))
        meaning = re.sub(r" \[.*?\]", "", schema["description"]).removesuffix(".")
        default = ", required" if key in record.get("required", ()) else _default(schema)
        yield f"| `{key}` | {_type(schema)}{unit}{default} | {meaning} |"


def _type(schema: dict[str, Any]) -> str:
    """Return the type of a value in words."""
    if "$ref" in schema:
        title = RECORDS[schema["$ref"].rpartition("/")[2]]
        return f"[{title.lower()}](#{title.lower().replace(' ', '-')})"
    if "anyOf" in schema:
        types = [_type(member) for member in schema["anyOf"] if member.get("type") != "null"]
        if types == ["number", "text"]:
            return "number or `${...}`"
        return " or ".join(name for name in types if name != "integer")
    if "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema["enum"] if value)
    if "prefixItems" in schema:
        return f"{len(schema['prefixItems'])} times {_type(schema['prefixItems'][0])}"
    if schema["type"] == "array":
        return f"list of {_type(schema['items'])}"
    if schema["type"] == "object":
        return f"map to {_type(schema['additionalProperties'])}"
    if "exclusiveMinimum" in schema:
        return f"number > {schema['exclusiveMinimum']}"
    kind: str = schema["type"]
    return {"string": "text", "boolean": "`true`, `false`"}.get(kind, kind)


def _default(schema: dict[str, Any]) -> str:
    default = schema["default"]
    return "" if default in (None, "", (), [], {}) else f", default `{json.dumps(default)}`"


if __name__ == "__main__":
    SCHEMA_FILE.write_text(json.dumps(manifest_schema(), indent=2) + "\n", encoding="utf-8")
    PAGE.write_text(page(), encoding="utf-8")
