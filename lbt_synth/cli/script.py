"""The console script ``lbt-synth``, which Ctrl-C ends without a traceback.

Nothing is imported before it decides that, so that Python's own start is all that can show one.
"""

# built in; `signal` takes milliseconds to import
import _signal as signal  # type: ignore[import-not-found]


def entry_point() -> None:
    """Let Ctrl-C end the process at once until a command runs, and run it."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else it is ignored
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from lbt_synth.cli.main import entry_point

    entry_point()


if __name__ == "__main__":
    entry_point()
