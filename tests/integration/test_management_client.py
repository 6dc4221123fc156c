"""The example of a client that is generated from the OpenAPI description, against a real API server and operator."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from control_plane import wait_for
from docs_pages import shell_lines
from management_server import User

EXAMPLE = Path(__file__).parents[2] / "examples/flights/order_flight.py"


def test_generated_client_orders_a_flight_and_follows_it_to_its_end(pilot: User, tmp_path: Path) -> None:
    generate = next(
        line for line in shell_lines("docs/management-api.md", "Use a generated client") if "generate" in line
    )
    command = generate.replace("http://127.0.0.1:8660", pilot.url).removeprefix("uvx ")
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "TOKEN": pilot.token}
    subprocess.run(command.split(), cwd=tmp_path, env=environment, check=True)
    order = [
        sys.executable,
        EXAMPLE,
        "survey",
        "39.36105,22.93128,20",
        f"--namespace={pilot.namespace}",
        f"--url={pilot.url}",
    ]
    environment["PYTHONPATH"] = str(tmp_path)
    with (tmp_path / "output").open("w") as output:
        client = subprocess.Popen(order, env=environment, stdout=output, stderr=subprocess.STDOUT)

    def text() -> str:
        return (tmp_path / "output").read_text()

    try:
        wait_for(lambda: "is Accepted" in text().partition("\n")[2] or client.poll() is not None, text)
        (plan,) = pilot("GET", "/v1/plans").body["items"]
        assert plan["spec"]["use"] == "InUse", text()
        assert pilot("POST", f"/v1/plans/{plan['metadata']['name']}:end").status in {200, 202}
        assert client.wait(30) == 0, text()
    finally:
        client.kill()
        client.wait()
    assert text().splitlines()[-1].startswith(f"{plan['metadata']['name']} is Ended: "), text()
