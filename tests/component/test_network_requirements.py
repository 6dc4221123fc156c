"""Requirements of simulated networks."""

from __future__ import annotations

import os
import shutil

import pytest
from fractus_cluster.errors import ClusterError
from fractus_sim.errors import ExperimentError
from fractus_sim.testbeds import node_networks
from fractus_sim.testbeds.node_networks import NetworksUnavailable, require_networks


@pytest.fixture
def root(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(shutil, "which", lambda program: f"/sbin/{program}")


@pytest.mark.usefixtures("root")
def test_networks_are_unavailable_without_root(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(NetworksUnavailable, match="run the test as root"):
        require_networks()


@pytest.mark.usefixtures("root")
def test_networks_are_unavailable_without_a_program(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda program: None if program == "ip" else f"/sbin/{program}")
    with pytest.raises(NetworksUnavailable, match="need ip; install util-linux and iproute2"):
        require_networks()


@pytest.mark.usefixtures("root")
def test_timeout_of_a_machine_with_networks_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def run(*_: object, **__: object) -> None:
        raise ClusterError("unshare --net ip tuntap ... did not end within 30 s")

    monkeypatch.setattr(node_networks, "run", run)
    with pytest.raises(ExperimentError, match="did not end within 30 s") as error:
        require_networks()
    assert not isinstance(error.value, NetworksUnavailable), "a test must not be skipped"
