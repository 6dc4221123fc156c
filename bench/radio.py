"""The simulated radio beside ns-3's 802.11g ad hoc model: what UDP carries between two stations, in one table.

Where the wheel `ns3` (pip install ns3, 518 MB) and a C++ compiler are there, radio.cc is compiled against it and runs the same
scenes; otherwise the table has the figures that it gave before, with ns-3 3.44. Compiling takes a minute.

uv run python bench/radio.py [--quick] [--json FILE]
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import shutil
import subprocess
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from fractus_radio.medium import Medium, Station
from fractus_radio.propagation import Propagation

MODULES = ("core", "internet", "mobility", "network", "propagation", "wifi")
POWER_DBM = 16.02
EXPONENT = 3.0
FADING = 1.5
HEADERS_BYTES = 8 + 20 + 14
TOLERANCE = 0.15
SLACK_MBPS = 0.15
"""A row holds within this share of ns-3's figure, or this many Mbit/s: at the soft edge next to nothing arrives."""


@dataclass(frozen=True, slots=True)
class Scene:
    """Two stations, of which one or both send all the time.

    Attributes:
        name: of the row.
        recorded: Mbit/s that ns-3 3.44 gave.
        size: UDP payload, bytes.
        both: whether both send.
    """

    name: str
    distance_m: float
    propagation: Propagation
    recorded: float
    size: int = 1400
    both: bool = False


HARD = Propagation(POWER_DBM, EXPONENT)
SOFT = Propagation(POWER_DBM, EXPONENT, FADING)
DECLARED = Propagation.reaching(80.0)
SCENES = (
    Scene("10 m", 10, HARD, 14.67),
    Scene("50 m", 50, HARD, 14.66),
    Scene("52 m, out of reach", 52, HARD, 0.0),
    Scene("10 m, 800 bytes", 10, HARD, 11.38, size=800),
    Scene("10 m, 200 bytes", 10, HARD, 4.43, size=200),
    Scene("10 m, both send", 10, HARD, 15.09, both=True),
    Scene("79 m of 80 m declared", 79, DECLARED, 14.66),
    Scene("81 m of 80 m declared", 81, DECLARED, 0.0),
    Scene("10 m, soft edge", 10, SOFT, 14.65),
    Scene("30 m, soft edge", 30, SOFT, 11.23),
    Scene("40 m, soft edge", 40, SOFT, 5.26),
    Scene("50 m, soft edge", 50, SOFT, 1.07),
    Scene("60 m, soft edge", 60, SOFT, 0.37),
    Scene("70 m, soft edge", 70, SOFT, 0.13),
)


def ours(scene: Scene, seconds: float) -> float:
    """Mbit/s of payload that arrive in the model of `fractus_radio`."""
    medium = Medium(scene.propagation, 1)
    addresses = {"a": b"\x02aaaaa", "b": b"\x02bbbbb"}
    for name, east in (("a", 0.0), ("b", scene.distance_m)):
        medium.add(name, Station((east, 0.0, 0.0), addresses[name], "net"))
    frames = {
        name: addresses[other] + addresses[name] + b"\x08\x00" + bytes(scene.size + HEADERS_BYTES - 14)
        for name, other in (("a", "b"), ("b", "a"))
    }
    now_s = 0.0
    arrived = 0
    while now_s < seconds:
        for name in ("a", "b") if scene.both else ("a",):
            while len(medium.stations[name].queue) < 10:
                medium.offer(name, frames[name], now_s)
        now_s = medium.next_s
        arrived += sum(1 for _ in medium.advance(now_s))
    return arrived * scene.size * 8 / seconds / 1e6


def compiled(folder: Path) -> tuple[Path | None, str]:
    """radio.cc compiled against ns-3's wheel; None, and why, where it cannot be."""
    found = importlib.util.find_spec("ns3")
    if found is None or not found.submodule_search_locations:
        return None, "there is no ns-3 (pip install ns3)"
    home = Path(next(iter(found.submodule_search_locations)))
    libraries = home / "lib64"
    cores = list(libraries.glob("libns3*-core.so"))
    compiler = shutil.which("g++")
    if compiler is None or not cores:
        return None, "there is no g++" if compiler is None else f"{libraries} has no library of ns-3"
    prefix = cores[0].name.removeprefix("lib").removesuffix("-core.so")
    program = folder / "radio"
    command = [
        compiler, "-std=c++20", "-O1", f"-I{home / 'include'}", str(Path(__file__).with_suffix(".cc")), "-o", str(program),
        f"-L{libraries}", f"-Wl,-rpath,{libraries}", "-Wl,--allow-shlib-undefined",
        *(f"-l{prefix}-{module}" for module in MODULES),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=900, check=False)
    if done.returncode:
        return None, f"radio.cc does not compile: {done.stderr.strip().splitlines()[-1]}"
    return program, ""


def run_ns3(program: Path, scene: Scene, seconds: float) -> float:
    """Mbit/s of payload that arrive in ns-3."""
    air = scene.propagation
    words = (scene.distance_m, air.exponent, air.power_dbm, air.fading or 0, scene.size, int(scene.both), seconds)
    command = [str(program), *map(str, words)]
    return float(subprocess.run(command, capture_output=True, text=True, timeout=600, check=True).stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="simulate shorter, and do not run ns-3")
    parser.add_argument("--json", type=Path, help="write the claims to this file")
    options = parser.parse_args()
    seconds = 3.0 if options.quick else 10.0
    with ExitStack() as stack:
        program = None
        why = "not with --quick"
        if not options.quick:
            program, why = compiled(Path(stack.enter_context(tempfile.TemporaryDirectory())))
        if program is None:
            print(f"ns-3 is not run: {why}; its figures are recorded ones.\n")
        claims = []
        for scene in SCENES:
            their = run_ns3(program, scene, seconds) if program is not None else scene.recorded
            claims.append(claim(scene, ours(scene, seconds), their))
    if options.json:
        options.json.write_text(json.dumps({"claims": claims}, indent=2) + "\n")


def claim(scene: Scene, our: float, their: float) -> dict[str, object]:
    """A row of the table."""
    holds = math.isclose(our, their, rel_tol=TOLERANCE, abs_tol=SLACK_MBPS)
    print(f"{scene.name:28} ours {our:6.2f}   ns-3 {their:6.2f} Mbit/s   {'holds' if holds else 'FAILS'}", flush=True)
    return {
        "name": f"radio: {scene.name}", "ours": our, "theirs": their, "unit": "Mbit/s",
        "ratio": our / their if their else 1.0, "target": f"within {TOLERANCE:.0%}", "holds": holds,
    }  # fmt: skip


if __name__ == "__main__":
    main()
