#!/usr/bin/env bash
# Tests on a cluster of kind: images built by Docker, the charts, end-to-end tests of missions, the demo.
# Needs docker, kind, kubectl and helm on the PATH. tests/kind/machine.sh provides them on machines without Docker.
#
#   BY=kubeadm            create the cluster by kubeadm, without kind (tests/kind/kubeadm.sh)
#   STEPS="cluster"       only these steps, of: images cluster load charts tests demo uninstall one_node
#   ON_KIND="FILES..."    the test files to run
#   KEEP=1                keep the clusters
#   KIND_NODE_IMAGE=NAME  image of the nodes; default of kind if unset
#   BUILD_OPTIONS="..."   options of `docker build`
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."

name=fractus
targets=(operator agent mobility camera sim example-traffic-monitoring)
made=()
state=$(mktemp -d)
export KUBECONFIG=$state/kubeconfig FRACTUS_E2E_CLUSTER=current

images() {
  for target in "${targets[@]}"; do
    # shellcheck disable=SC2086 # several words
    docker build --quiet ${BUILD_OPTIONS:-} --target "$target" --tag "localhost/fractus/$target:dev" .
  done
}

right_version() {
  local runs
  runs=$(kubectl get nodes --output jsonpath='{.items[0].status.nodeInfo.kubeletVersion}')
  [[ $runs == "v${FRACTUS_KUBERNETES:-1}."* ]] || { echo "nodes run $runs, not $FRACTUS_KUBERNETES; set KIND_NODE_IMAGE" >&2; return 1; }
}

# create NAME [OPTION...]: create a cluster and wait until its nodes are ready.
create() {
  ! kind get clusters 2> /dev/null | grep -qx "$1" || { echo "a cluster $1 exists; remove it: kind delete cluster --name $1" >&2; return 1; }
  made+=("$1")
  kind create cluster --name "$@" --wait 300s ${KIND_NODE_IMAGE:+--image "$KIND_NODE_IMAGE"}
  kubectl wait --for=condition=Ready node --all --timeout=300s
  right_version
}

cluster() {
  create "$name" --config tests/kind/cluster.yaml
  for class in drone edge; do
    kubectl taint node --selector "fractus.dev/class=$class" "fractus.dev/class=$class:NoExecute"
  done
  kubectl get nodes --output wide --label-columns fractus.dev/class
}

nodes() { kind get nodes --name "$name"; }
delete() { kind delete cluster --name "$1"; }

load() {
  kind load docker-image --name "${1:-$name}" $(printf "localhost/fractus/%s:dev " "${targets[@]}")
}

charts() {
  local began=$SECONDS pods
  bash -e <(grep '^helm install' README.md)
  kubectl wait --for=condition=Ready pod --all --namespace fractus-system --timeout=300s
  pods=$((SECONDS - began))
  kubectl wait --for=condition=Ready drone --all --timeout=120s
  echo "from the first helm install: $pods s until all pods are Ready, $((SECONDS - began)) s until the drones are"
  kubectl get pods --namespace fractus-system --output wide
  helm --namespace fractus-system test fractus
}

tests() {
  # shellcheck disable=SC2086 # several words
  .venv/bin/pytest $ON_KIND
}

demo() {
  make demo CLUSTER=current
  ls out/demo/recordings/mobility-*.mcap
}

# Run the uninstall commands of docs/upgrades.md. No objects and no files of Fractus remain.
uninstall() {
  grep -q '^### Wipe nodes$' docs/upgrades.md && grep -q '^## Uninstall$' docs/upgrades.md
  bash -e <(sed -n '/^### Wipe nodes$/,/^##/s/^    \(helm .* upgrade .*\)/\1/p' docs/upgrades.md)
  bash -e <(sed -n '/^## Uninstall$/,/^## /s/^    \(kubectl delete app.*\|helm .* uninstall .*\)/\1/p' docs/upgrades.md)
  kubectl wait --for=delete pod --all --namespace fractus-system --timeout=120s
  kubectl wait --for=delete namespace/fractus-nodes --timeout=120s
  kinds=$(kubectl api-resources --verbs=list --output=name | grep -v '^events')
  left=$(kubectl get "$(echo $kinds | tr ' ' ',')" --all-namespaces --selector app.kubernetes.io/name=fractus --output name)
  [ -z "$left" ] || { echo "left: $left" >&2; return 1; }
  [ -n "$(nodes)" ] || { echo "the cluster $name has no nodes" >&2; return 1; }
  for node in $(nodes); do
    left=$(docker exec "$node" sh -c 'ls -A /var/lib/fractus 2> /dev/null || true')
    [ -z "$left" ] || { echo "left on $node: $left" >&2; return 1; }
  done
}

# docs/clusters.md, "One node": the same charts and a mission without edge nodes.
one_node() {
  # A small machine has room for one cluster. Keep clusters of other runs, and with KEEP=1.
  [ -n "${KEEP:-}" ] || [[ " ${made[*]} " != *" $name "* ]] || delete "$name"
  create "$name-one" --config <(sed '/^nodes:/,$d' tests/kind/cluster.yaml)
  kubectl label node --all fractus.dev/class=drone fractus.dev/cloud=true
  load "$name-one"
  charts
  kubectl apply --filename examples/traffic-monitoring/passenger-only.yaml
  kubectl wait --for=jsonpath='{.status.phase}'=Completed application.fractus.dev/road-pictures --timeout=600s
  kubectl get fractus --all-namespaces
}

leave() {
  code=$?
  if [ "$code" != 0 ]; then
    kubectl get nodes,pods --all-namespaces --output wide || true
    kubectl get events --all-namespaces --sort-by=.lastTimestamp | tail -n 30 || true
  fi
  [ -n "${KEEP:-}" ] || for cluster in "${made[@]}"; do delete "$cluster"; done
  [ -n "${KEEP:-}" ] || rm -rf "$state"
  exit "$code"
} >&2
trap leave EXIT

# shellcheck source=tests/kind/kubeadm.sh
[ -z "${BY:-}" ] || . "tests/kind/$BY.sh"
for step in ${STEPS:-images cluster load charts tests demo uninstall one_node}; do
  echo "== $step ($(date +%T))"
  "$step"
done
