"""Order a flight over the management API, and print what happens until the flight has ended.

`fractus_client` is generated from the OpenAPI description of the API (docs/management-api.md, "Use a generated client").
"""

from __future__ import annotations

import argparse
import os
import sys
import time
import uuid
from datetime import UTC, datetime, timedelta
from typing import TypeVar

from fractus_client import AuthenticatedClient
from fractus_client.api.plans import activate, progress, submit
from fractus_client.models import FlightPlanSpec, FlightWindow, Position, Problem

POLL_S = 1.0

T = TypeVar("T")


def main() -> None:
    """Order, activate and follow a flight."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("template", help="name of an approved ApplicationTemplate with navigation: path")
    parser.add_argument("waypoints", nargs="+", metavar="LAT,LON,ALT", help="degrees, and metres above home")
    parser.add_argument("--namespace", required=True)
    parser.add_argument("--url", default="http://127.0.0.1:8660", help="address of the API (default: %(default)s)")
    parser.add_argument("--minutes", type=float, default=15, help="time until the drone is home (default: %(default)s)")
    options = parser.parse_args()
    client = AuthenticatedClient(base_url=options.url, token=os.environ["TOKEN"])
    flight = FlightPlanSpec(
        template=options.template,
        waypoints=[position(text) for text in options.waypoints],
        window=FlightWindow(start=datetime.now(UTC) + timedelta(seconds=20), duration=options.minutes),
    )
    # The key makes the request safe to repeat after a lost response: the API returns the plan of the first request.
    key = str(uuid.uuid4())
    plan = answer(submit.sync(client=client, body=flight, namespace=options.namespace, idempotency_key=key))
    name = plan.metadata.name
    print(f"{name} is {plan.status.state}: {plan.status.message}")
    if plan.status.state != "Accepted":
        sys.exit(1)
    answer(activate.sync(name, client=client, namespace=options.namespace))
    state = ""
    while state != "Ended":
        current = answer(progress.sync(name, client=client, namespace=options.namespace))
        if current.plan.state != state:
            state = current.plan.state
            print(f"{name} is {state}: {current.plan.message}", flush=True)
        time.sleep(POLL_S)


def position(text: str) -> Position:
    """Return a waypoint."""
    lat, lon, alt = (float(number) for number in text.split(","))
    return Position(lat=lat, lon=lon, alt=alt)


def answer(response: T | Problem | None) -> T:
    """Return the content of a response, or end with the sentence of its problem."""
    if isinstance(response, Problem):
        sys.exit(f"{response.status}: {response.detail}")
    assert response is not None, "the response is not described in the OpenAPI description"
    return response


if __name__ == "__main__":
    main()
