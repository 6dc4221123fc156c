# Pod network of a node: configuration of the CNI plugins, and routes to the pods of other nodes.
set -eu
cd /tmp
while true; do
  kubectl get nodes --output \
    jsonpath='{range .items[*]}{.metadata.name} {.spec.podCIDR} {.status.addresses[?(@.type=="InternalIP")].address}{"\n"}{end}' > nodes || true
  while read -r name subnet address; do
    [ -n "$address" ] || continue
    if [ "$name" != "$NODE" ]; then
      busybox ip route replace "$subnet" via "$address"
    elif [ ! -e /etc/cni/net.d/10-kind.conflist ]; then
      printf '%s' '{"cniVersion": "0.4.0", "name": "kind", "plugins": [
        {"type": "ptp", "ipam": {"type": "host-local", "dataDir": "/run/cni-ipam", "routes": [{"dst": "0.0.0.0/0"}],
          "ranges": [[{"subnet": "'"$subnet"'"}]]}},
        {"type": "portmap", "capabilities": {"portMappings": true}}]}' > /etc/cni/net.d/10-kind.conflist
    fi
  done < nodes
  busybox sleep 2
done
