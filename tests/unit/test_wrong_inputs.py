"""Wrong inputs of new users: each answer names the field or line, and the remedy. None is silent, and none is a traceback."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fractus
import pytest
from fractus_cli import status  # noqa: F401  (its import of urllib3 binds a socket, which tests of this tier may not do)
from fractus_cli.main import run

MANIFESTS = """\
apiVersion: fractus.dev/v1alpha1
kind: Application
metadata:
  name: survey
spec:
  components:
    - name: Navigator
      placement: drone
      class: driver
      controlPoints:
        - point: {depot: depot-1}
          navigation: pathBased
          path:
            - {lat: 50.8641, lon: 4.6785, alt: 20}
            - {lat: 50.8641, lon: 4.6791, alt: 20}
      services:
        - {service: mobility, methods: [Arm, Takeoff, Goto]}
      egress: [Store]
      container:
        image: localhost/survey:1
        resources: {limits: {memory: 128Mi}}
    - name: Store
      placement: cloud
      container: {image: "localhost/survey:1", ports: [{port: 8080}]}
---
apiVersion: fractus.dev/v1alpha1
kind: Depot
metadata: {name: depot-1}
spec:
  location: {lat: 50.8637, lon: 4.6785}
  radius: 10
---
apiVersion: fractus.dev/v1alpha1
kind: Drone
metadata: {name: drone-1}
spec:
  mobilityType: quadcopter
  depot: depot-1
  services:
    mobility:
      autopilot: ardupilot
      connection: tcp:127.0.0.1:5760
      maxAltitude: 80
      maxFlightTime: 15
      maxSpeed: 15
      methods: [Arm, Takeoff, Goto, Land]
---
apiVersion: fractus.dev/v1alpha1
kind: Zone
metadata: {name: school}
spec:
  area:
    polygon:
      exterior: [{lat: 50.87, lon: 4.68}, {lat: 50.87, lon: 4.69}, {lat: 50.88, lon: 4.69}]
  altitude: {lower: 0, upper: 100}
---
apiVersion: fractus.dev/v1alpha1
kind: Policy
metadata: {name: no-school}
spec:
  type: GeofenceControl
  kind: exclusion
  action: hover
  selector: {zones: [school]}
---
apiVersion: fractus.dev/v1alpha1
kind: EdgeNode
metadata: {name: edge-1}
spec:
  location: {lat: 50.8639, lon: 4.6785}
"""

AREA = "exterior: [{lat: 50.87, lon: 4.68}, {lat: 50.87, lon: 4.69}, {lat: 50.88, lon: 4.69}]"
FIRST = "apiVersion: fractus.dev/v1alpha1\nkind: Application"
IMAGE = "image: localhost/survey:1\n"
EXCHANGED = "latitude and longitude are probably exchanged"
SELECTOR = "selector: {zones: [school]}"

CHANGED = [
    ("kind: Application", "kind: Aplication", "m.yaml:2: ", "did you mean Application?"),
    (FIRST, "apiVersion: fractus.dev/v1\nkind: Application", "m.yaml:1: ", "must be 'fractus.dev/v1alpha1'"),
    (FIRST, "kind: Application", "m.yaml:1: ", "apiVersion: is missing; write fractus.dev/v1alpha1"),
    (FIRST, "apiVersion: fractus.dev/v1alpha1", "m.yaml:1: ", "has no kind", "add apiVersion and kind"),
    ("name: survey", "name: my_survey", "m.yaml:4: ", "metadata.name: must be lowercase letters, digits, hyphens"),
    ("name: survey", "name: 5", "m.yaml:4: ", "metadata.name: must be a string", "in quotes if it is a number"),
    ("name: survey", "name: ", "m.yaml:4: ", "metadata.name: must be a string; specify the name"),
    ("name: survey", "name: survey\n  namspace: x", "m.yaml:5: ", "did you mean namespace?"),
    ("placement: drone", "placement: plane", "m.yaml:8: ", "must be 'drone', 'edge', 'hybrid' or 'cloud'"),
    ("class: driver", "class: drvier", "m.yaml:9: ", "did you mean driver?"),
    ("navigation: pathBased", "navigation: pathbased", "m.yaml:12: ", "did you mean pathBased?"),
    ("service: mobility", "service: mobilty", "m.yaml:17: ", "did you mean mobility?"),
    ("[Arm, Takeoff, Goto]", "[Arm, TakeOff, Goto]", "m.yaml:17: ", "methods[1]: must be", "did you mean Takeoff?"),
    ("type: GeofenceControl", "type: Geofence", "m.yaml:61: ", "did you mean GeofenceControl?"),
    ("kind: exclusion", "kind: exclude", "m.yaml:62: ", "did you mean exclusion?"),
    ("action: hover", "action: Hover", "m.yaml:63: ", "did you mean hover?"),
    ("path:", "paths:", "m.yaml:13: ", "there is no such field; did you mean path?"),
    ("controlPoints:", "controlpoints:", "m.yaml:10: ", "did you mean controlPoints?"),
    ("maxSpeed: 15", "maxspeed: 15", "m.yaml:45: ", "maxspeed: there is no such field; did you mean maxSpeed?"),
    ("alt: 20}", "altitude: 20}", "m.yaml:14: ", "path[0].altitude: there is no such field; remove it"),
    (IMAGE, f"{IMAGE}        pullPolicy: Never\n", "m.yaml:21: ", "pullPolicy: there is no such field; remove it"),
    ("lat: 50.8641, lon: 4.6785", "lat: 4.6785, lon: 50.8641", "m.yaml:14: ", "path[0]: ", EXCHANGED),
    ("{lat: 50.8637, lon: 4.6785}\n", "{lat: 4.6785, lon: 50.8637}\n", "m.yaml:14: ", EXCHANGED, "or in the Depot"),
    (AREA, "exterior: [{lat: 5.87, lon: 4.68}, {lat: 5.87, lon: 4.69}, {lat: 5.88, lon: 4.69}]", "Policy no-school: spec.selector.zones: more than 100 km from every Depot: school; check"),
    (AREA, "exterior: [{lat: 4.68, lon: 50.87}, {lat: 4.69, lon: 50.87}, {lat: 4.69, lon: 50.88}]", "Zone school: spec.area: ", EXCHANGED),
    ("name: edge-1", "name: drone-1", "m.yaml:68: EdgeNode drone-1: metadata.name: m.yaml:35 is the Drone drone-1", "rename one"),
    ("{lat: 50.8639, lon: 4.6785}", "{lat: 4.6785, lon: 50.8639}", "EdgeNode edge-1: spec.location: ", EXCHANGED),
    ("lat: 50.8641, lon: 4.6785", "lat: 50,8641, lon: 4.6785", "m.yaml:14: ", "write decimals with a point"),
    ("lat: 50.8641, lon: 4.6785", "lat: 50°51, lon: 4.6785", "m.yaml:14: ", "path[0].lat: must be a number"),
    ("lat: 50.8641, lon: 4.6785", "lat: 150.8, lon: 4.6785", "m.yaml:14: ", "lat: must be less than or equal to 90"),
    ("lat: 50.8641, lon: 4.6785", 'lat: "50.8641", lon: 4.6785', "m.yaml:14: ", "lat: must be a number", "remove the quotes"),
    ("alt: 20}", "alt: 20m}", "m.yaml:14: ", "path[0].alt: must be a number, not '20m'; write only the number"),
    ("alt: 20}", "alt: .nan}", "m.yaml:14: ", "use a finite number"),
    ("alt: 20}", "alt: .inf}", "m.yaml:14: ", "use a finite number"),
    ("alt: 20}", "alt: 1e9}", "m.yaml:14: ", "path[0].alt: must be less than or equal to 20000"),
    ("alt: 20}", "alt: -20}", "a leg ends at least 2 m above home, not at -20.0 m", "use Land to descend"),
    ("alt: 20}", "alt: 200}", "drone-1: it climbs to 80 m; the path goes up to 200 m"),
    ("{lat: 50.8641, lon: 4.6791", "{lat: 52.0, lon: 4.6791", "drone-1: it can fly 12.0 min", "the mission takes"),
    ("egress: [Store]", "egress: [Stor]", "m.yaml:18: ", "egress[0]: ", "correct the name or add the component (Stor)"),
    ("egress: [Store]", "egress: Store", "m.yaml:18: ", "egress: must be a list, not 'Store'; write [Store]"),
    ("memory: 128Mi", "memory: 128", "m.yaml:21: ", "limits.memory: memory must be at least 4Mi", "write for example 128Mi"),
    ("memory: 128Mi", "memory: 128MB", "m.yaml:21: ", "'128MB' is not a quantity such as", "512Mi"),
    ("memory: 128Mi", "memory: -128Mi", "m.yaml:21: ", "'-128Mi' is not a quantity such as"),
    ("memory: 128Mi", "memroy: 128Mi", "m.yaml:21: ", "a resource must be cpu, memory", "'memroy'"),
    (IMAGE, "image: \n", "m.yaml:20: ", "container.image: is missing; specify it"),
    (IMAGE, "image: Localhost/Survey:1\n", "m.yaml:20: ", "image with a lowercase name, such as registry.example/team"),
    (IMAGE, "image: localhost/survey 1\n", "m.yaml:20: ", "container.image: must be an image"),
    ("[{port: 8080}]", "[8080]", "m.yaml:24: ", "ports[0]: must be an object with named fields"),
    ("port: 8080", "port: 80800", "m.yaml:24: ", "port: must be less than or equal to 65535"),
    (IMAGE, f"{IMAGE}        env: [{{name: A, value: 5}}]\n", "m.yaml:21: ", "env[0].value: must be a string; put it in quotes"),
    (IMAGE, f"{IMAGE}        env: {{A: b}}\n", "m.yaml:21: ", "env: must be a list; begin each entry with a hyphen"),
    (IMAGE, f"{IMAGE}        env: [{{name: FRACTUS_NODE, value: x}}]\n", "m.yaml:21: ", "reserved; choose another name"),
    (IMAGE, f"{IMAGE}        env: [{{name: 1A, value: x}}]\n", "m.yaml:21: ", "env[0].name: must be letters, digits and underscores"),
    ("- name: Store", "- name: navigator", "m.yaml:22: ", "components[1].name: ", "rename one of them"),
    ("depot: depot-1}", "depot: depot-2}", "m.yaml:11: ", "there is no Depot depot-2 (existing: depot-1); apply it or"),
    ("\n  depot: depot-1\n", "\n  depot: depot-2\n", "drone-1: its Depot depot-2 does not exist", "set spec.depot to an existing"),
    ("zones: [school]", "zones: [shcool]", "m.yaml:64: ", "Zone shcool does not exist (existing: school); apply it or correct"),
    ("zones: [school]", "zones: []", "m.yaml:64: ", "selector.zones: ", "GeofenceControl requires"),
    (SELECTOR, "selector: {zones: [school], applications: {names: [x]}}", "no Application is selected", "check namespaces and names"),
    (SELECTOR, "selector: {zones: [school], nodes: [{key: clas, operator: Exists}]}", "m.yaml:64: ", "no attribute clas", "correct the name"),
    ("lower: 0, upper: 100", "lower: 100, upper: 0", "m.yaml:55: ", "altitude.lower: lower must be below upper"),
    ("{lat: 50.88, lon: 4.69}]", "{lat: 50.88, lon: 4.69}, {lat: 50.865, lon: 4.685}]", "m.yaml:54: ", "list the points in order"),
    (", {lat: 50.88, lon: 4.69}]", "]", "m.yaml:54: ", "exterior: must have at least 3 entries, not 2"),
    ("radius: 10", "radius: -10", "m.yaml:31: ", "radius: must be greater than 0, not -10"),
    ("radius: 10", "radius: 1e12", "m.yaml:31: ", "radius: must be less than or equal to 10000"),
    ("maxSpeed: 15", "maxSpeed: fast", "m.yaml:45: ", "maxSpeed: must be a number, not 'fast'"),
    ("maxFlightTime: 15", "maxFlightTime: 15 min", "m.yaml:44: ", "must be a number, not '15 min'; write only the number"),
    ("maxFlightTime: 15", "maxFlightTime: 900000", "m.yaml:44: ", "must be less than or equal to 1440"),
    ("tcp:127.0.0.1:5760", "127.0.0.1:5760", "m.yaml:42: ", "connection: must be tcp:HOST:PORT"),
    ("tcp:127.0.0.1:5760", "tcp:127.0.0.1", "m.yaml:42: ", "connection: must be tcp:HOST:PORT"),
    ("tcp:127.0.0.1:5760", "tcp:127.0.0.1:99999", "m.yaml:42: ", "with a port of 1 to 65535"),
    ("autopilot: ardupilot", "autopilot: px4", "m.yaml:41: ", "autopilot: must be 'ardupilot', not 'px4'"),
    ("mobilityType: quadcopter", "mobilityType: quad copter", "m.yaml:37: ", "did you mean quadcopter?"),
    ("spec:\n  comp", "spec:\n  ttlAfterFinished: 10m\n  comp", "m.yaml:6: ", "ttlAfterFinished: must be a whole number"),
    ("spec:\n  comp", "spec:\n  updatePolicy: immediate\n  comp", "m.yaml:6: ", "did you mean Immediate?"),
    ("navigation: pathBased", "navigation: regionBased", "m.yaml:11: ", "regionBased navigation needs region"),
    ("metadata: {name: depot-1}", "metadata: {name: depot-1}\nstatus: {x: 1}", "m.yaml:29: ", "status: there is no such field"),
    ("metadata: {name: edge-1}", "metadata: {name: edge-1}\nspec: {}", "m.yaml:70: ", "spec is also defined on line 69"),
    ("---\napiVersion: fractus.dev/v1alpha1\nkind: Depot", "apiVersion: fractus.dev/v1alpha1\nkind: Depot", "m.yaml:25: ", "also defined on line 1"),
    ("      controlPoints:\n", "      \tcontrolPoints:\n", "m.yaml:10: ", "found a tab character", "indent with spaces"),
    ("- name: Navigator\n", "- name: Navigator\n   placement: drone\n", "m.yaml:8: ", "check the indentation"),
    ('image: "localhost/survey:1"', "image: {{ image }}", "m.yaml:24: ", "put a text in braces in quotes"),
    ("path:\n", "path: [\n", "m.yaml:14: ", "check the indentation, brackets"),
    ("action: hover", "action: hover: now", "m.yaml:63: ", "put a text that contains a colon and a space in quotes"),
    ("action: hover", "action: 'hover", "m.yaml:65: ", "close the quotes"),
    ("action: hover", "action: *hover", "m.yaml:63: ", "anchor &hover is not defined above; define it or correct"),
]  # fmt: skip
"""The text that is replaced in MANIFESTS, its replacement, and parts of the answer of `fractus plan`."""

FILES = {
    "empty.yaml": "",
    "words.yaml": "hello\n",
    "list.yaml": "- a\n- b\n",
    "other.yaml": "apiVersion: v1\nkind: ConfigMap\nmetadata: {name: a}\n",
    "binary.yaml": "\x00\x01",
    "m.yaml": MANIFESTS,
    "sync.py": "import fractus\ndef fly(drone, control):\n    pass\nfractus.run(fly)\n",
    "sleep.py": "import fractus, time\nasync def fly(drone, control):\n    time.sleep(40)\nfractus.run(fly)\n",
    "await.py": "import fractus\nasync def fly(drone, control):\n    drone.takeoff(20)\nfractus.run(fly)\n",
    "method.py": "import fractus\nasync def fly(drone, control):\n    await drone.take_off(20)\nfractus.run(fly)\n",
    "argument.py": "import fractus\nasync def fly(drone, control):\n    await drone.goto(50.0)\nfractus.run(fly)\n",
    "syntax.py": "def (:\n",
    "tabs.py": "async def fly(drone, control):\n\tpass\n        pass\n",
    "nofly.py": "print(1)\n",
    "type.geojson": '{"type": "Featur"}',
    "cut.geojson": '{"type": "FeatureCollection", "features": [',
    "line.geojson": '{"type":"Feature","properties":{"name":"a"},"geometry":{"type":"LineString","coordinates":[[4,50],[5,50]]}}',
    "swapped.geojson": '{"type":"Feature","properties":{"name":"a"},"geometry":{"type":"Polygon","coordinates":'
    "[[[50,170],[51,170],[51,171],[50,170]]]}}",
    "exchanged.geojson": '{"type":"Feature","properties":{"name":"a"},"geometry":{"type":"Polygon","coordinates":'
    "[[[50.87,4.68],[50.87,4.69],[50.88,4.69],[50.87,4.68]]]}}",
    "cut.kml": "<kml><Placemark>",
    "class.yaml": "name: a\nnodes:\n  - name: node-1\n    class: dron\n",
    "field.yaml": "name: a\nnodes:\n  - name: node-1\n    class: drone\n    hardware: {vehicel: {}}\n",
    "quantity.yaml": "name: a\nnodes:\n  - name: node-1\n    class: drone\n    resources: {memory: 2GB}\n",
    "charge.yaml": "name: a\nnodes:\n  - name: node-1\n    class: drone\n    hardware:\n      vehicle: {charge: -5}\n",
    "cloud.yaml": "name: a\nnodes:\n  - name: node-1\n    class: cloud\n    hardware:\n      vehicle: {}\n",
    "mode.yaml": "name: x\nmode: standalne\n",
    "timeout.yaml": "name: x\nmode: standalone\ntimeout: -5\n",
    "context.yaml": "apiVersion: v1\nkind: Config\nclusters: []\n",
}  # fmt: skip
"""Files of the commands below."""

COMMANDS = [
    ("plam -f m.yaml", "unknown command plam; did you mean plan?"),
    ("plan", "Missing option '-f' / '--filename'", "fractus plan --help"),
    ("plan -f none.yaml", "'--filename': Path 'none.yaml' does not exist", "fractus plan --help"),
    ("plan -f folder", "folder: the directory contains no .yaml, .yml or .json file"),
    ("plan -f empty.yaml", "no Application; specify a file with an Application"),
    ("plan -f other.yaml", "no Application; specify a file with an Application"),
    ("plan -f words.yaml", "words.yaml: the document has no kind", "add apiVersion and kind"),
    ("plan -f list.yaml", "list.yaml:1: the document has no kind", "add apiVersion and kind"),
    ("plan -f binary.yaml", "binary.yaml:1: ", "save the file as plain UTF-8 text"),
    ("plan -f /dev/null", "/dev/null: is not a regular file; write its content to a file"),
    ("plan -f m.yaml -o xml", "'--output': 'xml' is not one of 'table', 'yaml', 'json', 'geojson'"),
    ("plan -f m.yaml --coverage 95", "'--coverage': 95.0 is not in the range 0<=x<=1"),
    ("plan -f m.yaml --cruise-speed nan", "cruise speed: must be 0.1 to 1000, not nan"),
    ("plan -f m.yaml --time tomorrow", "'--time': 'tomorrow' is not a time with a time zone, such as 2026"),
    ("plan -f m.yaml --time 2026-01-01T10:00:00", "is not a time with a time zone, such as 2026"),
    ("plan -f m.yaml --ranking nope", "--ranking: plug-in nope is not installed (installed: "),
    ("plan -f m.yaml --filname m.yaml", "No such option '--filname'", "'--filename'"),
    ("status", "no cluster: set KUBECONFIG to the kubeconfig of a cluster", "none.yaml"),
    ("status --kubeconfig none.yaml", "'--kubeconfig': File 'none.yaml' does not exist"),
    ("status --kubeconfig folder", "'--kubeconfig': File 'folder' is a directory"),
    ("status --kubeconfig empty.yaml", "empty.yaml cannot be used", "kubectl config view --kubeconfig empty.yaml"),
    ("status --kubeconfig context.yaml", "current-context", "kubectl config view --kubeconfig context.yaml"),
    ("explain", "Missing argument 'APPLICATION'", "fractus explain --help"),
    ("doctor --kubeconfig words.yaml", "words.yaml cannot be used", "kubectl config view --kubeconfig words.yaml"),
    ("view --listen 8650", "'--listen': '8650' is not HOST:PORT, for example 127.0.0.1:8650"),
    ("view none.mcap", "File 'none.mcap' does not exist"),
    ("view words.yaml", "words.yaml is not an MCAP file; specify a file that a service wrote"),
    ("check none.py", "File 'none.py' does not exist"),
    ("check sync.py", "sync.py:2: fly is a synchronous function: define it as `async def"),
    ("check sleep.py", "sleep.py:3: `time.sleep` blocks the event loop", "use `await asyncio.sleep(...)`"),
    ("check await.py", "await.py:3: takeoff is not awaited", "write `await drone.takeoff(20)`"),
    ("check method.py", "method.py:3: Mobility has no method take_off; did you mean takeoff?"),
    ("check argument.py", "argument.py:3: Mobility.goto: missing a required argument: 'lon'"),
    ("check syntax.py", "syntax.py:1: syntax error"),
    ("check tabs.py", "tabs.py:3: syntax error: inconsistent use of tabs and spaces"),
    ("check nofly.py", "nofly.py:1: the program does not use the SDK: `import fractus`, then `fractus.run(program)`"),
    ("init", "Missing argument 'NAME'", "fractus init --help"),
    ("init My_App", "NAME 'My_App' must consist of lowercase letters, digits and hyphens, for example"),
    ("init survey --directory .", "is not empty; specify another directory with --directory"),
    ("schema x", "unexpected extra argument (x)", "fractus schema --help"),
    ("zones import type.geojson", "Missing option '--from'. Choose from: ed269, ed318, geojson"),
    ("zones import type.geojson --from geojson", "type.geojson: type: 'Featur' is not GeoJSON of zones; expected a"),
    ("zones import cut.geojson --from geojson", "cut.geojson: line 1: invalid JSON", "correct or export the file again"),
    ("zones import line.geojson --from geojson", "a: a geometry of type LineString is not a zone; left out", "contains no zone"),
    ("zones import swapped.geojson --from geojson", "swapped.geojson:1: ", "the order is lon, lat (in a)"),
    ("zones import exchanged.geojson --from geojson --depots m.yaml", "centers at latitude 4.6867 to 4.6867", "note: more than 100 km from every Depot: a-"),
    ("zones import cut.kml --from kml", "cut.kml: this is not XML", "line 1", "export the file again"),
    ("zones import m.yaml --from ed269", "m.yaml: line 1: invalid JSON"),
    ("zones export none.yaml --to kml", "Path 'none.yaml' does not exist"),
    ("policy check", "Missing option '--policies'", "fractus policy check --help"),
    ("grants init pki", "Missing option '--node'", "fractus grants init --help"),
    ("grants init pki --node Drone_1", "node: 'Drone_1' is not a valid node name; use lower-case letters"),
    ("grants sign m.yaml --tls pki --to grants", "pki/authority: certificate authority not found", "fractus grants init pki"),
    ("audit verify none", "Path 'none' does not exist"),
    ("audit verify words.yaml", "words.yaml: line 1 is not an audit entry"),
    ("telemetry", "Missing option '--node'", "fractus telemetry --help"),
    ("telemetry --node drone-1 --tls folder", "folder/ca.crt cannot be read", "tls.crt, tls.key and ca.crt"),
    ("vehicle --home 95,0,0", "'--home': latitude, longitude or altitude out of range"),
    ("vehicle --home 50.8,4.6", "'--home': expected LAT,LON,ALT_AMSL"),
    ("vehicle --listen tcp:5760", "link 'tcp:5760': expected tcp:HOST:PORT"),
    ("vehicle --param FOO", "'--param': 'FOO': expected NAME=VALUE"),
    ("vehicle --param NO_SUCH=1", "unknown parameter NO_SUCH"),
    ("vehicle --wind fast", "'--wind': expected SPEED,DIR[,TURBULENCE]"),
    ("vehicle --charge -1", "'--charge': -1.0 is not in the range 0.0<=x<=6000.0"),
    ("vehicle --count 0", "'--count': 0 is not in the range 1<=x<=200"),
    ("camera-world --resolution big", "'--resolution': 'big' is not WIDTHxHEIGHT, such as 1920x1080"),
    ("camera-world --pose 1,2", "'--pose': expected LAT,LON,HEIGHT"),
    ("camera-world --orthophoto none.tif", "none.tif: cannot be read as a TIFF", "No such file"),
    ("cluster up folder", "'FILE': File 'folder' is a directory"),
    ("cluster up class.yaml", "class.yaml:4: ", "must be 'drone', 'edge' or 'cloud', not 'dron'; did you mean drone?"),
    ("cluster up field.yaml", "field.yaml:5: ", "there is no such field; did you mean vehicle?"),
    ("cluster up quantity.yaml", "quantity.yaml:5: ", "'2GB' is not a quantity such as 2, 500m or 4Gi"),
    ("cluster up charge.yaml", "charge.yaml:6: ", "must be greater than or equal to 0, not -5"),
    ("cluster up cloud.yaml", "cloud.yaml:3: ", "hardware.vehicle is for nodes of class drone"),
    ("cluster up m.yaml", "m.yaml:26: the file has a second document; remove it"),
    ("cluster charge drone-1 --name nope", "no cluster nope; start one: fractus cluster up FILE"),
    ("cluster power sideways drone-1", "'sideways' is not one of 'on', 'off'"),
    ("experiment check none.yaml", "cannot read none.yaml: No such file or directory"),
    ("experiment check mode.yaml", "mode.yaml:2: mode: must be 'vehicles', 'standalone' or 'cluster', not 'standalne'"),
    ("experiment check timeout.yaml", "timeout.yaml:3: timeout: must be greater than 0, not -5"),
    ("images build nope", "'nope' is not one of 'component', 'operator'"),
    ("completion tcsh", "'tcsh' is not one of 'bash', 'zsh', 'fish'"),
]  # fmt: skip
"""A command, and parts of its answer."""

RING = [[50.87, 4.68], [50.87, 4.69], [50.88, 4.69]]
AT = [0, 0, 0, None, 50.87, 4.68, 20]


def plan_file(**parts: Any) -> str:
    """Return a plan of QGroundControl with these parts."""
    return json.dumps({"fileType": "Plan", "version": 1, **parts})


def fence(*polygons: Any, **more: Any) -> str:
    return plan_file(geoFence={"version": 2, "polygons": polygons, **more})


def polygon(**fields: Any) -> dict[str, Any]:
    return {"polygon": RING, "inclusion": False, "version": 1, **fields}


def circle(**fields: Any) -> str:
    return fence(
        circles=[{"circle": {"center": [50.87, 4.68], "radius": 50, **fields}, "inclusion": True, "version": 1}]
    )


def item(command: object = 16, params: Any = AT, frame: object = 3) -> dict[str, Any]:
    return {"type": "SimpleItem", "command": command, "frame": frame, "params": params}


def mission(*items: Any) -> str:
    return plan_file(mission={"version": 2, "items": items})


FENCES = [
    ("", "line 1: invalid JSON", "export the file again"),
    ("QGC WPL 110\n", "line 1: invalid JSON", "export the file again"),
    ("[1]", "this is not a JSON object", "export the file again"),
    (plan_file(fileType="Mission"), "fileType: must be Plan, not 'Mission'; save the plan with QGroundControl"),
    (plan_file(version=2), "version: must be 1, not 2; save the plan again"),
    (plan_file(), "the file contains no zone; draw a polygon or a circle"),
    (plan_file(geoFence={"version": 1, "polygon": []}), "geoFence.version: must be 2, not 1; save the plan again"),
    (plan_file(geoFence={"version": 2, "polygons": polygon()}), "geoFence.polygons: must be a list of objects"),
    (fence(polygon(version=7)), "geoFence.polygons[0].version: must be 1, not 7; save the plan again"),
    (fence(polygon(inclusion="no")), "polygons[0].inclusion: must be true or false, not 'no'; choose Inclusion or not"),
    (fence(polygon(altitude=50)), "polygons[0].altitude: a Zone cannot represent this field; remove it if"),
    (fence(polygon(polygon=RING[:2])), "polygons[0].polygon: a ring needs at least three points"),
    (
        fence(polygon(polygon=[[150.87, 4.68], *RING])),
        "polygon[0]: 150.87, 4.68 is not a place on Earth; the order is lat, lon",
    ),
    (fence(polygon(polygon=[["50.87", 4.68], *RING])), "polygon[0]: must be two numbers, degrees"),
    (fence(polygon(polygon=[[50.87, 4.68, 5], *RING])), "has a height; remove the heights"),
    (fence(polygon(polygon=[*RING, [50.86, 4.685]])), "the ring crosses itself", "list the points in order"),
    (fence(polygon()).replace("50.88", "NaN"), "NaN is not a JSON number; use a finite number"),
    (circle(radius=0), "circle.radius: must be above 0 and at most 200000 metres, not 0"),
    (circle(radius="50 m"), "circle.radius: must be above 0 and at most 200000 metres, not '50 m'"),
    (circle(center={"lat": 50.87, "lon": 4.68}), "circle.center: must be two numbers, degrees"),
]
"""A plan file of QGroundControl with a wrong fence, and parts of the answer of `fractus zones import`."""

MISSIONS = [
    ("", "not a QGroundControl plan, which is JSON; save it as .plan"),
    ("QGC WPL 110\n", "not a QGroundControl plan, which is JSON; save it as .plan"),
    ("[]", "has no list mission.items; save the plan again"),
    (plan_file(), "has no list mission.items; save the plan again"),
    (plan_file(fileType="Fence", mission={"items": [item()]}), "fileType must be Plan, not 'Fence'; save the plan"),
    (mission(), "the plan contains no waypoint; add waypoints or a survey"),
    (mission("a"), "item 1 must be an object, not 'a'; save the plan again"),
    (mission(item("16")), "item 1 has no MAV_CMD as command, but '16'; save the plan again"),
    (mission(item(), item(177)), "item 2 (MAV_CMD_DO_JUMP) cannot be flown; remove it from the plan"),
    (mission(item(), item(20), item()), "item 2 (MAV_CMD_NAV_RETURN_TO_LAUNCH) comes before a waypoint", "split the plan"),
    (mission(item(frame=2)), "has the unsupported frame 2; use altitudes above home, AMSL or terrain"),
    (mission(item(params=AT[:5])), "must have a list of 7 params; save the plan again"),
    (mission(item(params=[*AT[:4], "50.8", 4.6, 20])), "has the param 5 '50.8', which must be a number or null"),
    (mission(item(params=[*AT[:4], 150.8, 4.6, 20])), "has the position 150.8, 4.6, which is not a place on Earth"),
    (mission(item(params=[*AT[:4], 0, 0, 20])), "has the position 0, 0, which ArduPilot treats as the current position"),
    (mission(item(params=[*AT[:6], None])), "has no complete position; give latitude, longitude and altitude"),
    (mission(item(params=[-3, *AT[1:]])), "has a negative stay or acceptance radius; set params 1 and 2 to 0 or more"),
    (mission(item(params=[0, 0, 0, 9000, *AT[4:]])), "has the heading 9000 degrees; set param 4 to -360 to 360"),
    (mission(item(178, [1, -5, -1, 0, 0, 0, 0]), item()), "item 1 (MAV_CMD_DO_CHANGE_SPEED) has the speed -5 m/s; set param 2"),
    (mission({"type": "ComplexItem", "complexItemType": "StructureScan"}), "item 1 (StructureScan) contains no waypoints", "replace it"),
]  # fmt: skip
"""A plan file of QGroundControl with a wrong mission, and parts of the answer of `fractus.read_plan`."""

Answer = Callable[[str], str]


@pytest.fixture
def answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Answer:
    """Return a function that runs a command in a directory with FILES, and returns what it prints."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("KUBECONFIG", "none.yaml")
    monkeypatch.setenv("FRACTUS_STATE", str(tmp_path / "clusters"))
    (tmp_path / "folder").mkdir()
    for name, content in FILES.items():
        (tmp_path / name).write_text(content)

    def call(command: str) -> str:
        code = run(command.split())
        printed = capsys.readouterr()
        text = printed.out + printed.err
        # A note about a valid object, and a leg that policies forbid, do not change the exit code.
        assert code != 0 or "note: " in text or "policy conflict: " in text, f"accepted: {text}"
        assert "Traceback" not in text
        return text

    return call


@pytest.mark.parametrize("change", CHANGED, ids=[f"{new.strip()[:40]}" for _, new, *_ in CHANGED])
def test_wrong_manifest_is_answered_with_its_line_and_the_remedy(answer: Answer, change: tuple[str, ...]) -> None:
    old, new, *fragments = change
    assert MANIFESTS.count(old) >= 1
    Path("m.yaml").write_text(MANIFESTS.replace(old, new, 1))
    text = answer("plan -f m.yaml")
    assert [fragment for fragment in fragments if fragment not in text] == [], text


@pytest.mark.parametrize("row", COMMANDS, ids=[command for command, *_ in COMMANDS])
def test_wrong_command_is_answered_with_what_is_wrong_and_the_remedy(answer: Answer, row: tuple[str, ...]) -> None:
    command, *fragments = row
    text = answer(command)
    assert [fragment for fragment in fragments if fragment not in text] == [], text


@pytest.mark.parametrize("row", FENCES, ids=range(len(FENCES)))
def test_wrong_fence_of_plan_is_answered_with_its_field_and_the_remedy(answer: Answer, row: tuple[str, ...]) -> None:
    content, *fragments = row
    Path("wrong.plan").write_text(content)
    text = answer("zones import wrong.plan --from qgc-plan")
    assert [fragment for fragment in fragments if fragment not in text] == [], text


@pytest.mark.parametrize("row", MISSIONS, ids=range(len(MISSIONS)))
def test_wrong_mission_of_plan_is_answered_with_its_item_and_the_remedy(tmp_path: Path, row: tuple[str, ...]) -> None:
    content, *fragments = row
    path = tmp_path / "wrong.plan"
    path.write_text(content)
    with pytest.raises(fractus.InvalidRequest) as refused:
        fractus.read_plan(path)
    assert [fragment for fragment in (str(path), *fragments) if fragment not in str(refused.value)] == [], refused.value


def test_right_manifests_of_the_table_are_accepted(answer: Answer, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(AssertionError, match="accepted"):
        answer("plan -f m.yaml")
    assert run(["plan", "-f", "m.yaml"]) == 0
    assert "note: " not in capsys.readouterr().err
