"""Compiles the modules of an image as compileall does, but without docstrings: megabytes less in each process of a node.

    python3 bytecode.py DIRECTORY IMAGE_PATH

A file of its own, which runs while images are built. Unlike `python -OO` it leaves assertions in, and docstrings are empty rather
than missing, for modules that edit them. Decorated classes keep theirs: what a dataclass makes for itself instead is longer.
"""

from __future__ import annotations

import ast
import importlib.util
import marshal
import sys
from pathlib import Path

_UNCHECKED = 0b01
"""Flag of PEP 552: loaded without a look at the source."""


def compiled(source: bytes, name: str) -> bytes:
    """The content of the .pyc file of a module.

    Args:
        source: the module.
        name: its path, for tracebacks.

    Raises:
        SyntaxError: it is none of this version of Python.
    """
    tree = ast.parse(source, name)
    for node in ast.walk(tree):
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
    """Compile all modules below a directory, which is at this path of the image."""
    for path in sorted(directory.rglob("*.py")):
        file = Path(importlib.util.cache_from_source(path))
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(compiled(path.read_bytes(), str(image_path / path.relative_to(directory))))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
