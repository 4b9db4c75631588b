"""The notebooks run as they stand, and hold the kind of outputs that they give now."""

import json
from pathlib import Path

import pytest

from notebooks import run

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_holds_its_figures(path: Path) -> None:
    kept, now = json.loads(path.read_text()), run(path)
    assert path.stat().st_size < 300_000
    figures = 0
    for before, after in zip(kept["cells"], now["cells"], strict=True):
        assert before["source"] == after["source"]
        kinds = [
            [sorted(out.get("data", {"text": ""})) for out in cell.get("outputs", [])]
            for cell in (before, after)
        ]
        assert kinds[0] == kinds[1], "".join(before["source"])
        figures += sum("image/png" in one or "image/svg+xml" in one for one in kinds[0])
    assert figures >= 1
