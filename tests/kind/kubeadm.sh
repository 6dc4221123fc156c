# Steps of run.sh for BY=kubeadm: a cluster of six machines, set up as docs/clusters.md describes, without kind. The machines
# are containers of the node image that machine.sh builds.
control_plane=ground
declare -A classes=([falcon]=drone [kerb-a]=edge [kerb-b]=edge [kerb-c]=edge [rack]=cloud)
network=fractus-kubeadm
: "${STEPS:=images cluster load charts plugin tests uninstall}"

on() { docker exec --interactive "$@"; }
nodes() { printf '%s\n' "$control_plane" "${!classes[@]}"; }

delete() {
  docker rm --force --volumes $(nodes) > /dev/null
  docker network rm "$network" > /dev/null
}

# machine NAME: start a machine and wait for its container runtime.
machine() {
  docker run --detach --name "$1" --hostname "$1" --network "$network" --privileged --cgroupns private --tty \
    --security-opt seccomp=unconfined --security-opt apparmor=unconfined \
    --tmpfs /tmp --tmpfs /run --volume /var --volume /lib/modules:/lib/modules:ro "$KIND_NODE_IMAGE" > /dev/null
  for _ in $(seq 300); do
    on "$1" ctr version > /dev/null 2>&1 && return
    sleep 0.2
  done
  docker logs --tail 20 "$1" >&2
  return 1
}

cluster() {
  made+=("$name")
  docker network create "$network" > /dev/null
  for node in $(nodes); do machine "$node"; done
  sed "s/VERSION/$(on "$control_plane" kubeadm version --output short)/" tests/kind/kubeadm.yaml \
    | on "$control_plane" tee /etc/kubernetes/init.yaml > /dev/null
  on "$control_plane" kubeadm init --config /etc/kubernetes/init.yaml --ignore-preflight-errors all --skip-token-print
  on "$control_plane" cat /etc/kubernetes/admin.conf > "$KUBECONFIG"
  # Its network plugin has a separate namespace, like flannel.
  kubectl create namespace kube-flannel
  sed 's/namespace: kube-system/namespace: kube-flannel/' tests/kind/node/default-cni.yaml | kubectl apply --filename -
  join=$(on "$control_plane" kubeadm token create --print-join-command)
  for node in "${!classes[@]}"; do
    # shellcheck disable=SC2086 # several words
    on "$node" $join --ignore-preflight-errors all > /dev/null
  done
  kubectl wait --for=condition=Ready node --all --timeout=300s
  right_version
  for node in "${!classes[@]}"; do
    class=${classes[$node]}
    kubectl label node "$node" "fractus.dev/class=$class"
    [ "$class" = cloud ] || kubectl taint node "$node" "fractus.dev/class=$class:NoExecute"
  done
  kubectl get nodes --output wide --label-columns fractus.dev/class
}

# Run the commands of docs/clusters.md for each image on the nodes that need it.
load() {
  local image class save import
  save=$(sed -n 's/^    \(docker save .*\)/\1/p' docs/clusters.md)
  import=$(sed -n '/^    docker save /{n;s/^    \(ctr .* import NAME.tar\)/\1/p}' docs/clusters.md)
  [ -n "$save" ] && [ -n "$import" ] || { echo "docs/clusters.md has no commands to save and import images" >&2; return 1; }
  for image in "${targets[@]}"; do
    case $image in
      operator) class=cloud ;;
      agent | camera) class="drone edge" ;;
      mobility | sim) class=drone ;;
      *) class="drone edge cloud" ;;
    esac
    (cd "$state" && ${save//NAME/$image})
    for node in "${!classes[@]}"; do
      [[ " $class " = *" ${classes[$node]} "* ]] || continue
      on "$node" tee "/root/$image.tar" < "$state/$image.tar" > /dev/null
      docker exec --workdir /root "$node" ${import//NAME/$image} > /dev/null
      on "$node" rm "/root/$image.tar"
    done
    rm "$state/$image.tar"
  done
}

# Run the command of docs/clusters.md that exempts the plugin's namespace, and check that deleted pods of it come back.
plugin() {
  bash -e <(sed -n 's/^    \(helm upgrade .*kube-flannel.*\)/\1/p' docs/clusters.md)
  kubectl delete pod --all --namespace kube-flannel
  kubectl rollout status daemonset/routes --namespace kube-flannel --timeout=120s
}
