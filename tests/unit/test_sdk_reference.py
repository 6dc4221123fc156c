"""The SDK reference page lists every public name, and every public name has a docstring."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import fractus

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "sdk.md"
PUBLIC = {
    name: value
    for name, value in vars(fractus).items()
    if not name.startswith("_") and not (inspect.ismodule(value) and value is not fractus.sync)
}


def test_sdk_reference_page_lists_every_public_name_once() -> None:
    listed = re.findall(r"^::: fractus\.(\w+)$", PAGE.read_text(), re.MULTILINE)
    assert sorted(listed) == sorted(PUBLIC)


def test_every_public_class_function_and_method_of_the_sdk_has_a_docstring() -> None:
    for name, value in PUBLIC.items():
        assert inspect.getdoc(value), f"fractus.{name} has no docstring"
        if not inspect.isclass(value):
            continue
        for member_name, member in inspect.getmembers(value):
            if not member_name.startswith("_") and (inspect.isfunction(member) or isinstance(member, property)):
                assert inspect.getdoc(member), f"fractus.{name}.{member_name} has no docstring"
