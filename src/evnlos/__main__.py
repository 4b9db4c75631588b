"""Run the commands, as `evnlos` or as `python -m evnlos`."""

import signal
import sys


def main() -> None:
    """Run the command line; Ctrl-C while the imports still run ends with code 130, too, and no traceback."""
    wishes = []

    def end(*_: object) -> None:
        wishes.append(True)
        raise KeyboardInterrupt

    is_heard = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # not in a script's background
    try:
        if is_heard:
            signal.signal(signal.SIGINT, end)
        from evnlos.cli import main as run

        if is_heard:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        if wishes:  # a library kept the interruption to itself
            raise KeyboardInterrupt
        try:
            run()
        finally:
            if is_heard and not isinstance(sys.exception(), KeyboardInterrupt):
                signal.signal(signal.SIGINT, signal.SIG_IGN)  # what Python still tidies up is not interrupted
    except KeyboardInterrupt:
        pass
    except Exception:  # an interrupted import may end in any error
        if not wishes:
            raise
    else:
        return
    print("evnlos: interrupted", file=sys.stderr)
    sys.exit(130)


if __name__ == "__main__":
    main()
