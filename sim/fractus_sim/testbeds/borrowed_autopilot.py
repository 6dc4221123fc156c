"""A running autopilot that belongs to somebody else: its owner's settings are kept on disk until they are verified to be restored."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from fractus_runtime.files import read_json, write_file
from fractus_services.mobility.mavlink.ardupilot import ARDUCOPTER

from fractus_sim.errors import ExperimentError
from fractus_sim.testbeds.standalone_drones import DroneSetup, Standalone
from fractus_sim.testbeds.vehicle_settings import AutopilotConnection, VehicleSettings

RESTORE_TIMEOUT_S = 90.0
"""Time within which a mobility service must have found the autopilot and restored the settings that it stored."""

RESTORE_POLL_S = 0.2

_FAILSAFES = (*ARDUCOPTER.failsafes, *ARDUCOPTER.straight_return, *ARDUCOPTER.path_return)
FAILSAFE_NAMES = frozenset(
    name for setting in _FAILSAFES for names in (setting.names, *(s.names for s in setting.additional.values())) for name in names
)  # fmt: skip
"""Parameters that the mobility service sets and does not restore."""

_MISSION_NAMES = frozenset(
    (
        *(name for setting in ARDUCOPTER.mission_settings for name in setting.names),
        *(name for names in ARDUCOPTER.returning for name in names),
        *ARDUCOPTER.fence_parameters,
        ARDUCOPTER.fence_total,
    )
)
"""Parameters that the mobility service sets during a mission and restores."""


def default_state(link: str) -> Path:
    """Return the directory for the settings of an autopilot: in the user's state directory, named after its link."""
    base = os.environ.get("XDG_STATE_HOME")
    home = Path(base) if base else Path.home() / ".local/state"
    return home / "fractus" / "autopilots" / link.replace(":", "-").replace("/", "-")


class BorrowedAutopilot:
    """A running autopilot that experiments fly with a mobility service.

    The settings of its owner are stored before the first flight, and removed when all of them are restored. The state of the mobility
    service is kept in the same directory, so that another service can complete a restore that was interrupted.

    Args:
        link: `tcp:HOST:PORT` of the autopilot. It may accept one connection at a time.
        state: Directory that outlives the experiment.
        report: Called with progress messages.
    """

    def __init__(self, link: str, state: Path, report: Callable[[str], None]) -> None:
        self.link = link
        self._path = state / "owner.json"
        self._service_state = state / "mobility"
        self._report = report
        self._owner = self._load()

    @property
    def service_state(self) -> Path:
        """State directory of the mobility services that fly this autopilot."""
        return self._service_state

    @property
    def interrupted(self) -> bool:
        """True if an earlier experiment has not restored the settings of the owner."""
        return self._owner is not None

    def take(self) -> None:
        """Read and store the settings of the owner.

        Settings that an interrupted experiment has stored are kept, because they must be restored first.

        Raises:
            ExperimentError: The autopilot does not answer.
            OSError: The settings cannot be stored.
        """
        if self._owner is not None:
            return
        with AutopilotConnection.open(self.link) as autopilot:
            owner = autopilot.read_settings()
        self._path.parent.mkdir(parents=True, exist_ok=True)
        write_file(self._path, owner.to_json())
        self._owner = owner

    def wait_restored(self) -> None:
        """Wait while the running mobility service restores fence and parameters, at most for `RESTORE_TIMEOUT_S`."""
        deadline = time.monotonic() + RESTORE_TIMEOUT_S
        while self._service_restores() and time.monotonic() < deadline:
            time.sleep(RESTORE_POLL_S)

    def give_back(self) -> list[str]:
        """Restore the failsafes after all services have stopped, and compare all settings with those of the owner.

        Returns:
            Differences as sentences. Without differences, the stored settings are removed.

        Raises:
            ExperimentError: The autopilot does not answer, or the settings of the owner are unknown.
        """
        owner = self._known_owner()
        with AutopilotConnection.open(self.link) as autopilot:
            now = autopilot.read_settings()
            # The companion's system id comes last, because an autopilot may accept parameters from this system only.
            changed = sorted(FAILSAFE_NAMES.intersection(owner.changed_parameters(now)), key=lambda n: "GCS" in n)
            for name in changed:
                if name in owner.parameters:
                    autopilot.write_parameter(name, owner.parameters[name])
            if changed:
                now = autopilot.read_settings()
        differences = owner.differences(now)
        if self._service_restores():
            differences.append(f"the mobility service has not restored all values in {self._service_state}")
        if not differences:
            self._path.unlink()
            self._owner = None
        return differences

    def restore(self, folder: Path, setup: DroneSetup, *, forced: bool) -> None:
        """Restore the settings that an earlier experiment left, without a flight.

        Args:
            folder: Directory for logs and certificates of the mobility service.
            setup: Drone of the experiment, with this autopilot and its state directory.
            forced: Restore even if other settings have changed since.

        Raises:
            ExperimentError: The settings cannot be restored, or the vehicle may be another one.
        """
        self._report("restoring the settings of the owner, which an earlier run did not restore")
        if not forced:
            self._require_same_vehicle()
        if self._service_restores():
            with Standalone(folder) as drones:
                drones.add_drone(replace(setup, camera=None))
                self.wait_restored()
                drones.stop_services()
        differences = self.give_back()
        if differences:
            raise ExperimentError(
                f"the settings of the vehicle at {self.link} differ from those of its owner in {self._path}:"
                f" {'; '.join(differences)}; set them by hand, then remove {self._path.parent}"
            )
        self._report("the settings of the owner are restored")

    def _require_same_vehicle(self) -> None:
        """Check that the vehicle differs from the stored settings only by settings that the mobility service sets.

        Raises:
            ExperimentError: The check failed.
        """
        owner = self._known_owner()
        with AutopilotConnection.open(self.link) as autopilot:
            now = autopilot.read_settings()
        others = [name for name in owner.changed_parameters(now) if name not in FAILSAFE_NAMES | _MISSION_NAMES]
        found = [f"{name} changed" for name in others]
        if owner.identity != now.identity:
            found.insert(0, f"it was {owner.identity} and is {now.identity}")
        if found:
            raise ExperimentError(
                f"an earlier run did not restore the vehicle at {self.link}, and it may be another vehicle now"
                f" ({'; '.join(found)}); use --restore if it is the same, else remove {self._path.parent}"
            )

    def _known_owner(self) -> VehicleSettings:
        if self._owner is None:
            raise ExperimentError(
                f"the settings of the owner of the vehicle at {self.link} are unknown; nothing to restore"
            )
        return self._owner

    def _service_restores(self) -> bool:
        """Return True while a mobility service has stored values that it must restore."""
        return any((self._service_state / name).exists() for name in ("fence.json", "return.json"))

    def _load(self) -> VehicleSettings | None:
        try:
            return VehicleSettings.from_dict(read_json(self._path))
        except FileNotFoundError:
            return None
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ExperimentError(
                f"cannot read the settings of the owner of the vehicle at {self.link} ({self._path}: {error});"
                f" set them by hand, then remove {self._path.parent}"
            ) from None
