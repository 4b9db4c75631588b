"""Which statements of the package the tests run: `pytest --coverage` prints the share and what lacks most.

Each statement of a module of `evnlos` first sets a byte of its own; that costs a few per cent, where a tracer
costs half as much again as the tests themselves, and tools that rewrite byte code leave numba nothing that it
can compile. Functions that numba compiles stay as they are and are not counted, and neither is what programs
run that tests start: the share is that of the Python statements run in the tests' own processes.
"""

from __future__ import annotations

import ast
import sys
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from typing import Any

import pytest

SEEN = "__seen__"
"""Name under which a module holds its bytes."""


class Marks(ast.NodeTransformer):
    """Puts a mark before each statement; `count` of them in the end."""

    def __init__(self, tree: ast.Module) -> None:
        self.count = 0
        made = [node for node in ast.walk(tree) if isinstance(node, ast.Assign) and _is_jit(node.value)]
        self.compilers = {"njit"} | {target.id for node in made for target in node.targets}  # type: ignore[attr-defined]

    def _is_compiled(self, node: ast.AST) -> bool:
        decorators = getattr(node, "decorator_list", [])
        return any(_name(one) in self.compilers for one in decorators)

    def generic_visit(self, node: ast.AST) -> ast.AST:
        """Mark the statements of a node's blocks."""
        if self._is_compiled(node) or (isinstance(node, ast.If) and _name(node.test) == "TYPE_CHECKING"):
            return node
        for field in ("body", "orelse", "finalbody", "handlers", "cases"):
            block = getattr(node, field, None)
            if isinstance(block, list):
                setattr(node, field, [new for one in block for new in self._marked(one)])
        return node

    def _marked(self, node: ast.AST) -> list[ast.AST]:
        node = self.visit(node)
        is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        is_first = isinstance(node, ast.ImportFrom) and node.module == "__future__"
        if not isinstance(node, ast.stmt) or is_text or is_first or self._is_compiled(node):
            return [node]
        mark = ast.parse(f"{SEEN}[{self.count}] = 1").body[0]
        self.count += 1
        for part in ast.walk(mark):
            ast.copy_location(part, node)
        return [mark, node]


def _name(node: ast.AST) -> str:
    node = node.func if isinstance(node, ast.Call) else node
    return node.id if isinstance(node, ast.Name) else getattr(node, "attr", "")


def _is_jit(node: ast.AST) -> bool:
    return isinstance(node, ast.Call) and _name(node) == "njit"


class MarkedLoader(SourceFileLoader):
    """Compiles a module with its marks, past the cache of byte code."""

    def get_code(self, fullname: str) -> Any:
        """Return the module's code."""
        return self._code

    def exec_module(self, module: Any) -> None:
        """Run the module with its marks."""
        tree = ast.parse(self.get_data(self.path))
        marks = Marks(tree)
        self._code = compile(marks.visit(tree), self.path, "exec")
        module.__dict__[SEEN] = COVERED[self.path] = bytearray(marks.count)
        super().exec_module(module)


COVERED: dict[str, bytearray] = {}
"""The bytes of each file that was imported."""


class Finder:
    """Finds the package's modules, to be marked."""

    @staticmethod
    def find_spec(fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Return the specification of a module of `evnlos`."""
        if fullname.partition(".")[0] != "evnlos":
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is not None and type(spec.loader) is SourceFileLoader:
            spec.loader = MarkedLoader(spec.loader.name, spec.loader.path)
        return spec


class Coverage:
    """The plugin: marks in each process that tests, and puts them together in the one that reports."""

    def __init__(self) -> None:
        sys.meta_path.insert(0, Finder)  # type: ignore[arg-type]

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Hand a worker's marks over."""
        output = getattr(session.config, "workeroutput", None)
        if output is not None:
            output["covered"] = {name: bytes(seen) for name, seen in COVERED.items()}

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any, error: object) -> None:
        """Add the marks of a worker."""
        for name, seen in getattr(node, "workeroutput", {}).get("covered", {}).items():
            known = COVERED.setdefault(name, bytearray(len(seen)))
            known[:] = bytes(map(max, known, seen))

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        """Print the share, and the files with the most statements that no test ran."""
        import evnlos

        root = Path(evnlos.__file__).parent
        for path in sorted(root.rglob("*.py")):
            if str(path) not in COVERED:  # nothing imported it
                tree = ast.parse(path.read_bytes())
                marks = Marks(tree)
                marks.visit(tree)
                COVERED[str(path)] = bytearray(marks.count)
        total, run = sum(map(len, COVERED.values())), sum(map(sum, COVERED.values()))
        least = sorted(COVERED.items(), key=lambda item: sum(item[1]) - len(item[1]))[:8]
        files = ", ".join(f"{Path(name).relative_to(root)} {sum(n)}/{len(n)}" for name, n in least)
        terminalreporter.section("coverage")
        terminalreporter.write_line(
            f"{100 * run / total:.1f} % of {total} Python statements of evnlos ran in the tests' own processes "
            "(kernels that numba compiles and programs that tests start are not counted)"
        )
        terminalreporter.write_line(f"most are missing in: {files}")
