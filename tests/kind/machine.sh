#!/usr/bin/env bash
# machine.sh COMMAND...: run COMMAND with Docker, kind, kubectl and helm on a Debian machine without a container engine and
# without access to an image registry (root). The script starts Docker's engine in separate namespaces, builds kind and
# Kubernetes from Go modules and base and node images with debootstrap, and stops everything after COMMAND.
#
#   FRACTUS_KIND=FOLDER      keep the engine's images there for the next run (about 6 GB)
#   FRACTUS_KUBERNETES=1.34  version of Kubernetes
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
source=$(cd "$here/../.." && pwd)
kind_module=sigs.k8s.io/kind@v0.32.0
base=debian:trixie-slim
node=localhost/kind/node:dev
network=fractus-kind
home=${FRACTUS_KIND:-$(mktemp -d /var/tmp/fractus-kind.XXXXXX)}
host_ca=/etc/ssl/certs/ca-certificates.crt
# Settings that kubelets change for the whole machine. They are restored at the end.
sysctls=(kernel.panic kernel.panic_on_oops vm.overcommit_memory vm.panic_on_oom kernel.keys.root_maxbytes kernel.keys.root_maxkeys)

say() { echo "machine: $*" >&2; }

programs() {
  [ -n "$(command -v dockerd)" ] || {
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -qq --no-remove --no-install-recommends docker.io > /dev/null
  }
  make -C "$source" packages env
  mkdir -p "$home/bin"
  "$source/.venv/bin/fractus" cluster binaries --with kubeadm --with kind | while read -r name path; do
    ln -sf "$path" "$home/bin/$name"
  done
  ln -sf /usr/bin/docker "$home/bin/docker"
  export PATH="$home/bin:$PATH"
}

# Write a wrapper of runc that limits privileged containers to the capabilities of this machine.
runtime() {
  cat > "$home/bin/runc-bounded" <<'RUNC'
#!/usr/bin/env bash
# runc without CAP_SYS_RESOURCE, which this machine lacks.
arguments=("$@")
for ((i = 0; i < $#; i++)); do
  case ${arguments[i]} in
    --bundle | -b) file="${arguments[i + 1]}/config.json" ;;
    --process | -p) file="${arguments[i + 1]}" ;;
    *) continue ;;
  esac
  [ ! -f "$file" ] || sed -i -e 's/"CAP_SYS_RESOURCE",//g' -e 's/,"CAP_SYS_RESOURCE"//g' "$file"
done
exec /usr/sbin/runc "$@"
RUNC
  chmod +x "$home/bin/runc-bounded"
}

engine() {
  say "starting Docker's engine in $home"
  ip netns add "$network"
  ip link add "$network" type veth peer name eth0 netns "$network"
  ip address add 10.203.0.1/30 dev "$network"
  ip link set "$network" up
  ip -n "$network" address add 10.203.0.2/30 dev eth0
  ip -n "$network" link set lo up
  ip -n "$network" link set eth0 up
  ip -n "$network" route add default via 10.203.0.1
  nft "table ip $network { chain out { type nat hook postrouting priority srcnat; ip saddr 10.203.0.0/30 masquerade; }; }"
  sysctl -qw net.ipv4.ip_forward=1
  local options=(--data-root "$home/data" --exec-root "$home/run" --pidfile "$home/docker.pid" --host "unix://$home/docker.sock")
  options+=(--cgroup-parent "/$network")
  if [ $((0x$(awk '/^CapBnd/ {print $2}' /proc/self/status) >> 24 & 1)) = 0 ]; then
    runtime
    options+=(--add-runtime "bounded=$home/bin/runc-bounded" --default-runtime bounded)
  fi
  # The containers and mounts end with this process. Its own /run/containerd keeps it from using the machine's containerd.
  setsid nsenter --net="/run/netns/$network" unshare --mount --pid --fork --kill-child --mount-proc \
    sh -c 'mkdir -p /run/containerd && mount -t tmpfs tmpfs /run/containerd && exec dockerd "$@"' dockerd "${options[@]}" \
    > "$home/dockerd.log" 2>&1 &
  engine=$!
  export DOCKER_HOST="unix://$home/docker.sock" DOCKER_BUILDKIT=1
  for _ in $(seq 600); do
    docker info > /dev/null 2>&1 && return
    kill -0 "$engine" || break
    sleep 0.2
  done
  tail -n 20 "$home/dockerd.log" >&2
  return 1
}

# The base image, which a registry would provide otherwise. It has the machine's CA bundle, because package indexes may be
# behind a proxy.
debian() {
  docker image inspect "$base" > /dev/null 2>&1 || {
    say "making $base"
    "$source/.venv/bin/python" -c 'from fractus_cluster.images.build import ensure_base; ensure_base(report=print)'
    buildah push --quiet localhost/fractus/base:trixie "docker-archive:$home/base.tar:$base"
    docker load --quiet --input "$home/base.tar"
    rm "$home/base.tar"
    printf 'FROM %s\nCOPY ca-certificates.crt /opt/ca.crt\n' "$base" | docker build --quiet --tag "$base" --file - /etc/ssl/certs
  }
  export BUILD_OPTIONS="--build-arg SSL_CERT_FILE=/opt/ca.crt"
}

nodes() {
  local version context name image
  version=$(kubeadm version --output short)
  say "making the image of nodes, Kubernetes $version"
  context=$(mktemp -d "$home/node.XXXXXX")
  cp -r "$here/node/." "$context"
  mkdir "$context/programs" "$context/images"
  for name in kube-apiserver kube-controller-manager kube-scheduler kube-proxy kubelet kubeadm kubectl etcd coredns pause; do
    cp -L "$home/bin/$name" "$context/programs/$name"
  done
  cp -r "$(cd "$context" && go mod download -json "$kind_module" | awk -F '"' '/"Dir"/ {print $4}')/images/base/files" "$context/kind"
  chmod -R u+w "$context/kind"
  echo "$version" > "$context/version"
  for image in $(kubeadm config images list --kubernetes-version "$version") localhost/kind/cni:dev; do
    name=$(basename "${image%:*}")
    case $name in
      coredns | pause | kube-proxy | cni) docker build --quiet --target "$name" --tag "$image" "$context" ;;
      *) docker build --quiet --target program --build-arg "NAME=$name" --tag "$image" "$context" ;;
    esac
    docker save --output "$context/images/$name.tar" "$image"
    case $name in pause) pause=$image ;; esac
  done
  docker build --quiet --target node --build-arg "PAUSE=$pause" --tag "$node" "$context"
  rm -rf "$context"
  export KIND_NODE_IMAGE=$node
}

leave() {
  code=$?
  say "cleaning"
  if [ -n "${engine:-}" ]; then
    kill -KILL -- "-$engine" 2> /dev/null || true
    wait "$engine" 2> /dev/null || true
  fi
  for _ in $(seq 100); do
    find /sys/fs/cgroup -depth -type d -path "/sys/fs/cgroup/*/$network*" -exec rmdir {} + 2> /dev/null && break
    sleep 0.1
  done
  nft delete table ip "$network" 2> /dev/null || true
  ip link delete "$network" 2> /dev/null || true
  ip netns delete "$network" 2> /dev/null || true
  sysctl -qw "${before[@]}"
  rm -rf "$home/run" "$home/docker.pid" "$home/docker.sock" "$home"/node.*
  [ -n "${FRACTUS_KIND:-}" ] || rm -rf "$home"
  exit "$code"
}

[ "$(id -u)" = 0 ] || { echo "run as root" >&2; exit 1; }
mkdir -p "$home"
mapfile -t before < <(for name in "${sysctls[@]}" net.ipv4.ip_forward; do echo "$name=$(sysctl -n "$name")"; done)
trap leave EXIT
programs
engine
debian
nodes
nsenter --net="/run/netns/$network" "$@"
