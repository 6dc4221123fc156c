"""mypy reports every place that does not handle a new member of a closed set."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_mypy_reports_filter_that_is_not_applied(tmp_path: Path) -> None:
    """Check the filter pipeline with mypy against models that contain an additional filter."""
    api = tmp_path / "fractus_core"
    subprocess.run(["cp", "-r", ROOT / "core/fractus_core", api], check=True)
    policies = api / "api/policies.py"
    text = policies.read_text()
    policies.write_text(text.replace('FilterAction = Literal["black",', 'FilterAction = Literal["mosaic", "black",'))
    assert policies.read_text() != text
    pipeline = ROOT / "services/fractus_services/camera/filter_pipeline.py"
    command = [sys.executable, "-m", "mypy", "--config-file", ROOT / "pyproject.toml", "--follow-imports=silent"]
    command += ["--cache-dir", tmp_path / "cache", pipeline]
    paths = ":".join(map(str, (tmp_path, ROOT / "services")))
    result = subprocess.run(command, env={"MYPYPATH": paths}, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert 'Argument 1 to "assert_never" has incompatible type "Literal[\'mosaic\']"' in result.stdout, result.stdout
