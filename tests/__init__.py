"""Tests."""

import os
import tempfile

# Where compiled modules are kept, for tests and what they start, if the environment does not let them stand beside
# their sources.
COMPILED = f"{tempfile.gettempdir()}/tissuq-tests-{os.getuid()}"
