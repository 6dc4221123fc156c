"""Kinematics: how far a drone travels before it can stop, and the ground that a leg sweeps."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import shapely
from shapely.geometry.base import BaseGeometry

from fractus_core.geo import LocalFrame
from fractus_core.policy.decision_types import STATIONARY_MPS, Airframe, Situation, VelocityArgs

XY = tuple[float, float]

_TURNING = (0.25, 0.5, 0.75)
"""Fractions of a turn at which a stop is evaluated."""

OVERSHOOT_SHARE = 0.35
"""Fraction of the stopping distance by which a drone that turns in flight may overshoot its target."""


def stopping_distance_m(speed_mps: float, accel_mps2: float, position_gain: float) -> float:
    """Return the distance in which ArduPilot's position controller stops from a speed.

    The controller limits the speed by a square-root function of the distance. The distance is v/kP while v < a/kP,
    otherwise a/(2 kP^2) + v^2/(2 a).
    """
    speed = abs(speed_mps)
    if speed < accel_mps2 / position_gain:
        return speed / position_gain
    return accel_mps2 / (2 * position_gain**2) + speed * speed / (2 * accel_mps2)


def reaction_s(situation: Situation, accel_mps2: float) -> float:
    """Return the seconds of unchanged speed before braking: latency plus half the time until full braking."""
    return situation.latency_s + accel_mps2 / (2 * situation.airframe.jerk_mps3)


def pending_outcomes(now: Situation, position: XY) -> list[tuple[XY, Situation]]:
    """Return the extreme states that the drone may reach before a new command takes effect.

    Until then, the drone may follow any of its pending velocity setpoints, with full acceleration. If it follows
    several of them in succession, its state lies between the returned states.

    Returns:
        Position in frame metres and situation, for each extreme case.
    """
    if not now.pending:
        return []
    airframe = now.airframe
    outcomes = []
    for north, east, down in _bounding_velocities(now.pending):
        dn, de = _velocity_change(
            (now.north_mps, now.east_mps), (north, east), airframe.accel_mps2, airframe.jerk_mps3, now.latency_s
        )
        climb, _ = _velocity_change(
            (now.down_mps, 0.0), (down, 0.0), airframe.climb_accel_mps2, airframe.jerk_mps3, now.latency_s
        )
        mean = (now.north_mps + dn / 2, now.east_mps + de / 2)
        outcome_position = position[0] + mean[1] * now.latency_s, position[1] + mean[0] * now.latency_s
        altitude_m = now.altitude_m - (now.down_mps + climb / 2) * now.latency_s
        outcome = replace(
            now, north_mps=now.north_mps + dn, east_mps=now.east_mps + de, down_mps=now.down_mps + climb,
            altitude_m=altitude_m, latency_s=0.0, forward_mps2=0.0, pending=(),
        )  # fmt: skip
        outcomes.append((outcome_position, outcome))
    return outcomes


def _velocity_change(present: XY, target_velocity: XY, accel: float, jerk: float, lasting_s: float) -> XY:
    """Return the change of a velocity toward a target velocity, including the change while the acceleration decays."""
    change = math.dist(present, target_velocity)
    share = min(accel * (lasting_s + accel / (2 * jerk)) / change, 1.0) if change > 0 else 0.0
    return (target_velocity[0] - present[0]) * share, (target_velocity[1] - present[1]) * share


MAX_PENDING_VELOCITIES = 4
"""If there are more pending velocities, the corners of their bounding box replace them."""


def _bounding_velocities(velocities: tuple[tuple[float, float, float], ...]) -> tuple[tuple[float, float, float], ...]:
    if len(velocities) <= MAX_PENDING_VELOCITIES:
        return velocities
    (south, north), (west, east), (up, down) = ((min(axis), max(axis)) for axis in zip(*velocities, strict=True))
    return (south, west, up), (south, east, down), (north, west, down), (north, east, up)


def situation_at_rest(now: Situation, grant_frame: LocalFrame, position: XY) -> Situation:
    """Return the situation after a drone that is commanded to stop now has come to rest."""
    lat, lon = grant_frame.latlon(*stop_point(now, position))
    return replace(
        now, lat=lat, lon=lon, altitude_m=stop_altitude_m(now), north_mps=0.0, east_mps=0.0, down_mps=0.0, pending=()
    )


@dataclass(frozen=True, slots=True)
class MotionBeforeReaction:
    """Motion of a drone before a command takes effect.

    Attributes:
        speed_mps: Speed when the command takes effect.
        run_m: Distance covered until then, including the time until braking takes effect.
    """

    speed_mps: float
    run_m: float


def motion_before_reaction(situation: Situation) -> MotionBeforeReaction:
    """Return the distance that a drone flies before it obeys a command, and the speed that it may have then.

    An accelerating drone keeps accelerating for the latency, and then until its jerk limit ends the acceleration. If
    its acceleration is unknown, full acceleration is assumed, unless the drone flies at its speed setpoint.
    """
    airframe = situation.airframe
    speed = math.hypot(situation.north_mps, situation.east_mps)
    braking_delay_s = airframe.accel_mps2 / (2 * airframe.jerk_mps3)
    forward = situation.forward_mps2
    if forward is None:
        forward = airframe.accel_mps2 if STATIONARY_MPS <= speed < situation.speed_setpoint_mps else 0.0
    elif forward < 0.0 and situation.is_pending_motion:
        forward = 0.0  # The drone may have stopped braking because of a pending setpoint.
    forward = min(max(forward, -airframe.accel_mps2), airframe.accel_mps2)
    if forward <= 0.0:
        # A braking drone keeps braking, so its speed is lower when the command takes effect.
        reduced = max(speed + forward * situation.latency_s, 0.0)
        braking_delay_s *= 1.0 + forward / airframe.accel_mps2
        return MotionBeforeReaction(reduced, (speed + reduced) / 2 * situation.latency_s + reduced * braking_delay_s)
    late_s = situation.latency_s
    jerk_limit_s = forward / airframe.jerk_mps3
    first = speed + forward * late_s
    last = first + forward * jerk_limit_s / 2
    run = (speed + first) / 2 * late_s + first * jerk_limit_s + forward * jerk_limit_s**2 / 3
    if situation.forward_mps2 is None and last > situation.speed_setpoint_mps:
        last = max(situation.speed_setpoint_mps, speed)
        run = min(run, last * (late_s + jerk_limit_s))
    return MotionBeforeReaction(last, run + last * braking_delay_s)


def stop_point(situation: Situation, position: XY) -> XY:
    """Return the point, in frame metres, where the drone comes to rest if it is commanded to stop now."""
    speed = math.hypot(situation.north_mps, situation.east_mps)
    # A velocity below the noise of GNSS has no meaningful direction.
    if speed < 0.05:
        return position
    airframe = situation.airframe
    reaction = motion_before_reaction(situation)
    run = reaction.run_m + stopping_distance_m(reaction.speed_mps, airframe.accel_mps2, airframe.position_gain)
    return position[0] + situation.east_mps / speed * run, position[1] + situation.north_mps / speed * run


def _turn(situation: Situation, position: XY, stop: XY, target: XY) -> tuple[XY, tuple[XY, ...]]:
    """Return the area that a drone may touch while it turns from its present velocity toward a target.

    While the velocity changes from v to w with an acceleration of size a, the drone flies a parabola: a Bezier curve of
    second degree whose middle control point lies v * T / 2 ahead, with T = |w - v| / a. The curve never leaves the
    triangle of its control points.

    A drone that is stopped during the turn comes to rest along its velocity at that moment, possibly outside the
    triangle.

    Args:
        situation: State of the drone.
        position: Its position in frame metres.
        stop: Its `stop_point`.
        target: Point to fly to.

    Returns:
        The middle corner of the triangle, and the points where a drone that is stopped during the turn comes to rest.
    """
    speed = math.hypot(situation.north_mps, situation.east_mps)
    if speed < STATIONARY_MPS:
        return stop, ()
    airframe = situation.airframe
    accel = airframe.accel_mps2
    reaction = motion_before_reaction(situation)
    ahead = (situation.east_mps / speed, situation.north_mps / speed)
    present = (ahead[0] * reaction.speed_mps, ahead[1] * reaction.speed_mps)
    toward = (0.0, 0.0)
    change = reaction.speed_mps
    for origin in (position, stop):
        dx = target[0] - origin[0]
        dy = target[1] - origin[1]
        distance = math.hypot(dx, dy)
        toward = (0.0, 0.0)
        if distance > 0:
            cruise = min(situation.speed_setpoint_mps, math.sqrt(2 * accel * distance))
            toward = (dx / distance * cruise, dy / distance * cruise)
        change = max(change, math.hypot(toward[0] - present[0], toward[1] - present[1]))
    slack = accel / (2 * airframe.position_gain**2)
    run = reaction.run_m + slack + reaction.speed_mps * change / (2 * accel)
    run = max(run, math.hypot(stop[0] - position[0], stop[1] - position[1]))
    corner = position[0] + ahead[0] * run, position[1] + ahead[1] * run
    # `toward` is now the velocity from the point where the drone comes to rest to the target.
    change_s = math.dist(present, toward) / accel
    stops = []
    for share in _TURNING:
        vx, vy = (p + (t - p) * share for p, t in zip(present, toward, strict=True))
        fast = math.hypot(vx, vy)
        if fast > 0:
            half_s = change_s * share / 2
            rest_s = reaction_s(situation, accel) + stopping_distance_m(fast, accel, airframe.position_gain) / fast
            x = position[0] + ahead[0] * reaction.run_m + (present[0] + vx) * half_s + vx * rest_s
            y = position[1] + ahead[1] * reaction.run_m + (present[1] + vy) * half_s + vy * rest_s
            stops.append((x, y))
    return corner, tuple(stops)


def stop_altitude_m(situation: Situation) -> float:
    """Return the altitude above home at which the drone comes to rest if it is commanded to stop now."""
    climb = -situation.down_mps
    if abs(climb) < 0.05:
        return situation.altitude_m
    accel = situation.airframe.climb_accel_mps2
    run = abs(climb) * reaction_s(situation, accel) + stopping_distance_m(climb, accel, 1.0)
    return situation.altitude_m + math.copysign(run, climb)


def altitude_range_to_stop_m(situation: Situation) -> tuple[float, float]:
    """Return the lowest and the highest altitude above home until the drone comes to rest."""
    rest_m = stop_altitude_m(situation)
    return min(situation.altitude_m, rest_m), max(situation.altitude_m, rest_m)


@dataclass(frozen=True)
class Leg:
    """A motion in frame metres from the drone's position, via its turning point, to a target.

    The drone may be anywhere in the triangle of present position, turning point and target, at any altitude between
    lower and upper, because autopilots control the axes independently.

    Attributes:
        start: Position of the drone.
        stop: Point where the drone comes to rest if it brakes now, on the way to `turn`.
        turn: Middle corner of the triangle in which the drone turns, or `stop` if it turns on the spot.
        target: End of the leg.
        lower_m: Lowest altitude above home on the leg.
        upper_m: Highest altitude above home on the leg.
        corners: Further points that the ground below includes.
        follows_velocity: True if the leg results from a velocity setpoint and its target was not requested.
    """

    start: XY
    stop: XY
    turn: XY
    target: XY
    lower_m: float
    upper_m: float
    corners: tuple[XY, ...] = ()
    follows_velocity: bool = False

    @cached_property
    def ground(self) -> BaseGeometry:
        """Ground below the leg: a triangle, a line or a point."""
        start = self.start
        turn = self.turn
        target = self._beyond
        if self.corners:
            return shapely.convex_hull(shapely.multipoints((start, turn, self.target, target, *self.corners)))
        if start == turn:
            return shapely.points(start) if start == target else shapely.linestrings((start, target))
        if turn == target:
            return shapely.linestrings((start, turn))
        doubled = (turn[0] - start[0]) * (target[1] - start[1]) - (turn[1] - start[1]) * (target[0] - start[0])
        if abs(doubled) < 1e-6:
            return shapely.convex_hull(shapely.multipoints((start, turn, target)))
        return shapely.polygons((start, turn, target))

    @property
    def _beyond(self) -> XY:
        """Farthest point beyond the target that a drone may reach, because a drone that turns in flight overshoots."""
        if self.follows_velocity:
            return self.target
        tx, ty = self.turn
        x, y = self.target
        along = math.hypot(x - tx, y - ty)
        over = OVERSHOOT_SHARE * math.hypot(self.stop[0] - self.start[0], self.stop[1] - self.start[1])
        if over == 0 or along < 1e-6:
            return self.target
        return x + (x - tx) / along * over, y + (y - ty) / along * over

    @cached_property
    def braking_path(self) -> BaseGeometry:
        """Line from the drone to the point where it comes to rest if it brakes now.

        No command can shorten this part of the leg.
        """
        return shapely.points(self.start) if self.start == self.stop else shapely.linestrings((self.start, self.stop))

    @cached_property
    def line(self) -> BaseGeometry:
        """Straight line to the target from the point where the drone comes to rest if it brakes now."""
        return shapely.points(self.stop) if self.stop == self.target else shapely.linestrings((self.stop, self.target))


def vertical_leg(position: XY, lower_m: float, upper_m: float) -> Leg:
    """Return the leg of a drone that stays above one point."""
    return Leg(position, position, position, position, lower_m, upper_m)


def goto_leg(now: Situation, position: XY, target: XY, altitude_m: float) -> Leg:
    """Return the leg of a drone that turns toward a target and flies to it, at an altitude above home.

    Before it turns, the drone may take up any pending velocity setpoint.
    """
    altitudes = [now.altitude_m, stop_altitude_m(now), altitude_m]
    stop = stop_point(now, position)
    turn, corners = _turn(now, position, stop, target)
    for outcome_position, outcome in pending_outcomes(now, position):
        outcome_stop = stop_point(outcome, outcome_position)
        outcome_turn, stops = _turn(outcome, outcome_position, outcome_stop, target)
        corners += (outcome_position, outcome_turn, *stops)
        altitudes += (outcome.altitude_m, stop_altitude_m(outcome))
    return Leg(position, stop, turn, target, min(altitudes), max(altitudes), corners)


def velocity_leg(now: Situation, position: XY, args: VelocityArgs) -> Leg:
    """Return the leg of a drone that changes to a velocity, keeps it for the hold time, and stops.

    Latency may delay the beginning of the motion, its end, or neither. The ground of the leg is the convex hull of the
    drone's positions in all three cases. The target is the point where the drone comes to rest in the case that ends
    last.
    """
    airframe = now.airframe
    reaction = motion_before_reaction(now)
    target_velocity = (args.east_mps, args.north_mps)
    speed = math.hypot(now.north_mps, now.east_mps)
    ahead = (now.east_mps / speed, now.north_mps / speed) if speed > 0 else (0.0, 0.0)
    present = (ahead[0] * reaction.speed_mps, ahead[1] * reaction.speed_mps)
    lasting_s = args.hold_s + now.latency_s
    control = (airframe.accel_mps2, airframe.position_gain)
    # If the drone obeys at once, its initial speed is lowest and it flies farthest in the new direction.
    known = now.forward_mps2 is not None and not now.pending
    braked = reaction.speed_mps if known else speed - airframe.accel_mps2 * now.latency_s
    slowest = max(min(speed, braked), 0.0)
    positions = _displacements((ahead[0] * slowest, ahead[1] * slowest), target_velocity, lasting_s, airframe, control)
    late = (ahead[0] * reaction.run_m, ahead[1] * reaction.run_m)
    positions += [
        (x + late[0], y + late[1]) for x, y in _displacements(present, target_velocity, lasting_s, airframe, control)
    ]
    climb = -now.down_mps
    climbs = _displacements((climb, 0.0), (-args.down_mps, 0.0), lasting_s, airframe, (airframe.climb_accel_mps2, 1.0))
    late_m = climb * reaction_s(now, airframe.climb_accel_mps2)
    climbs += [(up + late_m, 0.0) for up, _ in climbs]
    for (x, y), other in pending_outcomes(now, (0.0, 0.0)):
        displacements = _displacements((other.east_mps, other.north_mps), target_velocity, lasting_s, airframe, control)
        positions[:0] = [(x, y), stop_point(other, (x, y)), *((x + dx, y + dy) for dx, dy in displacements)]
        rise = other.altitude_m - now.altitude_m
        displacements = _displacements(
            (-other.down_mps, 0.0), (-args.down_mps, 0.0), lasting_s, airframe, (airframe.climb_accel_mps2, 1.0)
        )
        climbs += [
            (rise, 0.0),
            (stop_altitude_m(other) - now.altitude_m, 0.0),
            *((rise + up, 0.0) for up, _ in displacements),
        ]
    heights = [now.altitude_m, stop_altitude_m(now), *(now.altitude_m + climb for climb, _ in climbs)]
    corners = tuple((position[0] + x, position[1] + y) for x, y in positions)
    stop = stop_point(now, position)
    return Leg(position, stop, stop, corners[-1], min(heights), max(heights), corners, follows_velocity=True)


def _displacements(
    present: XY, target_velocity: XY, lasting_s: float, airframe: Airframe, control: tuple[float, float]
) -> list[XY]:
    """Return displacements whose hull contains the motion from one velocity to another and to rest.

    The last displacement leads to the point where the drone comes to rest.
    """
    accel, gain = control
    change_s = math.dist(present, target_velocity) / accel
    points = []
    for share in (0.25, 0.5, 0.75, 1.0):
        turning_s = min(change_s * share, lasting_s)
        done = turning_s / change_s if change_s > 0 else 1.0
        vx, vy = (p + (w - p) * done for p, w in zip(present, target_velocity, strict=True))
        half = turning_s / 2
        points.append((present[0] * half, present[1] * half))
        x = (present[0] + vx) * half
        y = (present[1] + vy) * half
        speed = math.hypot(vx, vy)
        if share == 1.0:
            points.append((x, y))
            x = x + vx * (lasting_s - turning_s)
            y = y + vy * (lasting_s - turning_s)
        if speed > 0:
            run = accel / (2 * airframe.jerk_mps3) + stopping_distance_m(speed, accel, gain) / speed
            x = x + vx * run
            y = y + vy * run
        points.append((x, y))
    return points
