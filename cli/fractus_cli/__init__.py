"""The `fractus` command, and those of its commands that need no cluster: they answer as the operator would."""

EXIT_OK = 0
EXIT_BAD_INPUT = 1
EXIT_INFEASIBLE = 2
EXIT_INTERRUPTED = 130
