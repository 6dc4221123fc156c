"""Grouping of telemetry messages into the streams of ArduCopter that REQUEST_DATA_STREAM selects."""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as mavlink

# MAV_DATA_STREAM groups of ArduCopter, with the suffix of their SRn_ parameter.
GROUPS: dict[int, tuple[str, tuple[str, ...]]] = {
    mavlink.MAV_DATA_STREAM_RAW_SENSORS: (
        "RAW_SENS",
        ("RAW_IMU", "SCALED_IMU2", "SCALED_IMU3", "SCALED_PRESSURE", "SCALED_PRESSURE2"),
    ),
    mavlink.MAV_DATA_STREAM_EXTENDED_STATUS: (
        "EXT_STAT",
        (
            "SYS_STATUS",
            "POWER_STATUS",
            "MEMINFO",
            "MISSION_CURRENT",
            "GPS_RAW_INT",
            "GPS2_RAW",
            "NAV_CONTROLLER_OUTPUT",
            "FENCE_STATUS",
            "POSITION_TARGET_GLOBAL_INT",
        ),
    ),
    mavlink.MAV_DATA_STREAM_RC_CHANNELS: ("RC_CHAN", ("SERVO_OUTPUT_RAW", "RC_CHANNELS")),
    mavlink.MAV_DATA_STREAM_RAW_CONTROLLER: ("RAW_CTRL", ()),
    mavlink.MAV_DATA_STREAM_POSITION: ("POSITION", ("GLOBAL_POSITION_INT", "LOCAL_POSITION_NED")),
    mavlink.MAV_DATA_STREAM_EXTRA1: ("EXTRA1", ("ATTITUDE", "SIMSTATE", "AHRS2")),
    mavlink.MAV_DATA_STREAM_EXTRA2: ("EXTRA2", ("VFR_HUD",)),
    mavlink.MAV_DATA_STREAM_EXTRA3: (
        "EXTRA3",
        (
            "AHRS",
            "WIND",
            "SYSTEM_TIME",
            "TERRAIN_REPORT",
            "BATTERY_STATUS",
            "EKF_STATUS_REPORT",
            "VIBRATION",
            "ESC_TELEMETRY_1_TO_4",
        ),
    ),
    # The ADSB stream has no group number, but has a rate parameter.
    -1: ("ADSB", ()),
}
ALL_GROUPS = tuple(GROUPS)
