"""Run notebooks without Jupyter: cells in order, what they print and show kept as their outputs.

python tests/notebooks.py notebooks/*.ipynb    # run them and write their outputs into the files
"""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import json
import sys
from pathlib import Path
from typing import Any

_KINDS = {"_repr_svg_": "image/svg+xml", "_repr_png_": "image/png"}


def run(path: Path) -> dict[str, Any]:
    """Return the notebook with the outputs of its cells; an error in a cell is raised."""
    notebook = json.loads(path.read_text())
    names: dict[str, Any] = {"__name__": "__main__"}
    count = 0
    for cell in notebook["cells"]:
        if cell["cell_type"] != "code":
            continue
        count += 1
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            shown = _value("".join(cell["source"]), names, f"{path.name}, cell {count}")
        cell["execution_count"], cell["outputs"] = count, []
        if printed.getvalue():
            text = printed.getvalue().splitlines(keepends=True)
            cell["outputs"].append({"name": "stdout", "output_type": "stream", "text": text})
        if shown is not None:
            output = {
                "data": _data(shown),
                "execution_count": count,
                "metadata": {},
                "output_type": "execute_result",
            }
            cell["outputs"].append(output)
    return notebook


def _value(source: str, names: dict[str, Any], where: str) -> Any:
    """Run a cell and return the value of its last line where that is an expression."""
    tree = ast.parse(source)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, where, "exec"), names)
    return None if last is None else eval(compile(ast.Expression(last.value), where, "eval"), names)


def _data(shown: Any) -> dict[str, Any]:
    for method, kind in _KINDS.items():
        if hasattr(shown, method):
            content = getattr(shown, method)()
            return {kind: content if isinstance(content, str) else base64.b64encode(content).decode()}
    return {"text/plain": repr(shown).splitlines(keepends=True)}


if __name__ == "__main__":
    for name in map(Path, sys.argv[1:]):
        name.write_text(json.dumps(run(name), indent=1, ensure_ascii=False) + "\n")
        print(f"{name}: {name.stat().st_size / 1e3:.0f} kB")
