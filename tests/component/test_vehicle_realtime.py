"""Real-time loop of the vehicle: few wake-ups, and short response times despite few wake-ups."""

from __future__ import annotations

import itertools
import math
import socket

import pytest
from fractus_runtime.mavlink_codec import Endpoint, Parser
from fractus_services.mavlink_server.channel import Channel
from fractus_vehicle import __main__ as realtime
from fractus_vehicle.links import Hub
from fractus_vehicle.simulation import Craft, Simulation
from vehicle_world import CONFIG

STEP_S = 0.01
GETTING_UP_S = 0.0003


class Clock:
    """Fake clock that advances only while the loop sleeps, and slightly at each wake-up."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.wakes = 0

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, duration_s: float) -> None:
        self.now_s += duration_s + GETTING_UP_S
        self.wakes += 1


class Line(Hub):
    """Fake link. The remote end sends bytes at given times, and records when messages arrive."""

    def __init__(self, clock: Clock, craft: Craft, letters: dict[float, bytes]) -> None:
        super().__init__()
        self.clock = clock
        self.craft = craft
        self.letters = {clock.now_s + at_s: data for at_s, data in letters.items()}
        self.channel: Channel = craft.open("line")
        self.parser = Parser()
        self.received: list[tuple[float, float, str]] = []
        self.flushes: list[float] = []

    def wait(self, timeout_s: float) -> bool:
        """Wait for data. The timeout is rounded down to whole milliseconds, as in Hub."""
        end_s = self.clock.now_s + math.floor(max(timeout_s, 0.0) * 1e3) / 1e3
        first_s = min(self.letters, default=math.inf)
        self.clock.wakes += 1
        self.clock.now_s = max(min(first_s, end_s), self.clock.now_s)
        return first_s <= end_s

    def poll(self, timeout_s: float = 0.0) -> None:
        for at_s in [at_s for at_s in self.letters if at_s <= self.clock.now_s]:
            self.craft.receive(self.channel, self.letters.pop(at_s))

    def flush(self) -> None:
        self.flushes.append(self.clock.now_s)
        for message in self.parser.feed(self.channel.take()):
            self.received.append((self.clock.now_s - 1000.0, self.craft.vehicle.state.time_s, message.name))


def _command(number: int, *parameters: float) -> bytes:
    values = {f"param{at}": value for at, value in enumerate(parameters, 1)}
    target = {"target_system": 1, "target_component": 1}
    return Endpoint(255, 190).encode("COMMAND_LONG", target | {"command": number} | values)


def _ran(
    monkeypatch: pytest.MonkeyPatch, letters: dict[float, bytes], speedup: float = 1.0, step_takes_s: float = 0.0
) -> tuple[Line, Simulation]:
    clock = Clock()
    monkeypatch.setattr(realtime, "time", clock)
    simulation = Simulation([CONFIG])
    step = simulation.step

    def slow_step() -> None:
        clock.now_s += step_takes_s
        step()

    monkeypatch.setattr(simulation, "step", slow_step)
    line = Line(clock, simulation.crafts[0], letters)
    realtime.run(simulation, line, speedup, realtime._Stop(), 10.0)
    line.close()
    return line, simulation


def test_loop_of_quiet_vehicle_wakes_rarely_and_keeps_time(monkeypatch: pytest.MonkeyPatch):
    line, simulation = _ran(monkeypatch, {})
    assert line.clock.wakes <= 2 * 10.0 / STEP_S / realtime.MAX_NAP + 20
    assert line.clock.now_s - 1000.0 == pytest.approx(simulation.time_s, abs=(realtime.MAX_NAP + 1) * STEP_S)


def test_stream_messages_are_sent_in_their_due_step(monkeypatch: pytest.MonkeyPatch):
    requests = b"".join(_command(511, number, us) for number, us in ((30, 70_000), (32, 110_000), (33, 250_000)))
    line, _ = _ran(monkeypatch, {3.0: requests})
    for name, interval_s in (("ATTITUDE", 0.07), ("LOCAL_POSITION_NED", 0.11), ("GLOBAL_POSITION_INT", 0.25)):
        sent = [(wall_s, time_s) for wall_s, time_s, message_name in line.received if message_name == name]
        assert len(sent) == pytest.approx(7.0 / interval_s, abs=2)
        assert all(-1e-6 < wall_s - time_s < 0.001 for wall_s, time_s in sent)
        gaps = [after[1] - before[1] for before, after in itertools.pairwise(sent)]
        # The first message is sent with the acknowledgement, one step after the request was received.
        assert gaps[1:] == pytest.approx([interval_s] * (len(gaps) - 1), abs=1e-6)


@pytest.mark.parametrize("speedup", [1.0, 5.0, 0.5])
@pytest.mark.parametrize("at_s", [1.0, 1.0031, 1.0149, 1.0271, 1.0399])
def test_response_is_sent_in_the_next_step(monkeypatch: pytest.MonkeyPatch, at_s: float, speedup: float):
    line, _ = _ran(monkeypatch, {at_s: _command(512, 148)}, speedup)
    (acknowledged_s,) = [wall_s for wall_s, _, name in line.received if name == "COMMAND_ACK"]
    assert 0.0 <= acknowledged_s - at_s <= STEP_S / speedup + 0.0015


@pytest.mark.parametrize("step_takes_s", [0.002, 0.0075, 0.009])
def test_loop_on_busy_machine_keeps_up(monkeypatch: pytest.MonkeyPatch, step_takes_s: float):
    letters = {0.007 * at: _command(512, 148) for at in range(1500)}
    line, simulation = _ran(monkeypatch, letters, step_takes_s=step_takes_s)
    gaps = [after - before for before, after in itertools.pairwise(line.flushes)]
    assert max(gaps) < 2.5 * STEP_S
    assert line.clock.now_s - 1000.0 == pytest.approx(simulation.time_s, abs=(realtime.MAX_NAP + 1) * STEP_S)


def test_hub_wait_leaves_data_for_poll():
    hub = Hub()
    near, far = socket.socketpair()
    received: list[bytes] = []
    hub.watch(near.fileno(), lambda: received.append(near.recv(9)))
    assert not hub.wait(0.002)
    assert not hub.wait(-1.0)
    far.send(b"x")
    assert hub.wait(20.0)
    assert not received
    hub.poll()
    assert received == [b"x"]
    hub.close()
    near.close()
    far.close()
