"""Running other programs with a time limit and an error that shows what they said."""

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
    """Run a program to its end and capture what it wrote.

    Args:
        argv: The program and its arguments.
        input_text: What it reads on standard input; nothing when None.
        timeout_s: After this many seconds the program is killed and ClusterError is raised.
        check: Raise ClusterError when the exit code is not 0.
        env: The whole environment of the program; inherited when None.
        cwd: Its working directory.

    Raises:
        ClusterError: The program is missing, took too long, or (with `check`) failed.
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
        said = (done.stderr.strip() or done.stdout.strip())[-2000:]
        raise ClusterError(f"{' '.join(words)} failed with exit code {done.returncode}: {said}")
    return done
