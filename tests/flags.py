"""Run the tests that depend on the compiler's flags, or on OpenBLAS's kernels, as other processors would.

`make test-flags` shows each way that this processor can go; a suite that is green on one machine only shows that one.
"""

import subprocess
import sys
import time
from pathlib import Path

from forward import native
from tests.launch import ROOT, environment

LEVELS = {"x86-64-v2": "sse4_2", "x86-64-v3": "avx2"}  # and what shows that a processor has it
KERNELS = {"NEHALEM": "sse4_2", "HASWELL": "avx2"}


def ways():
    """Environments by their names, each with what a processor must have; `make test` is the one without changes."""
    for level, needed in LEVELS.items():
        flags = " ".join(native.FLAGS).replace("-march=native", f"-march={level}")
        yield f"compiled for {level}", {"TISSUQ_CFLAGS": flags}, needed
    for kernel, needed in KERNELS.items():
        yield f"OpenBLAS for {kernel}", {"OPENBLAS_CORETYPE": kernel}, needed


def processor():
    """What the system calls it."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    name = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), "unknown")
    has = [flag for flag in ("sse4_2", "avx2", "avx512f") if flag in native.processor().split()]
    return f"{name} ({', '.join(has)})"


def say(text):
    """Write a line at once."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def main(arguments):
    """Print a line for each way; return how many failed."""
    say(f"processor: {processor()}")
    failed = 0
    for name, changes, needed in ways():
        if needed not in native.processor().split():
            say(f"{name}: this processor has no {needed}")
            continue
        begin = time.monotonic()
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "--numprocesses",
            "2",
            "--dist",
            "loadfile",
            "-m",
            "flags and not slow",
        ]
        done = subprocess.run(
            [*command, *arguments], env=environment() | changes, cwd=ROOT, capture_output=True, text=True, check=False
        )
        say(f"{name}: {done.stdout.strip().splitlines()[-1]} ({time.monotonic() - begin:.0f} s)")
        if done.returncode:
            failed += 1
            say(f"{done.stdout}\n{done.stderr}")
    return failed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
