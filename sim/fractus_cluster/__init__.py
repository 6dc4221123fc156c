"""Embedded cluster: a real Kubernetes of several nodes on one Linux machine.

    cluster = Cluster.load(Path("examples/clusters/demo.yaml"))
    cluster.up()
    cluster.kubectl("get", "nodes")
    cluster.node("drone-1").power_off()
    cluster.down()

Nothing is imported here: the nodes' own first program lives in this package too, and must start fast.
"""
