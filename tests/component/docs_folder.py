"""Where the commands of a page are typed: a checkout, the files that the page shows, and audit logs of a flight."""

from __future__ import annotations

import re
import shutil
from datetime import datetime
from pathlib import Path

import demo_flight
from docs_commands import ROOT, Command
from fractus_runtime.audit import AuditLog


def furnish(folder: Path, page: str) -> None:
    """The files that a page shows with their names, and the repository's folders."""
    for name in ("examples", "charts", "Dockerfile", "bench"):
        if not (folder / name).exists():
            (folder / name).symlink_to(ROOT / name)
    text = (ROOT / page).read_text()
    for name, content in re.findall(r"`([\w.]+)`[^`\n]*:\n```\w+\n(.*?)```", text, re.DOTALL):
        if name == "Dockerfile":
            (folder / name).unlink()
        (folder / name).write_text(content)


def enter(folder: Path, command: Command) -> Path:
    """The directory in which the next command is typed."""
    if command.argv[0] == "mkdir":
        (folder / command.argv[1]).mkdir()
    elif command.argv[0] == "cp":
        shutil.copy(folder / command.argv[1], folder / command.argv[2])
    elif command.argv[0] == "cd":
        inner = folder / command.argv[1]
        furnish(inner, command.page)
        return inner
    return folder


LOGS = ("audit/mobility", "audit/camera", "node/audit/mobility", "drone-1/audit/mobility", "drone-2/audit/mobility")


async def furnish_logs(folder: Path, tls: Path | None = None) -> None:
    """Audit logs of a flight, where pages have them; with a node's key also their checkpoints, and copies that are kept."""
    for log in LOGS:
        shutil.rmtree((folder / log).parent, ignore_errors=True)
    for log in LOGS:
        await _write(folder / f"{log}.jsonl", log.partition("/")[0], tls)
    if tls is not None:
        shutil.copytree(folder / "audit", folder / "kept", dirs_exist_ok=True)


async def _write(log: Path, node: str, tls: Path | None) -> None:
    now_s = 0.0
    writer = AuditLog(log, lambda: now_s, tls=tls)
    started = {"kind": "started", "time": demo_flight.stamp(demo_flight.APPLIED_S), "node": node}
    for entry in [started, *demo_flight.states()[:60]]:
        now_s = datetime.fromisoformat(str(entry["time"])).timestamp()
        writer.append(str(entry["kind"]), {key: value for key, value in entry.items() if key not in {"kind", "time"}})
    await writer.close()
