"""`python -m fractus_cli` is the `fractus` command."""

from fractus_cli.main import main

if __name__ == "__main__":
    main()
