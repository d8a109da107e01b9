"""`python -m hoigs`: the `hoigs` command."""

from hoigs.cli.main import main

if __name__ == "__main__":
    main()
