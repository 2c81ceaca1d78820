"""The `robsmooth` command, which an interrupt ends without a traceback from its first moment."""

import signal
import sys


def main() -> int:
    """Run the command."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # while the rest is imported
    from robsmooth import cli

    return cli.main()


if __name__ == "__main__":
    sys.exit(main())
