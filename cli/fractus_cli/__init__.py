"""The `fractus` command, its commands that read a cluster, and its commands that work offline on manifests and files."""

EXIT_OK = 0
EXIT_BAD_INPUT = 1
EXIT_INFEASIBLE = 2
EXIT_INTERRUPTED = 130
