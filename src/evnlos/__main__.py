"""Run the commands, as `evnlos` or as `python -m evnlos`."""

import signal
import sys


def main() -> None:
    """Run the command line; Ctrl-C while the imports still run ends with code 130, too, and no traceback."""
    wishes = []

    def end(*_: object) -> None:
        wishes.append(True)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, end)
    try:
        from evnlos.cli import main as run
    except BaseException:  # an interrupted import may end in any error
        if not wishes:
            raise
        print("evnlos: interrupted", file=sys.stderr)
        sys.exit(130)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        run()
    except KeyboardInterrupt:
        print("evnlos: interrupted", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
