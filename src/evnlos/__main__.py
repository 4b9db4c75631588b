"""Run the commands as `python -m evnlos`."""

from evnlos.cli import main

if __name__ == "__main__":
    main()
