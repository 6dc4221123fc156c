"""What pages have a reader look at in pods, typed as it stands; only real nodes have logs and files."""

from __future__ import annotations

import json

import pytest
from conftest import DRONE, SYSTEM
from docs_commands import every_command
from kubectl import Kube

pytestmark = pytest.mark.slow

ELSEWHERE = {"fractus-test", "job/fractus-removal", "service/fractus-view", "fractus.dev/application=patrol"}
"""What is there at other times: after a test of helm or an uninstall that failed, with the page of flights, in the tutorial."""


def test_logs_and_files_of_pods_are_where_pages_say(kube: Kube) -> None:
    pod = kube.pod("app.kubernetes.io/component=mobility", SYSTEM, node=DRONE)["metadata"]["name"]
    every = {c.argv[1:] for c in every_command() if c.argv[0] == "kubectl" and {"exec", "logs"} & {*c.argv}}
    looks = {argv for argv in every if SYSTEM in argv and not ELSEWHERE & {*argv}}
    assert looks >= {
        ("-n", SYSTEM, "logs", "deploy/fractus-operator"),
        ("-n", SYSTEM, "logs", "POD"),
        ("exec", "-n", SYSTEM, "MOBILITY-POD", "--", "ls", "/var/lib/fractus/audit"),
    }
    shown = {argv: kube.must(*(pod if word in {"POD", "MOBILITY-POD"} else word for word in argv)) for argv in looks}
    assert "mobility.jsonl" in shown["exec", "-n", SYSTEM, "MOBILITY-POD", "--", "ls", "/var/lib/fractus/audit"].split()
    assert "fractus_services" in shown["-n", SYSTEM, "logs", "POD"]
    for argv, said in shown.items():
        assert said.strip(), argv
        if argv[-1].endswith(".jsonl"):
            assert all(json.loads(line) for line in said.splitlines())
