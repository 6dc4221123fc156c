"""Embedded cluster: Kubernetes with several nodes on one Linux machine.

Start a cluster, use it and remove it:

    cluster = Cluster.load(Path("examples/clusters/demo.yaml"))
    cluster.up()
    cluster.kubectl("get", "nodes")
    cluster.node("drone-1").power_off()
    cluster.down()

This file imports nothing. Imports here would delay the start of `node_init`, which is a module of the package.
"""
