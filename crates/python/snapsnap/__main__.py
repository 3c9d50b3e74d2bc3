"""The command line: `python -m snapsnap` or `snapsnap`."""

import sys

from . import _native


def main() -> None:
    """Runs the program and ends with its exit code."""
    sys.exit(_native.main([sys.executable, "-m", "snapsnap"], sys.argv[1:]))


if __name__ == "__main__":
    main()
