"""Grant of the flight in progress on disk. A restarted service needs it if the Grant was removed meanwhile."""

from __future__ import annotations

import asyncio
import json
import logging
from pathlib import Path

from fractus_core.api.grants import GrantSpec
from fractus_core.policy.compiled_grant import compile_grant
from fractus_runtime.files import read_json, remove_file, remove_temporary, write_file

from fractus_services.grant_files import MAX_GRANT_BYTES, ActiveGrant

log = logging.getLogger(__name__)

FLOWN_GRANT_FILE = "flown-grant.json"
"""Name of the file in the state directory."""


class FlownGrantFile:
    """Grant of the flight in progress on disk, from the start of the motors until they stop.

    Its constraints apply to a return flight, even if the Grant is removed and the service restarts.

    Args:
        path: Path of the file.

    Attributes:
        grant: Grant in the file; None if there is none or if the file is damaged.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._storing: asyncio.Future[None] | None = None
        self._problem = ""
        remove_temporary(path)
        self.grant = _read(path)

    def keep(self, grant: ActiveGrant | None) -> None:
        """Store a Grant in the background, or remove the file. If a write is in progress or fails, the next call tries again."""
        if (self._storing is None or self._storing.done()) and self.grant is not grant:
            self._storing = asyncio.ensure_future(self._store(grant))

    async def _store(self, grant: ActiveGrant | None) -> None:
        try:
            if grant is None:
                await asyncio.to_thread(remove_file, self._path)
            else:
                await asyncio.to_thread(_write, self._path, grant)
        except OSError as error:
            if self._problem != str(error):
                log.error("grants: cannot store the flown Grant yet (path=%s error=%s)", self._path, error)  # noqa: TRY400
            self._problem = str(error)
        else:
            self._problem = ""
            self.grant = grant


def _write(path: Path, grant: ActiveGrant) -> None:
    content = {
        "key": grant.key,
        "name": grant.name,
        "flat_terrain": grant.compiled.flat_terrain,
        "spec": grant.spec.to_dict(),
    }
    write_file(path, json.dumps(content).encode())


def _read(path: Path) -> ActiveGrant | None:
    try:
        content = read_json(path, MAX_GRANT_BYTES)
        spec = GrantSpec.model_validate(content["spec"])
        compiled = compile_grant(spec, flat_terrain=bool(content["flat_terrain"]))
        return ActiveGrant(str(content["key"]), str(content["name"]), spec, compiled)
    except FileNotFoundError:
        return None
    except Exception:
        # The service must start in flight, whatever the file contains. Without a Grant, the drone returns on the path that it flew.
        log.exception("grants: cannot read the flown Grant (path=%s)", path)
        return None
