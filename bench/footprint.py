"""What Fractus takes of a drone's companion computer in flight: memory of agent, mobility and camera.

The three run from their images as containers do, each in a root of its own over the layers that they share, with the commands
and settings of the chart, an API server, the simulated vehicle and its camera. A component flies around a square and takes a
picture a second; on one side of it faces are hidden. Memory is the proportional set size, which counts what is shared once.

Beside it: MAVProxy on a link to the same vehicle, and the agent of k3s as its documentation has it for a Raspberry Pi 4
(https://docs.k3s.io/reference/resource-profiling, v1.26.5, 268 MB as 95th percentile): what a node with neither of ours takes.
And the libraries alone: three processes from the same images that import what ours import of others, and each wait with a gRPC
server that is never called. No code of Fractus gets below that.

Needs root, the programs of the embedded cluster, and the images of this checkout: `fractus images build`.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import re
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fractus
import yaml
from fractus_cli.standalone import StandalonePki
from fractus_cluster.commands import run
from fractus_cluster.images.build import image_name
from fractus_cluster.ports import free_port
from fractus_core.api import Grant
from fractus_core.geo import LocalFrame
from service import Processes, wait_for

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "integration"))
from agent_server import FRACTUS, ApiServer, running

NODE = "bench"
HOME = (39.36, 22.95, 10.0)
FRAME = LocalFrame(*HOME[:2])
SIDE_M = 60.0
HEIGHT_M = 15.0
TARGET_MB = 120.0
LIBRARIES = {
    "agent": ("aiohttp", "cryptography.x509", "grpc", "kubernetes.aio.client", "pydantic", "yaml"),
    "mobility": ("click", "cryptography.x509", "grpc", "pydantic", "shapely", "yaml"),
    "camera": ("click", "cryptography.x509", "cv2", "grpc", "pydantic", "shapely", "yaml"),
}
"""What the program of an image imports of others at the least."""
_IDLE = """
import asyncio, importlib, sys
for name in sys.argv[1:]:
    importlib.import_module(name)
import grpc
async def main():
    server = grpc.aio.server()
    server.add_insecure_port("127.0.0.1:0")
    await server.start()
    print("waiting", flush=True)
    await asyncio.Event().wait()
asyncio.run(main())
"""
K3S_AGENT_MB = 268.0
WARM_UP_S = 40.0
"""Until a side of the square with hidden faces was flown along, and all that is loaded on demand is there."""
_MOUNTS = """
root=$1 folder=$2; shift 2
for name in proc dev; do mount --rbind /$name "$root/$name"; done
mount --bind "$folder/state" "$root/var/lib/fractus"; mount --bind "$folder/etc" "$root/etc/fractus"
exec "$@"
"""


def square(west: float, south: float, east: float, north: float) -> dict[str, Any]:
    """An area, in metres from home."""
    corners = ((west, south), (east, south), (east, north), (west, north))
    return {"polygon": {"exterior": [dict(zip(("lat", "lon"), FRAME.latlon(*at), strict=True)) for at in corners]}}


MOBILITY = ["Arm", "Disarm", "Takeoff", "Land", "Goto", "Hover", "GetPosition", "ReturnToLaunch"]
CAMERA = ["CaptureImage", "RetrieveImage", "ListImages", "DeleteImage"]
POLICIES = [
    {"name": "low", "spec": {"type": "LimitControl", "kind": "altitude", "lowerLimit": 5, "upperLimit": 50, "action": "enforce"}},
    {
        "name": "faces",
        "spec": {"type": "PrivacyControl", "kind": "camera", "action": "blurFaces", "selector": {"zones": ["riverside"]}},
        "zones": [{"name": "riverside", "area": square(SIDE_M, -10, SIDE_M + 50, SIDE_M + 10)}],
    },
]  # fmt: skip
GRANT = {
    "apiVersion": "fractus.dev/v1alpha1",
    "kind": "Grant",
    "metadata": {"name": "default.bench-surveyor", "uid": "flight"},
    "spec": {
        "node": NODE, "application": {"namespace": "default", "name": "bench", "uid": "bench"},
        "component": "Surveyor", "instance": "bench-surveyor", "class": "driver", "control": "full",
        "services": [{"service": "mobility", "methods": MOBILITY}, {"service": "camera", "methods": CAMERA}],
        "operationArea": [square(-100, -100, 200, 200)], "limits": {"maxAltitude": 60, "maxSpeed": 12},
        "home": {"lat": HOME[0], "lon": HOME[1], "alt": HOME[2], "altitudeReference": "amsl"}, "policies": POLICIES,
    },
}  # fmt: skip


def described(autopilot: str, camera: str) -> str:
    """The node's Drone, with the camera of the example."""
    mobility = {"connection": autopilot, "maxAltitude": 80, "maxFlightTime": 60, "maxSpeed": 15, "methods": MOBILITY}
    lens = {"horizontalFieldOfView": 62.2, "lens": {"model": "pinhole"}, "mount": {"pitch": -90, "stabilised": True}}
    pictures = {"connection": camera, "resolution": "1280x720", "methods": CAMERA, **lens}
    spec = {"mobilityType": "quadcopter", "services": {"mobility": mobility, "camera": pictures}}
    return yaml.safe_dump(
        {"apiVersion": "fractus.dev/v1alpha1", "kind": "Drone", "metadata": {"name": NODE}, "spec": spec}
    )


async def survey(drone: fractus.Mobility, _control: fractus.Control) -> None:
    """Around the square until it is ended, with a picture a second."""
    async with fractus.camera() as camera, asyncio.TaskGroup() as tasks:
        tasks.create_task(take(camera))
        await drone.arm()
        await drone.takeoff(HEIGHT_M)
        while True:
            for x, y in ((SIDE_M, 0.0), (SIDE_M, SIDE_M), (0.0, SIDE_M), (0.0, 0.0)):
                with contextlib.suppress(fractus.Unavailable):
                    await drone.goto(*FRAME.latlon(x, y), HEIGHT_M)
                print("corner", flush=True)


async def take(camera: fractus.Camera) -> None:
    """A picture each second; there is none while it is unknown where the drone is, as on a machine that is too busy."""
    while True:
        await asyncio.sleep(1.0)
        with contextlib.suppress(fractus.FractusError):
            picture = await camera.take()
            print(f"picture of {len(picture.data)} bytes, {picture.info.decision.reason or 'as taken'}", flush=True)


class Images:
    """The images' file systems, each as a container sees it.

    Args:
        tag: of all images.
    """

    def __init__(self, tag: str) -> None:
        self._tag = tag
        self._containers: dict[str, str] = {}

    def __enter__(self) -> Images:
        return self

    def __exit__(self, *_: object) -> None:
        for container in self._containers.values():
            run(["buildah", "rm", container], check=False)

    def root(self, name: str) -> Path:
        """The root of a new container of an image."""
        if name not in self._containers:
            self._containers[name] = run(
                ["buildah", "from", "--pull-never", image_name(name, self._tag)]
            ).stdout.strip()
        return Path(run(["buildah", "mount", self._containers[name]]).stdout.strip())

    def command(self, name: str, folder: Path, *words: str, **environment: str) -> list[str]:
        """How a command is run in an image, with the directories of the node that are below a folder."""
        root = self.root(name)
        for inside in ("var/lib/fractus", "etc/fractus"):
            (root / inside).mkdir(parents=True, exist_ok=True)
        template = "{{range .OCIv1.Config.Env}}{{println .}}{{end}}"
        image = run(["buildah", "inspect", "--format", template, self._containers[name]]).stdout.split()
        settings = [*image, *(f"{key}={value}" for key, value in environment.items())]
        chroot = shutil.which("chroot") or "/usr/sbin/chroot"
        mounted = ["unshare", "--mount", "sh", "-ec", _MOUNTS, "sh", str(root), str(folder)]
        return [*mounted, "env", "-i", *settings, chroot, str(root), *words]


def memory_mb(pid: int) -> tuple[float, float]:
    """Proportional set size of a process, and what of it is its own."""
    sizes = dict(re.findall(r"^(\w+):\s+(\d+) kB", Path(f"/proc/{pid}/smaps_rollup").read_text(), re.MULTILINE))
    return int(sizes["Pss"]) * 1024 / 1e6, (int(sizes["Private_Clean"]) + int(sizes["Private_Dirty"])) * 1024 / 1e6


class Node:
    """A drone's node in flight.

    Args:
        folder: for its files, and the logs.
        server: the API server.
        images: where its programs come from.
    """

    def __init__(self, folder: Path, server: ApiServer, images: Images, processes: Processes) -> None:
        self._folder = folder
        self._server = server
        self._images = images
        self._processes = processes
        self._ports = {name: free_port() for name in ("mobility", "camera", "world", "scene")}
        self._links = [f"tcp:127.0.0.1:{free_port()}" for _ in range(3)]
        self.pids: dict[str, int] = {}

    def start(self) -> None:
        """Bring everything up, and into the air."""
        etc = self._folder / "etc"
        state = self._folder / "state"
        for folder in (etc, state):
            folder.mkdir()
        pki = StandalonePki.create(self._folder / "pki")
        shutil.copytree(pki.node(NODE), state / "tls")
        self._server.furnish((state / "tls" / "ca.crt").read_bytes())
        self._server.post(
            "/api/v1/nodes", {"metadata": {"name": NODE, "labels": {"fractus.dev/class": "drone"}}}
        )  # fmt: skip
        self._server.post(f"{FRACTUS}/grants", pki.sign(GRANT))
        self._server.publish(NODE)
        shutil.copy(self._server.agent_kubeconfig, etc / "kubeconfig")
        camera = f"http://127.0.0.1:{self._ports['world']}/snapshot.jpg"
        (etc / "node.yaml").write_text(described(self._links[0], camera))
        self._surroundings()
        self._services()
        self._wait_for("failsafes: set", "mobility", "the vehicle's link")
        tls = pki.component(Grant.from_body(GRANT).spec.identity)
        self._processes.start(
            "component", sys.executable, __file__, "--survey", FRACTUS_NODE=NODE, FRACTUS_TLS_DIR=str(tls),
            FRACTUS_MOBILITY_ADDRESS=f"127.0.0.1:{self._ports['mobility']}",
            FRACTUS_CAMERA_ADDRESS=f"127.0.0.1:{self._ports['camera']}",
        )  # fmt: skip
        self._wait_for("corner", "component", "a flight")
        self._wait_for("picture", "component", "a picture")

    def _wait_for(self, said: str, by: str, what: str) -> None:
        wait_for(lambda: self._processes.check() or said in self._processes.log(by), what, 150.0)

    def _surroundings(self) -> None:
        """Start the simulated vehicle, its camera and MAVProxy."""
        home = ",".join(str(value) for value in HOME)
        listens = [word for link in self._links for word in ("--listen", link)]
        self._processes.start("vehicle", sys.executable, "-m", "fractus_vehicle", *listens, "--home", home)
        self._processes.start(
            "world", sys.executable, "-m", "fractus_world", "--listen", f"127.0.0.1:{self._ports['world']}",
            "--vehicle", self._links[1], "--origin", home.rpartition(",")[0], "--resolution", "1280x720",
        )  # fmt: skip
        program = Path(sys.executable).with_name("mavproxy.py")
        self.pids["MAVProxy"] = self._processes.start(
            "mavproxy", sys.executable, str(program), f"--master={self._links[2]}", "--non-interactive", "--daemon",
            f"--state-basedir={self._folder}", HOME=str(self._folder), MPLBACKEND="agg",
        )  # fmt: skip

    def _services(self) -> None:
        """The node's workloads, as the chart runs them."""
        ports = {name: f"127.0.0.1:{port}" for name, port in self._ports.items()}
        everywhere = {"FRACTUS_NODE": NODE}
        recordings = ["--recordings", "/var/lib/fractus/recordings/mobility", "--recordings-mb", "500"]
        commands: dict[str, tuple[list[str], dict[str, str]]] = {
            "agent": (
                ["python3", "-m", "fractus_agent"],
                {"FRACTUS_MOBILITY": ports["mobility"], "KUBECONFIG": "/etc/fractus/kubeconfig"},
            ),
            "mobility": (["fractus", "mobility", "serve", "--listen", ports["mobility"], *recordings], {}),
            "camera": (
                ["fractus", "camera", "serve", "--listen", ports["camera"], "--mobility", ports["mobility"]], {}
            ),
        }  # fmt: skip
        for name, (words, more) in commands.items():
            metrics = f"127.0.0.1:{free_port()}"
            command = self._images.command(
                name, self._folder, *words, FRACTUS_METRICS=metrics, **everywhere, **more
            )  # fmt: skip
            self.pids[name] = self._processes.start(name, *command)


def watched(node: Node, processes: Processes, seconds: float) -> dict[str, list[tuple[float, float]]]:
    """PSS and what is their own, of each process, once a second."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in node.pids}
    time.sleep(WARM_UP_S)
    for _ in range(round(seconds)):
        processes.check()
        for name, pid in node.pids.items():
            found[name].append(memory_mb(pid))
        time.sleep(1.0)
    return found


def libraries_mb(folder: Path, images: Images) -> dict[str, float]:
    """PSS of the libraries of each image, in a process that does nothing with them."""
    for name in ("etc", "state"):
        (folder / name).mkdir(parents=True)
    with Processes(folder) as processes:
        pids = {}
        for name, modules in LIBRARIES.items():
            pids[name] = processes.start(name, *images.command(name, folder, "python3", "-c", _IDLE, *modules))
        for name in pids:
            wait_for(
                lambda name=name: processes.check() or "waiting" in processes.log(name), f"{name}'s libraries", 60.0
            )
        return {name: memory_mb(pid)[0] for name, pid in pids.items()}


@contextlib.contextmanager
def node_in(folder: Path, images: Images) -> Iterator[tuple[Node, Processes]]:
    """A node in flight for the length of a block."""
    (folder / "plane").mkdir()
    with running(folder / "plane") as server, Processes(folder) as processes:
        node = Node(folder, server, images, processes)
        try:
            node.start()
            yield node, processes
        finally:
            if os.environ.get("FRACTUS_BENCH_LOGS"):
                for log in sorted(folder.glob("*.log")):
                    print(f"-- {log.name}\n{log.read_text(errors='replace')[-3000:]}", file=sys.stderr)


def claim(name: str, ours: float, target: float, theirs: float | None = None) -> dict[str, Any]:
    """A figure in megabytes, and whether it holds."""
    ratio = None if theirs is None else theirs / ours
    return {
        "name": name,
        "ours": ours,
        "theirs": theirs,
        "unit": "MB",
        "ratio": ratio,
        "target": target,
        "holds": ours <= target,
    }


def main() -> int:
    if sys.argv[1:] == ["--survey"]:
        fractus.run(survey)
        return 0
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="twenty seconds of flight")
    parser.add_argument("--seconds", type=float, default=120.0, help="how long to watch")
    parser.add_argument("--tag", default="dev", help="of the images; dev unless told")
    parser.add_argument("--json", type=Path, help="write the claims to a file")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory, Images(options.tag) as images:
        libraries = libraries_mb(Path(directory) / "libraries", images)
        with node_in(Path(directory), images) as (node, processes):
            found = watched(node, processes, 20.0 if options.quick else options.seconds)
    print(f"{'in flight':12} {'PSS':>9} {'its own':>10} {'at most':>10} {'libraries':>10}")
    for name, seen in found.items():
        shared, own = (statistics.mean(column) for column in zip(*seen, strict=True))
        alone = f"{libraries[name]:7.1f} MB" if name in libraries else ""
        print(f"{name:12} {shared:6.1f} MB {own:7.1f} MB {max(seen)[0]:7.1f} MB {alone}")
    ours = {name: [pss for pss, _ in seen] for name, seen in found.items() if name != "MAVProxy"}
    together = statistics.mean(map(sum, zip(*ours.values(), strict=True)))
    theirs = statistics.mean(pss for pss, _ in found["MAVProxy"]) + K3S_AGENT_MB
    print(f"the libraries alone, idle: {sum(libraries.values()):.1f} MB")
    print(f"together {together:.1f} MB; MAVProxy and a k3s agent ({K3S_AGENT_MB:.0f} MB) {theirs:.1f} MB")
    claims = [claim("agent, mobility and camera in flight", together, TARGET_MB, theirs)]
    for one in claims:
        print(
            f"{one['name']:40} {one['ours']:6.1f} MB (target {one['target']:.0f}){'' if one['holds'] else '  MISSED'}"
        )
    if options.json:
        options.json.write_text(json.dumps({"claims": claims, "libraries_mb": libraries}, indent=1))
    return 0 if all(one["holds"] for one in claims) else 1


if __name__ == "__main__":
    sys.exit(main())
