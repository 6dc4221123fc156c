"""The manifests that `fractus plan` and the API server must judge alike: tests/manifests/good.yaml and bad.yaml.

A case is what follows a line `# taken: WHY` or `# refused: SENTENCE`, the sentence being that of `fractus plan`.
"""

from __future__ import annotations

import pathlib
import re
from typing import NamedTuple

MANIFESTS = pathlib.Path(__file__).parent / "manifests"
_CASE = re.compile(r"^# (taken|refused): (.*)\n((?:(?!# (?:taken|refused): ).*\n?)*)", re.MULTILINE)


class Case(NamedTuple):
    """Some manifests that are judged together."""

    refused: str
    text: str

    @property
    def documents(self) -> list[str]:
        """The text of each manifest."""
        return re.split(r"^---$", self.text, flags=re.MULTILINE)


CASES = [
    Case(said if verdict == "refused" else "", text)
    for file in sorted(MANIFESTS.glob("*.yaml"))
    for verdict, said, text in _CASE.findall(file.read_text())
]
