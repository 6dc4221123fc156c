"""What a workload tells those who operate it: figures for Prometheus, and logs."""
