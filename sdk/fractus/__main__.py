"""`python -m fractus` is the `fractus` command."""

from fractus.cli import main

if __name__ == "__main__":
    main()
