"""The tokens documentation page agrees with the code."""

import re
from pathlib import Path

import numpy as np

from morphgen.benchmark.tokens import LAYOUT, tokens

PAGE = (Path(__file__).parents[2] / "docs" / "tokens.md").read_text(encoding="utf-8")


def test_the_example_runs_and_has_the_documented_shapes():
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    assert len(code.splitlines()) < 10
    names = {}
    exec(code, names)
    assert names["table"].shape == (100, 7, 48)
    assert names["batch"].shape == (100, 23, 48)
    assert names["mask"].shape == (23,)
    np.testing.assert_allclose(tokens(names["again"], names["shapes"]), names["table"][0])


def test_the_page_documents_every_field():
    for field in LAYOUT:
        columns = f"{field.start}:{field.columns.stop}"
        assert f"| {field.name} | {columns} | {field.content} |" in PAGE
