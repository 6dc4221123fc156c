"""Bad applications: programs that try what the platform must prevent. One line uses each of them.

    drone.set_app(malice.leaves_corridor())

Each program takes off, tries its attack, and returns control. It ends with exit code 0 if the platform prevented the
attack, and with `BREACH` if the attack succeeded. `results.check_app_status(drone, SUCCESS)` is therefore a test of the
platform. `leaves_corridor` and `presses_border` do not know the border, so compare `results.track` with it. `stalls` and
`crashes` lose control by design: check with `results.check_landed` that the drone came home.
"""

from __future__ import annotations

from fractus_testing.applications import App

BREACH = 3
"""Exit code of a program whose attack succeeded."""


def leaves_corridor(distance_m: float = 200.0) -> App:
    """Fly out of the permitted area: to a position this far north in one leg, then to the same position in short legs.

    Only the full distance counts as a breach. The test must compare the track with the border.
    """
    return _app("leaves-corridor", DISTANCE_M=distance_m)


def presses_border(seconds: float = 20.0, speed_mps: float = 5.0) -> App:
    """Fly north by velocity commands for some seconds, against the border of the permitted area.

    The program reports no breach. The test must compare the track with the border.
    """
    return _app("presses-border", SECONDS=seconds, SPEED_MPS=speed_mps)


def floods(calls: int = 500) -> App:
    """Send many calls at once. The service must still answer the calls that follow."""
    return _app("floods", CALLS=calls)


def wrong_frames() -> App:
    """Request positions with exchanged latitude and longitude, altitudes of another datum, NaN and infinity."""
    return _app("wrong-frames")


def forges_identity() -> App:
    """Call the services with certificates of the program's own authority, also with the identity of another instance."""
    return _app("forges-identity")


def forces_arming() -> App:
    """Arm without control of the drone, and disarm in flight."""
    return _app("forces-arming")


def reads_foreign_pictures(*names: str) -> App:
    """Retrieve and delete pictures of other components, and files outside of the picture store, by name. Needs a camera."""
    return _app("reads-foreign-pictures", NAMES=names)


def stalls(seconds: float = 60.0) -> App:
    """Block the program's event loop in flight, while the program has control."""
    return _app("stalls", SECONDS=seconds)


def crashes() -> App:
    """Exit in flight without returning control."""
    return _app("crashes")


def _app(name: str, **params: object) -> App:
    return App(("python", "-m", "fractus_testing.malice", name), params)
