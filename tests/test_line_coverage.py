"""The measure of coverage counts what ran, leaves compiled functions alone, and changes no line numbers."""

import ast
import traceback

from line_coverage import SEEN, Marks

MODULE = '''"""A module."""
from __future__ import annotations
from numba import njit

@njit
def kernel(x):
    return x + 1

def halves(x):
    """Return half of x."""
    if x < 0:
        raise ValueError(x)
    return x / 2
'''


def test_statements_that_ran_are_counted_once_and_kernels_never() -> None:
    tree = ast.parse(MODULE)
    marks = Marks(tree)
    names = {SEEN: (seen := bytearray(64))}
    exec(compile(marks.visit(tree), "module.py", "exec"), names)
    assert marks.count == 5  # the import, `halves`, its `if`, `raise` and `return`
    assert sum(seen) == 2
    assert names["halves"](4) == names["halves"](4) == 2
    assert sum(seen) == 4
    assert names["kernel"](1) == 2 and sum(seen) == 4
    try:
        names["halves"](-1)
    except ValueError as error:
        assert traceback.extract_tb(error.__traceback__)[-1].lineno == 12
    assert sum(seen) == 5 == marks.count
