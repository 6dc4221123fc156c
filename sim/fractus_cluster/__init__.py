"""Embedded cluster: Kubernetes with several nodes on one Linux machine.

Start a cluster, use it and remove it:

    cluster = Cluster.load(Path("examples/clusters/demo.yaml"))
    cluster.up()
    cluster.kubectl("get", "nodes")
    cluster.node("drone-1").power_off()
    cluster.down()

This module imports nothing, because `node_init` is part of the package and must start fast.
"""
