"""The JSON schema of part manifests, for editors and for the page ``docs/part-manifest.md``.

It follows from the records that read a manifest: their types, defaults and docstrings. After a
change of these records, regenerate the file:

    python -m morphgen.grammar.manifest_schema
"""

from __future__ import annotations

import ast
import inspect
import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import fields

from morphgen.grammar.manifest import (
    REAL_ONLY,
    TEMPLATE_ONLY,
    FrameSpec,
    Manifest,
    PackageSource,
    Parameter,
    Scaling,
)

SCHEMA_FILE = Path(__file__).with_name("manifest.schema.json")
"""The schema, as editors read it."""
_RECORDS = (Manifest, FrameSpec, PackageSource, Scaling, Parameter)


def manifest_schema() -> dict[str, Any]:
    """Return the JSON schema of a part's YAML file; ``$defs`` has one entry per record."""
    # The only type that JSON lacks is the path of the YAML file, which is no key of it.
    schema = msgspec.json.schema(Manifest, schema_hook=lambda kind: {"type": "string"})
    records: dict[str, Any] = schema["$defs"]
    for record in _RECORDS:
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


def main() -> None:
    """Write the schema's file."""
    SCHEMA_FILE.write_text(json.dumps(manifest_schema(), indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
