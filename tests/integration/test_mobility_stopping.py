"""A mobility service that is stopped after a landing leaves the vehicle as its owner configured it."""

from __future__ import annotations

import signal

from fractus_cluster.ports import free_port
from fractus_proto.v1 import mobility_pb2 as pb
from mobility_rig import HOME, Driver, Rig, grant
from owner_settings import parameter_arguments, read_settings, upload_lists

FAILSAFES = {"FS_GCS_ENABLE", "SYSID_MYGCS", "BATT_FS_LOW_ACT", "FS_EKF_THRESH"}
"""Settings that stay, because the drone must come home if its service fails."""


async def test_service_stopped_right_after_landing_restores_owner_fence_and_parameters(rig: Rig) -> None:
    guest = f"tcp:127.0.0.1:{free_port()}"
    rig.start_vehicle(4.0, "--listen", guest, *parameter_arguments())
    rig.write_grant(grant())
    rig.start_service()
    await rig.until(lambda state: state.ready)
    upload_lists(guest, HOME[:2])
    owner = read_settings(guest)
    driver = Driver(rig)
    await driver.up(3.0)
    assert {"fence.json", "return.json"} <= {path.name for path in (rig.directory / "state").iterdir()}
    await driver.stub.ReturnControl(pb.ReturnControlRequest(), timeout=10)
    await rig.until(lambda state: not state.armed)
    rig.send_signal("service", signal.SIGTERM)
    assert await rig.ended("service", 30.0) == 0
    now = read_settings(guest)
    changed = set(owner.changed_parameters(now))
    assert changed <= FAILSAFES
    assert now.fence == owner.fence
    assert now.rally == owner.rally
