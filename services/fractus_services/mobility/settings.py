"""Settings of the mobility process: intervals, timeouts, tolerances and limits of attempts.

Times are in seconds of the service's clock unless a field states another unit. Bounds and defaults of the public API, and
physical and protocol constants, are beside their use. The settings are one instance for the process and not constructor
arguments, because many functions without an object use them, such as the motions.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class MobilitySettings:
    """Tunable values of the mobility service with their defaults."""

    # Arming

    arming_timeout_s: float = 3.0
    """Seconds to wait until the journal is written, and then until the autopilot reports that the motors are armed."""

    arming_retry_s: float = 2.0
    """Seconds between arming attempts."""

    arming_update_timeout_s: float = 0.5
    """Seconds to wait for one message of the vehicle."""

    fence_timeout_s: float = 45.0
    """Seconds within which the vehicle's fence must be loaded and verified."""

    at_home_m: float = 5.0
    """Distance from home within which the autopilot may return on the path it flew."""

    max_home_distance_m: float = 50.0
    """Distance from the home of the grant above which arming is refused, because the drone would return to a wrong place."""

    # Control state, drivers and home

    default_speed_mps: float = 5.0
    """Assumed speed of legs while the vehicle's parameters are unknown."""

    waypoint_radius_m: float = 5.0
    """A leg that ends within this distance of the next waypoint of the path counts as reaching the waypoint."""

    home_moved_m: float = 2.0
    """Three-dimensional distance above which home counts as moved. Smaller distances are within the margins of legs."""

    home_timeout_s: float = 2.0
    """Seconds to wait for HOME_POSITION after home was set."""

    # System tasks: hover, land, return

    task_retry_s: float = 0.5
    """Seconds between attempts of a system task."""

    max_return_attempts: int = 6
    """Number of refused attempts to return after which the drone lands at its current position."""

    settle_timeout_s: float = 10.0
    """Longest time for which the stop setpoint is repeated until the drone is at rest, in seconds."""

    settled_mps: float = 0.2
    """Speed below which the drone counts as settled; well below the speed at which the policy engine considers it at rest."""

    brake_timeout_s: float = 8.0
    """Longest time to wait until the drone is at rest before a return, in seconds."""

    brake_resend_s: float = 0.1
    """Seconds of the vehicle's clock between stop setpoints."""

    position_problem_timeout_s: float = 60.0
    """Seconds for which a return waits until the position is trusted again.

    If the position is then still not trusted, the drone lands at its current position.
    """

    position_problem_above_zone_timeout_s: float = 240.0
    """The same time for a drone that would descend into a zone.

    It is limited, because a drone that stays in the air until its battery is empty comes down without control.
    """

    # Supervision and verification of the failsafes

    tick_timeout_s: float = 1.0
    """Seconds since the last iteration of the monitor's loop after which heartbeats stop: the event loop may hang."""

    unattended_timeout_s: float = 3.0
    """Seconds for which an armed drone may have no control authority although the state machine tries to take it over.

    After that the heartbeats stop, and the autopilot's own failsafe brings the drone home.
"""

    lower_retry_s: float = 10.0
    """Seconds between attempts to remove the fence and limits of a mission."""

    lower_after_s: float = 5.0
    """Seconds after which a fence that no mission needs is removed.

    A repeated arming attempt in this time can still use it.
    """

    stop_timeout_s: float = 25.0
    """Longest time for which a stopped service restores the owner's fence and parameters.

    The chart's termination grace period of the service is longer.
    """

    stop_retry_s: float = 1.0
    """Seconds between attempts to restore the owner's fence and parameters while the service stops."""

    verify_min_retry_s: float = 0.5
    """Shortest time between two checks of the failsafes."""

    verify_max_retry_s: float = 30.0
    """Longest time between two verifications on the ground, after repeated failures."""

    verify_interval_s: float = 10.0
    """Seconds between verifications in flight. They detect a change by another station even if its message was lost."""

    unverified_timeout_s: float = 60.0
    """Seconds for which the failsafes of a connected, flying vehicle may be unverified before the system brings it home."""

    # Authorization of calls

    driver_rest_factor: float = 1.0
    """Pause after a call of the driver in control was judged, as a multiple of the time that judging the call took."""

    others_rest_factor: float = 4.0
    """Pause after a call of any other caller was judged, as a multiple of the time that judging the call took.

    The pauses reserve time for the monitor: a flood of calls takes only a part of the event loop's time.
"""

    position_retry_after_s: float = 0.5
    """Suggested delay before a retry while the position of the drone is unknown."""

    # Methods and motions

    binding_timeout_s: float = 60.0
    """Longest time for which a leg that a geofence corrected suspends further motions of its driver."""

    suspended_retry_after_s: float = 1.0
    """Suggested delay before a suspended motion is requested again."""

    suspended_rest_s: float = 0.1
    """Pause of a driver's calls after a suspended motion, because each of them is written to the audit log."""

    min_acceptance_radius_m: float = 0.3
    """Smallest acceptance radius of a goto."""

    max_acceptance_radius_m: float = 50.0
    """Largest acceptance radius of a goto."""

    rejudge_after_s: float = 0.05
    """Seconds of the vehicle's clock after which a waiting command is judged again from the current position.

    At 15 m/s the drone moves 0.75 m in this time.
"""

    max_judgements: int = 6
    """Maximum number of judgements of one call. A drone that does not come to rest cannot begin its leg."""

    reached_m: float = 1.0
    """Default distance to the target within which a leg is complete."""

    height_reached_m: float = 0.8
    """Difference of altitude within which a climb or leg is complete. ArduCopter approaches the last metre ever more slowly."""

    height_reached_mps: float = 0.6
    """Vertical speed below which a climb is complete."""

    report_interval_s: float = 0.2
    """Seconds between progress reports of a motion."""

    climb_timeout_s: float = 20.0
    """Seconds without progress after which a climb has failed."""

    climb_progress_m: float = 0.2
    """Gain of altitude that counts as progress of a climb."""

    stuck_timeout_s: float = 6.0
    """Seconds without progress after which the command of a leg is sent again.

    A stop setpoint may have overtaken the command, or the autopilot may have restarted its controller.
"""

    leg_progress_m: float = 0.3
    """Approach to the target that counts as progress of a leg."""

    max_leg_resends: int = 3
    """Number of times that the command of a leg is sent again."""

    heading_reached_deg: float = 8.0
    """Difference of heading within which a leg with a heading is complete."""

    arrival_timeout_s: float = 8.0
    """Seconds at the target after which a leg with a heading, or the last leg home, is complete in any case."""

    speed_timeout_s: float = 1.3
    """Seconds within which the speed of a leg must be acknowledged. The speed is sent twice in this time.

    Without an acknowledgement the drone is stopped and the leg is started once more.
"""

    rest_timeout_s: float = 12.0
    """Seconds within which the drone must come to rest."""

    stop_resend_s: float = 0.1
    """Seconds of the vehicle's clock between stop setpoints."""

    setpoint_resend_s: float = 0.2
    """Seconds of the vehicle's clock between repetitions of a velocity setpoint.

    If the message of a setpoint is lost, a repetition ends the previous setpoint. ArduCopter also stops if it receives
    no setpoint for GUID_TIMEOUT (1 s, set together with the failsafes).
"""

    min_hold_s: float = 1e-3
    """Remaining hold time below which a velocity setpoint has expired. The event loop cannot sleep for a shorter time."""

    # System flights

    max_replans: int = 5
    """Number of new routes that are searched after the monitor stopped the drone, under the same flight constraints."""

    max_legs: int = 60
    """Maximum number of legs of a flight.

    Each leg is planned from the current position. Without this limit, a flight that makes no progress would not end.
    """

    at_waypoint_m: float = 0.3
    """Distance within which the drone counts as being at a waypoint."""

    return_level_m: float = 1.0
    """Change of altitude above which a return climbs or descends before it flies towards home."""

    return_last_leg_m: float = 0.5
    """Distance from home within which the drone has reached it. The last leg ends when the drone has also settled there."""

    landing_radius_m: float = 0.15
    """Distance from home within which a drone that is slower than `settled_mps` has settled, and lands."""

    max_route_attempts: int = 3
    """Number of attempts to fly around zones if the autopilot refuses.

    After that the drone returns on the path it flew (SmartRTL), and if that is refused too, straight (RTL).
"""

    transit_arming_timeout_s: float = 120.0
    """Seconds for which the system tries to arm a drone whose autopilot refuses."""

    default_takeoff_altitude_m: float = 10.0
    """Altitude above home to which the system takes off if the target has no altitude."""

    poi_check_interval_s: float = 0.5
    """Seconds after which the service checks again if a mission can start."""

    poi_stay_s: float = 5.0
    """Seconds for which the drone stays at a point of interest, if passengers may use services only there."""

    # Monitor

    monitor_interval_s: float = 0.1
    """Longest time between two checks in flight, in seconds of the vehicle's clock.

    Each position also starts a check (20 Hz).
    """

    monitor_idle_interval_s: float = 0.5
    """Longest time between two iterations on the ground."""

    record_interval_s: float = 0.5
    """Seconds between two entries of the flight recorder."""

    correction_timeout_s: float = 3.0
    """Seconds within which a correction must take effect before the same alarm is raised again."""

    grant_change_s: float = 30.0
    """Seconds after a change of the constraints for which a drone may still accelerate on a leg judged before the change."""

    movement_timeout_s: float = 2.0
    """Seconds within which a drone starts to move after a command.

    A drone that keeps its position longer does not follow the command.
    """

    # gRPC streams

    stream_check_interval_s: float = 0.5
    """Longest time between two checks for a waiting caller.

    The checks are needed because a change of the autopilot's readiness does not wake the task of the caller.
    """

    ping_interval_s: float = 1.0
    """Seconds between liveness requests to a driver with control. It is also the longest wait for the next event of a lease."""

    second_stream_wait_s: float = 6.0
    """Seconds for which a second control stream of a driver waits for the end of the first one before it is refused.

    It is longer than the 4 s after which the gRPC server disconnects a client that does not reply to pings.
    """

    failsafe_status_timeout_s: float = 10.0
    """Longest time for which a drone hovers in the air until it is known if the autopilot records its path."""

    silent_driver_s: float = 30.0
    """Time without a motion call, and without a motion in progress, after which a second process may replace a driver.

    Only drivers without liveness requests are replaced. All other drivers lose control when they do not answer.
    """

    telemetry_min_interval_s: float = 0.05
    """Shortest interval of a telemetry stream."""

    telemetry_default_interval_s: float = 0.2
    """Interval of a telemetry stream if the request has none."""

    arm_response_reserve_s: float = 1.0
    """Seconds before the deadline of an Arm call at which it is answered, so that the caller receives the refusal."""

    telemetry_judge_interval_s: float = 0.5
    """Seconds between judgements of a telemetry stream, so that a revoked grant ends the stream within a second."""


SETTINGS = MobilitySettings()
"""The settings of this process."""
