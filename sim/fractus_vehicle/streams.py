"""Telemetry messages and their grouping into ArduCopter's streams."""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fractus_vehicle import motion_reports, sensor_reports, status_reports
from fractus_vehicle.report_units import Builder

BUILDERS: dict[str, Builder] = {
    "HEARTBEAT": status_reports.heartbeat,
    "GLOBAL_POSITION_INT": motion_reports.global_position_int,
    "LOCAL_POSITION_NED": motion_reports.local_position_ned,
    "ATTITUDE": motion_reports.attitude,
    "ATTITUDE_QUATERNION": motion_reports.attitude_quaternion,
    "ATTITUDE_TARGET": motion_reports.attitude_target,
    "VFR_HUD": motion_reports.vfr_hud,
    "GIMBAL_DEVICE_ATTITUDE_STATUS": motion_reports.gimbal_device_attitude_status,
    "GIMBAL_MANAGER_INFORMATION": motion_reports.gimbal_manager_information,
    "SYS_STATUS": status_reports.sys_status,
    "BATTERY_STATUS": sensor_reports.battery_status,
    "GPS_RAW_INT": sensor_reports.gps_raw_int,
    "GPS2_RAW": sensor_reports.gps2_raw,
    "HOME_POSITION": motion_reports.home_position,
    "GPS_GLOBAL_ORIGIN": motion_reports.gps_global_origin,
    "EKF_STATUS_REPORT": sensor_reports.ekf_status_report,
    "EXTENDED_SYS_STATE": status_reports.extended_sys_state,
    "AUTOPILOT_VERSION": status_reports.autopilot_version,
    "MISSION_CURRENT": status_reports.mission_current,
    "MISSION_ITEM_REACHED": status_reports.mission_item_reached,
    "RELAY_STATUS": status_reports.relay_status,
    "RAW_IMU": sensor_reports.raw_imu,
    "SCALED_IMU2": sensor_reports.scaled_imu2,
    "SCALED_IMU": sensor_reports.scaled_imu2,
    "SCALED_IMU3": sensor_reports.scaled_imu3,
    "SCALED_PRESSURE": sensor_reports.scaled_pressure,
    "SCALED_PRESSURE2": sensor_reports.scaled_pressure,
    "HWSTATUS": status_reports.hwstatus,
    "SIM_STATE": motion_reports.sim_state,
    "HIGH_LATENCY2": motion_reports.high_latency2,
    "POWER_STATUS": status_reports.power_status,
    "MEMINFO": status_reports.meminfo,
    "NAV_CONTROLLER_OUTPUT": motion_reports.nav_controller_output,
    "FENCE_STATUS": status_reports.fence_status,
    "POSITION_TARGET_GLOBAL_INT": motion_reports.position_target_global_int,
    "POSITION_TARGET_LOCAL_NED": motion_reports.position_target_local_ned,
    "SERVO_OUTPUT_RAW": sensor_reports.servo_output_raw,
    "RC_CHANNELS": sensor_reports.rc_channels,
    "AHRS": sensor_reports.ahrs,
    "AHRS2": motion_reports.ahrs2,
    "SIMSTATE": motion_reports.simstate,
    "SYSTEM_TIME": status_reports.system_time,
    "WIND": sensor_reports.wind,
    "VIBRATION": sensor_reports.vibration,
    "TERRAIN_REPORT": motion_reports.terrain_report,
    "ESC_TELEMETRY_1_TO_4": sensor_reports.esc_telemetry,
    "ALTITUDE": motion_reports.altitude,
}

# Messages that ArduCopter supports. It sends them only with a device or in a state that is not simulated.
SILENT = frozenset(
    [
        "ADSB_VEHICLE",
        "AIS_VESSEL",
        "AIRSPEED",
        "AOA_SSA",
        "CAMERA_CAPTURE_STATUS",
        "CAMERA_FEEDBACK",
        "CAMERA_FOV_STATUS",
        "CAMERA_INFORMATION",
        "CAMERA_SETTINGS",
        "DISTANCE_SENSOR",
        "EFI_STATUS",
        "GENERATOR_STATUS",
        "GIMBAL_MANAGER_STATUS",
        "GPS2_RTK",
        "GPS_RTK",
        "MAG_CAL_PROGRESS",
        "MAG_CAL_REPORT",
        "OPTICAL_FLOW",
        "PARAM_VALUE",
        "PID_TUNING",
        "RANGEFINDER",
        "RC_CHANNELS_RAW",
        "RC_CHANNELS_SCALED",
        "RPM",
        "SCALED_PRESSURE3",
        "SERVO_OUTPUT_RAW",
        "TERRAIN_REQUEST",
        "UAVIONIX_ADSB_OUT_STATUS",
        "WINCH_STATUS",
    ]
)

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
