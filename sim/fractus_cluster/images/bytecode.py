"""Compiles modules in place of their sources, as compileall does, but without docstrings: 2 MB less in each process of a node.

    python3 -X no_debug_ranges bytecode.py DIRECTORY IMAGE_PATH

A file of its own, which runs while images are built. Unlike `python -OO` it leaves assertions in, and docstrings are empty rather
than missing, for modules that edit them. Decorated classes keep theirs: what a dataclass makes for itself instead is longer.
Columns of instructions, which `-X no_debug_ranges` leaves out, are another half megabyte; without sources, tracebacks show none.
"""

from __future__ import annotations

import ast
import contextlib
import importlib.util
import marshal
import sys
from pathlib import Path

_UNCHECKED = 0b01
"""Flag of PEP 552: loaded without a look at the source."""
_DOCUMENTED = ("numpy",)
"""Packages that look into docstrings when they are imported, their own and those of their modules in C."""


def compiled(source: bytes, name: str, *, documented: bool = False) -> bytes:
    """The content of the .pyc file of a module.

    Args:
        source: the module.
        name: its path, for tracebacks.
        documented: whether it keeps its docstrings.

    Raises:
        SyntaxError: it is none of this version of Python.
    """
    tree = ast.parse(source, name)
    for node in () if documented else ast.walk(tree):
        match node:
            case (
                ast.Module(body=[ast.Expr(ast.Constant(str()) as text), *_])
                | ast.FunctionDef(body=[ast.Expr(ast.Constant(str()) as text), *_])
                | ast.AsyncFunctionDef(body=[ast.Expr(ast.Constant(str()) as text), *_])
                | ast.ClassDef(body=[ast.Expr(ast.Constant(str()) as text), *_], decorator_list=[])
            ):
                text.value = ""
    header = importlib.util.MAGIC_NUMBER + _UNCHECKED.to_bytes(4, "little") + importlib.util.source_hash(source)
    return header + marshal.dumps(compile(tree, name, "exec", dont_inherit=True))


def main(directory: Path, image_path: Path) -> None:
    """Compile all modules below a directory, which is at this path of the image; what is no module of this Python stays."""
    for path in sorted(directory.rglob("*.py")):
        inside = path.relative_to(directory)
        source = path.read_bytes()
        with contextlib.suppress(SyntaxError):
            content = compiled(source, str(image_path / inside), documented=inside.parts[0] in _DOCUMENTED)
            path.with_suffix(".pyc").write_bytes(content)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
