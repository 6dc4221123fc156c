"""Bad applications: programs that try what the platform must prevent. One line uses each of them.

    drone.set_app(malice.leaves_corridor())
    drone.set_app(malice.leaves_corridor(interface="mavlink"))

Programs use the SDK (`grpc`), or speak MAVLink through the gateway (`mavlink`). Each program takes off, tries its attack,
and returns control. It ends with exit code 0 if the platform prevented the attack, and with `BREACH` if the attack
succeeded. `results.check_app_status(drone, SUCCESS)` is therefore a test of the
platform. `leaves_corridor` and `presses_border` do not know the border, so compare `results.track` with it. `stalls` and
`crashes` lose control by design: check with `results.check_landed` that the drone came home.
"""

from __future__ import annotations

from fractus_core.api.methods import Interface

from fractus_testing.applications import App

BREACH = 3
"""Exit code of a program whose attack succeeded."""


def leaves_corridor(distance_m: float = 200.0, *, interface: Interface = "grpc") -> App:
    """Fly out of the permitted area: to a position this far north in one leg, then to the same position in short legs.

    Only the full distance counts as a breach. The test must compare the track with the border.
    """
    return _app("leaves-corridor", interface, DISTANCE_M=distance_m)


def presses_border(seconds: float = 20.0, speed_mps: float = 5.0, *, interface: Interface = "grpc") -> App:
    """Fly north by velocity commands for some seconds, against the border of the permitted area.

    The program reports no breach. The test must compare the track with the border.
    """
    return _app("presses-border", interface, SECONDS=seconds, SPEED_MPS=speed_mps)


def floods(calls: int = 500, *, interface: Interface = "grpc") -> App:
    """Send many calls, or MAVLink frames, at once. The service must still answer those that follow."""
    return _app("floods", interface, CALLS=calls)


def wrong_frames(*, interface: Interface = "grpc") -> App:
    """Request positions with exchanged latitude and longitude, altitudes of another datum, NaN and infinity.

    Over MAVLink, also in frames of reference that no leg may use. The drone first climbs to the highest permitted altitude,
    119 m at most.
    """
    return _app("wrong-frames", interface)


def forges_identity(*, interface: Interface = "grpc") -> App:
    """Call the services with certificates of the program's own authority, also with the identity of another instance.

    Over MAVLink, send commands with the ids of the autopilot and of ground stations, and for other systems.
    """
    return _app("forges-identity", interface)


def forces_arming(*, interface: Interface = "grpc") -> App:
    """Arm without control of the drone, and disarm in flight. Over MAVLink, also with the codes that force both."""
    return _app("forces-arming", interface)


def reads_foreign_pictures(*names: str) -> App:
    """Retrieve and delete pictures of other components, and files outside of the picture store, by name. Needs a camera."""
    return _app("reads-foreign-pictures", "grpc", NAMES=names)


def stalls(seconds: float = 60.0, *, interface: Interface = "grpc") -> App:
    """Block the program's event loop in flight, while the program has control. Over MAVLink, its heartbeats end."""
    return _app("stalls", interface, SECONDS=seconds)


def crashes(*, interface: Interface = "grpc") -> App:
    """Exit in flight without returning control."""
    return _app("crashes", interface)


def _app(name: str, interface: Interface, **params: object) -> App:
    module = "fractus_testing.malice" if interface == "grpc" else "fractus_testing.malice.mavlink_programs"
    return App(("python", "-m", module, name), params, interface=interface)
