"""Command-line arguments of `fractus-vehicle`: numbers, links and the parameter file."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from click.testing import CliRunner
from fractus_vehicle.__main__ import vehicle
from fractus_vehicle.links import Hub, LinkError, LinkSpec
from fractus_vehicle.params import Parameters, ParameterValueError
from fractus_vehicle.simulation import Craft
from vehicle_world import CONFIG


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--heading", "nan"], "finite"),
        (["--speedup", "nan"], "finite"),
        (["--speedup", "inf"], "finite"),
        (["--ready-after", "nan"], "finite"),
        (["--duration", "nan"], "finite"),
        (["--spacing", "inf"], "--spacing"),
        (["--wind", "3,nan"], "expected SPEED,DIR"),
        (["--sysid", "240", "--count", "20"], "system ids must not exceed 250"),
    ],
)
def test_invalid_option_values_are_reported(arguments: list[str], words: str):
    done = CliRunner().invoke(vehicle, arguments)
    assert done.exit_code in (1, 2)
    assert words in done.output


def test_formation_beyond_last_port_is_refused():
    assert LinkSpec.parse("tcp:127.0.0.1:65525").shifted(1).port == 65535
    with pytest.raises(LinkError, match="use a lower first port"):
        LinkSpec.parse("tcp:127.0.0.1:65525").shifted(2)


def test_pseudo_terminal_does_not_replace_file(tmp_path: Path):
    parameter_file = tmp_path / "kept"
    parameter_file.write_text("mine")
    hub = Hub()
    with pytest.raises(LinkError, match="use another path"):
        hub.open(LinkSpec.parse(f"pty:{parameter_file}"), Craft(CONFIG), 0)
    hub.close()
    assert parameter_file.read_text() == "mine"


def test_parameter_values_out_of_range_are_limited():
    assert Parameters({"WPNAV_SPEED": 1e300})["WPNAV_SPEED"] == pytest.approx(3.4028234e38)
    assert Parameters({"MIS_RESTART": -math.inf})["MIS_RESTART"] == -128.0
    with pytest.raises(ParameterValueError, match="WPNAV_SPEED"):
        Parameters({"WPNAV_SPEED": math.nan})


@pytest.mark.parametrize("content", [b"a letter to someone\n", b"WPNAV_SPEED,fast\n", b"\xff\xfe"])
def test_file_without_parameters_is_neither_read_nor_replaced(content: bytes, tmp_path: Path):
    store = tmp_path / "store"
    store.write_bytes(content)
    with pytest.raises(ParameterValueError, match="NAME,VALUE"):
        Parameters(store=store)
    store.write_text("WPNAV_SPEED,700\nOF_ANOTHER_RELEASE,1\n")
    assert Parameters(store=store)["WPNAV_SPEED"] == 700.0


def test_every_vehicle_of_a_formation_is_announced():
    options = ["--count", "3", "--listen", "udpout:127.0.0.1:26000", "--duration", "0.1", "--speedup", "0"]
    done = CliRunner().invoke(vehicle, options)
    assert done.stderr.splitlines() == [
        f"vehicle {i + 1} ready for connections on udpout:127.0.0.1:{26000 + i}" for i in range(3)
    ]
