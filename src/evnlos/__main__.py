"""Run the commands, as `evnlos` or as `python -m evnlos`."""

import sys


def main() -> None:
    """Run the command line; Ctrl-C while the imports still run ends with code 130, too, and no traceback."""
    try:
        from evnlos.cli import main as run

        run()
    except KeyboardInterrupt:
        print("evnlos: interrupted", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
