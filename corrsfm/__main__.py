"""``python -m corrsfm`` and the command ``corrsfm``."""

# Whatever else is needed is imported where an interruption is caught.
import os

__all__ = ["main"]

# With less, numpy's library ends the process while it is loaded, with words of its own.
LEAST_ADDRESS_BYTES = 192 << 20
# With fewer, Python itself stumbles before an error can be told.
LEAST_OPEN_FILES = 32
_INTERRUPTED = 130


def main() -> None:
    """Run a command; Ctrl-C while it is being loaded ends it without a word."""
    try:
        _run()
    except KeyboardInterrupt:
        # Nothing has begun, or everything has ended.
        os._exit(_INTERRUPTED)


def _run() -> None:
    import resource
    import signal
    import sys

    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY and limit < LEAST_ADDRESS_BYTES:
        sys.exit("Error: not enough memory to begin; raise the limit with: ulimit -v unlimited")
    limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if limit != resource.RLIM_INFINITY and limit < LEAST_OPEN_FILES:
        sys.exit(f"Error: only {limit} files may be open at once; raise the limit with: ulimit -n 1024")
    try:
        from corrsfm.cli import main as commands

        commands(prog_name="corrsfm")
    finally:
        # After an interruption of a text that was executed, as dataclasses do, Python would end by that
        # signal, whatever the exit status; another text makes it forget.
        exec("")
        # Python's own end would answer an interruption with a traceback.
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, signal.SIG_DFL)


if __name__ == "__main__":
    main()
