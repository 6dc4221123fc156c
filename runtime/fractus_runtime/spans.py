"""Spans of calls and of what is done about them; those that are not traced cost nothing.

Who serves a call opens its span; what is done about it, wherever in the program, is told to the `call` of the context.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from contextvars import ContextVar
from types import TracebackType
from typing import Protocol, Self

STATUS = "rpc.grpc.status_code"
"""Attribute of a call that did not succeed."""

Attribute = str | int | float | bool | Sequence[str]


class Span:
    """A call, or a part of what is done about it, as a context manager; this one is of a call that is not traced."""

    __slots__ = ()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """It is over."""

    def child(self, name: str) -> Span:
        """A part of it, which begins now and ends with the `with` block."""
        del name
        return self

    def note(self, name: str, value: Attribute) -> None:
        """Tell something about it: nothing private, and no position, for collectors may keep it for long."""

    def verdict(self, action: str, code: str, policies: Sequence[str]) -> None:
        """Tell what was decided about it, without the reason, which may tell positions."""


_UNTRACED = Span()
_call: ContextVar[Span] = ContextVar("fractus_call", default=_UNTRACED)


def call() -> Span:
    """The call on whose behalf this runs; tasks that it starts run on its behalf too."""
    return _call.get()


class Serving:
    """A call that is being served, as a context manager.

    Args:
        span: of the call.
    """

    def __init__(self, span: Span) -> None:
        self._span = span

    def __enter__(self) -> None:
        self._token = _call.set(self._span.__enter__())

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        _call.reset(self._token)
        self._span.__exit__(kind, error, trace)


class Tracer(Protocol):
    """Opens the spans of calls, and exports them."""

    def serve(self, method: str, headers: Iterable[tuple[str, str | bytes]]) -> AbstractContextManager[None]:
        """A call that is served in the `with` block.

        Args:
            method: `package.Service/Method`.
            headers: of the call, which may continue the trace of its caller.
        """

    def close(self) -> None:
        """Export what is left, for a second at most."""
