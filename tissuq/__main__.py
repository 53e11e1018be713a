"""The command line."""

import sys

import tissuq  # noqa: F401 - where the packages are
from workflows.__main__ import main

if __name__ == "__main__":
    sys.exit(main())
