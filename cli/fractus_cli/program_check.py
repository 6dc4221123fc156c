"""Static check of driver programs: wrong calls of the SDK, forgotten awaits, and calls that block the event loop."""

from __future__ import annotations

import ast
import difflib
import inspect
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import fractus

_KINDS: dict[str, type] = {"Mobility": fractus.Mobility, "Control": fractus.Control}
_NESTED: dict[tuple[type, str], type] = {
    (fractus.Mobility, "can_i"): fractus.CanI,
    (fractus.Mobility, "watch"): fractus.Watch,
}
"""Attributes of a client that are objects with methods."""

_MOTIONS = (fractus.Motion.__name__, fractus.Mission.__name__)
_SLEEP = "use `await asyncio.sleep(...)`"
_THREAD = "use `await asyncio.to_thread(...)`"
BLOCKING = {
    "time.sleep": _SLEEP,
    "input": _THREAD,
    "os.system": _THREAD,
    "subprocess.run": _THREAD,
    "subprocess.call": _THREAD,
    "subprocess.check_call": _THREAD,
    "subprocess.check_output": _THREAD,
    "urllib.request.urlopen": _THREAD,
    "requests.get": _THREAD,
    "requests.post": _THREAD,
    "requests.put": _THREAD,
    "requests.request": _THREAD,
}
"""Functions that block the event loop, with the remedy."""

_FORM = "define it as `async def program(drone, control)`"


@dataclass(frozen=True, slots=True, order=True)
class Problem:
    """A problem in a program, with the number of its line."""

    line: int
    text: str


@dataclass(slots=True)
class _Names:
    """Names of a module: imports by their full name, functions, and the variables that contain clients.

    Attributes:
        imports: Full names by local name, for example `time.sleep` for `sleep`.
        functions: Functions of the module by name.
        clients: Types of the variables of one function, by name.
    """

    imports: dict[str, str] = field(default_factory=dict)
    functions: dict[str, ast.FunctionDef | ast.AsyncFunctionDef] = field(default_factory=dict)
    clients: dict[str, type] = field(default_factory=dict)

    def full_name(self, node: ast.expr) -> str:
        """Return the full name of a function, for example `fractus.run`; empty if the expression is not a name."""
        if isinstance(node, ast.Name):
            return self.imports.get(node.id, node.id)
        if isinstance(node, ast.Attribute):
            owner = self.full_name(node.value)
            return f"{owner}.{node.attr}" if owner else ""
        return ""

    def type_of(self, node: ast.expr) -> type | None:
        """Return the SDK's type of an expression, or None if it is unknown."""
        if isinstance(node, ast.Name):
            return self.clients.get(node.id)
        if isinstance(node, ast.Attribute):
            owner = self.type_of(node.value)
            return _NESTED.get((owner, node.attr)) if owner is not None else None
        return None


def check_program(source: str) -> list[Problem]:
    """Return the problems of a program's source text, in the order of their lines. The program is not run."""
    try:
        module = ast.parse(source)
    except SyntaxError as error:
        return [Problem(error.lineno or 1, f"syntax error: {error.msg}")]
    names = _Names(functions={node.name: node for node in module.body if isinstance(node, _FUNCTIONS)})
    for node in ast.walk(module):
        _read_import(node, names)
    problems: list[Problem] = []
    starts = [node for node in ast.walk(module) if isinstance(node, ast.Call) and _is_start(node, names)]
    programs = set()
    for start in starts:
        problems += _check_start(start, names)
        if start.args and isinstance(start.args[0], ast.Name):
            programs.add(start.args[0].id)
    if not starts and not any(name.startswith("fractus") for name in names.imports.values()):
        problems.append(Problem(1, "the program does not use the SDK: `import fractus`, then `fractus.run(program)`"))
    for function in (node for node in ast.walk(module) if isinstance(node, ast.AsyncFunctionDef)):
        names.clients = _clients(function, names, driver=function.name in programs)
        problems += _check_function(function, names)
    return sorted(set(problems))


_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def _read_import(node: ast.AST, names: _Names) -> None:
    if isinstance(node, ast.Import):
        for alias in node.names:
            local = alias.asname or alias.name.partition(".")[0]
            names.imports[local] = alias.name if alias.asname else local
    elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
        for alias in node.names:
            names.imports[alias.asname or alias.name] = f"{node.module}.{alias.name}"


# The call of `fractus.run`


def _is_start(call: ast.Call, names: _Names) -> bool:
    return names.full_name(call.func) in {"fractus.run", "fractus.fly"}


def _check_start(call: ast.Call, names: _Names) -> Iterator[Problem]:
    """Check the function that is passed to `fractus.run` or `fractus.fly`."""
    name = names.full_name(call.func)
    if not call.args:
        yield Problem(call.lineno, f"`{name}` needs the program: `{name}(program)`")
        return
    program = call.args[0]
    if isinstance(program, ast.Call):
        called = names.full_name(program.func)
        if called in names.functions:
            yield Problem(call.lineno, f"pass the function without parentheses: `{name}({called})`")
        return
    function = names.functions.get(program.id) if isinstance(program, ast.Name) else None
    if function is None:
        return
    if isinstance(function, ast.FunctionDef):
        if not function.decorator_list and function.returns is None:
            yield Problem(function.lineno, f"{function.name} is a synchronous function: {_FORM}")
        return
    arguments = function.args
    required = len(arguments.posonlyargs) + len(arguments.args) - len(arguments.defaults)
    accepted = len(arguments.posonlyargs) + len(arguments.args)
    keywords = [
        argument.arg
        for argument, default in zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)
        if default is None
    ]
    if required > 2 or (accepted < 2 and arguments.vararg is None) or keywords:
        yield Problem(function.lineno, f"{function.name} must accept drone and control: {_FORM}")


def _clients(function: ast.AsyncFunctionDef, names: _Names, *, driver: bool) -> dict[str, type]:
    """Return the variables of a function that contain the drone or its control."""
    clients: dict[str, type] = {}
    parameters = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    if driver:
        clients.update(zip((parameter.arg for parameter in parameters), _KINDS.values(), strict=False))
    for parameter in parameters:
        annotation = names.full_name(parameter.annotation) if parameter.annotation is not None else ""
        kind = _KINDS.get(annotation.removeprefix("fractus."))
        if kind is not None:
            clients[parameter.arg] = kind
    for block in (node for node in ast.walk(function) if isinstance(node, ast.AsyncWith)):
        for item in block.items:
            if not isinstance(item.context_expr, ast.Call) or not isinstance(item.optional_vars, ast.Name):
                continue
            if names.full_name(item.context_expr.func) == "fractus.mobility":
                clients[item.optional_vars.id] = fractus.Mobility
            elif isinstance(item.context_expr.func, ast.Attribute) and item.context_expr.func.attr == "control":
                clients[item.optional_vars.id] = fractus.Control
    return clients


# Statements of asynchronous functions


def _check_function(function: ast.AsyncFunctionDef, names: _Names) -> Iterator[Problem]:
    for node, parent in _own_nodes(function):
        if isinstance(node, ast.Call):
            yield from _check_blocking(node, names)
            yield from _check_call(node, parent, names)
        elif isinstance(node, ast.While):
            yield from _check_loop(node)
        elif isinstance(node, ast.ExceptHandler):
            yield from _check_handler(node, names)


def _own_nodes(function: ast.AsyncFunctionDef) -> Iterator[tuple[ast.AST, ast.AST]]:
    """Yield the nodes of a function and their parents, without functions defined in it."""
    pending: list[tuple[ast.AST, ast.AST]] = [(node, function) for node in function.body]
    while pending:
        node, parent = pending.pop()
        if isinstance(node, (*_FUNCTIONS, ast.Lambda, ast.ClassDef)):
            continue
        yield node, parent
        pending += [(child, node) for child in ast.iter_child_nodes(node)]


def _check_blocking(call: ast.Call, names: _Names) -> Iterator[Problem]:
    name = names.full_name(call.func)
    remedy = BLOCKING.get(name)
    if remedy is not None:
        yield Problem(
            call.lineno, f"`{name}` blocks the event loop, and a driver that blocks for 5 s loses control: {remedy}"
        )


def _check_loop(loop: ast.While) -> Iterator[Problem]:
    endless = isinstance(loop.test, ast.Constant) and bool(loop.test.value)
    waits = any(isinstance(node, (ast.Await, ast.AsyncFor, ast.AsyncWith)) for node in ast.walk(loop))
    if endless and not waits:
        yield Problem(loop.lineno, f"the loop never awaits, so it blocks the event loop: {_SLEEP} in the loop")


def _check_handler(handler: ast.ExceptHandler, names: _Names) -> Iterator[Problem]:
    kinds = handler.type.elts if isinstance(handler.type, ast.Tuple) else [handler.type]
    caught = {names.full_name(kind) if kind is not None else "BaseException" for kind in kinds}
    broad = caught & {"BaseException", "asyncio.CancelledError", "asyncio.exceptions.CancelledError"}
    if broad and not any(isinstance(node, ast.Raise) for node in ast.walk(handler)):
        yield Problem(
            handler.lineno,
            "the handler suppresses the cancellation of the program: catch `Exception`, or `raise` again",
        )


def _check_call(call: ast.Call, parent: ast.AST, names: _Names) -> Iterator[Problem]:
    """Check a call of a method of the SDK: its name, its arguments, and that its result is awaited or iterated."""
    if not isinstance(call.func, ast.Attribute):
        return
    kind = names.type_of(call.func.value)
    if kind is None:
        return
    name = call.func.attr
    method = getattr(kind, name, None)
    if method is None:
        if (kind, name) not in _NESTED and name not in _attributes(kind):
            near = difflib.get_close_matches(name, [n for n in dir(kind) if not n.startswith("_")], n=1)
            hint = f"; did you mean {near[0]}?" if near else ""
            yield Problem(call.lineno, f"{kind.__name__} has no method {name}{hint}")
        return
    wrong = _wrong_arguments(call, method)
    if wrong:
        yield Problem(call.lineno, f"{kind.__name__}.{name}: {wrong}")
    if inspect.isasyncgenfunction(method):
        if isinstance(parent, (ast.Expr, ast.For, ast.Await)):
            yield Problem(call.lineno, f"{name} yields values: use `async for ... in {ast.unparse(call)}`")
    elif _is_awaitable(method) and isinstance(parent, _UNUSED):
        yield Problem(call.lineno, f"{name} is not awaited, so it has no effect: write `await {ast.unparse(call)}`")


_UNUSED = (ast.Expr, ast.If, ast.While, ast.BoolOp, ast.UnaryOp, ast.Compare, ast.Attribute, ast.BinOp)
"""Parents of an expression that do not await its value."""


def _attributes(kind: type) -> set[str]:
    """Return the names that the constructor of a class sets."""
    source = inspect.getsource(kind.__init__)  # type: ignore[misc]  # a subclass may have another __init__, but `kind` is exact
    return {
        node.attr for node in ast.walk(ast.parse(inspect.cleandoc("\n" + source))) if isinstance(node, ast.Attribute)
    }


def _is_awaitable(method: Callable[..., Any]) -> bool:
    return inspect.iscoroutinefunction(method) or inspect.signature(method).return_annotation in _MOTIONS


def _wrong_arguments(call: ast.Call, method: Callable[..., Any]) -> str:
    """Return why the method does not accept the arguments; empty if it does, or if that is unknown."""
    if any(isinstance(argument, ast.Starred) for argument in call.args) or any(k.arg is None for k in call.keywords):
        return ""
    try:
        inspect.signature(method).bind(None, *call.args, **{str(keyword.arg): None for keyword in call.keywords})
    except TypeError as error:
        return str(error)
    return ""
