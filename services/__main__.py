"""The command `envmatte`, also as `python -m services` where that is not on the path."""

import signal


def run() -> None:
    """Run a command. Until its modules are imported, Ctrl-C ends the process at once, without a traceback."""
    # A shell has it ignored in the background.
    if signal.getsignal(signal.SIGINT) == signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from services.cli.main import run

    run()


if __name__ == "__main__":
    run()
