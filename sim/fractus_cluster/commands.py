"""Execution of programs with a timeout and errors that contain their output."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

from fractus_cluster.errors import ClusterError

DEFAULT_TIMEOUT_S = 120.0


def run(
    argv: Sequence[str | Path],
    *,
    input_text: str | None = None,
    timeout_s: float = DEFAULT_TIMEOUT_S,
    check: bool = True,
    env: Mapping[str, str] | None = None,
    cwd: Path | None = None,
) -> subprocess.CompletedProcess[str]:
    """Run a program and capture its output.

    Args:
        argv: Program and arguments.
        input_text: Standard input. None: empty.
        timeout_s: Timeout. The program is killed when it expires.
        check: Raise ClusterError if the exit code is not 0.
        env: Complete environment. None: inherited.
        cwd: Working directory.

    Raises:
        ClusterError: The program is missing, timed out, or (with `check`) failed.
    """
    words = [str(word) for word in argv]
    try:
        done = subprocess.run(
            words,
            input=input_text if input_text is not None else "",
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout_s,
            check=False,
            env=None if env is None else dict(env),
            cwd=cwd,
        )
    except FileNotFoundError as error:
        raise ClusterError(f"{words[0]} is not installed or not on PATH") from error
    except subprocess.TimeoutExpired as error:
        raise ClusterError(f"{' '.join(words[:4])} ... did not end within {timeout_s:.0f} s") from error
    if check and done.returncode != 0:
        output = (done.stderr.strip() or done.stdout.strip())[-2000:]
        raise ClusterError(f"{' '.join(words)} failed with exit code {done.returncode}: {output}")
    return done
