"""Make the notebooks of this folder from the examples: `python examples/notebooks/build.py`.

A line `# %%` in an example begins a cell. The comment below it becomes text, and so does the
example's docstring. Needs `pip install nbformat`.
"""

from __future__ import annotations

import ast
from pathlib import Path

import nbformat
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

NOTEBOOKS = {
    "robots": ("01_compose", "02_own_part"),
    "splits": ("05_split",),
    "environments": ("06_gymnasium",),
}
"""Examples of each notebook."""
EXAMPLES = Path(__file__).parent.parent
CELL = "# %%\n"


def notebook_text(examples: tuple[str, ...]) -> str:
    """Return a notebook with the cells of some examples; the same text for the same examples."""
    cells = []
    for name in examples:
        source = (EXAMPLES / f"{name}.py").read_text(encoding="utf-8")
        docstring = ast.get_docstring(ast.parse(source)) or ""
        title, _, rest = docstring.partition("\n")
        cells.append(new_markdown_cell(f"## {title}\n{rest}".strip()))
        code = source[source.index('"""\n', 3) + 4 :]
        for cell in code.split(CELL):
            lines = cell.strip().splitlines()
            count = next((i for i, line in enumerate(lines) if line[:1] != "#"), len(lines))
            if count:
                text = "\n".join(line.removeprefix("#").strip() for line in lines[:count])
                cells.append(new_markdown_cell(text))
            cells.append(new_code_cell("\n".join(lines[count:])))
    for i, cell in enumerate(cells):
        cell["id"] = f"cell-{i}"  # random by default
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    notebook = new_notebook(cells=cells, metadata={"kernelspec": kernel})
    nbformat.validate(notebook)
    return str(nbformat.writes(notebook)) + "\n"


def main() -> None:
    """Write every notebook."""
    for name, examples in NOTEBOOKS.items():
        path = Path(__file__).with_name(f"{name}.ipynb")
        path.write_text(notebook_text(examples), encoding="utf-8")
        print(path)


if __name__ == "__main__":
    main()
