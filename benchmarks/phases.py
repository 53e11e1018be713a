"""What a user of a shipped study waits for: CPU time by phase, with compiled forms and modules at hand.

python -m benchmarks phases [--studies beam-chaos ...]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from benchmarks.beams import CONFIG

STUDIES = ("beam", "beam-chaos", "inclusion", "organ")
PHASES = ("imports", "solves", "rest of the run", "writing", "report", "all")
SCRIPT = """
import builtins, importlib, sys, time
from resource import RUSAGE_CHILDREN, getrusage

def used():
    children = getrusage(RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime

spent, inside = {"imports": 0.0}, []

def timed(name, function):
    def call(*args, **named):
        before, imported = used(), spent["imports"]
        inside.append(name)
        try:
            return function(*args, **named)
        finally:
            inside.pop()
            if name != "imports" or "imports" not in inside:
                spent[name] = spent.get(name, 0.0) + used() - before
                if name != "imports":
                    spent[name] -= spent["imports"] - imported
    return call

builtins.__import__ = timed("imports", builtins.__import__)
importlib.import_module = timed("imports", importlib.import_module)
import workflows.run.run as study
from workflows.__main__ import main

study._leave = timed("writing", study._leave)
study._report = timed("report", study._report)
code = main(["run", sys.argv[1], "--out", sys.argv[2], "--quiet"])
import json
summary = json.load(open(sys.argv[2] + "/summary.json"))
spent |= {"solves": summary["cpu_seconds"], "all": used()}
spent["rest of the run"] = spent["all"] - sum(spent[name] for name in ("imports", "solves", "writing", "report"))
print(json.dumps(spent))
sys.exit(code)
"""


def main(words: Sequence[str] = ()) -> None:
    """Print a row for each study; one run each. A first run compiles forms; what is measured is a second."""
    options = argparse.ArgumentParser("phases", description=__doc__)
    options.add_argument("--studies", nargs="+", default=STUDIES)
    studies = options.parse_args(words).studies
    modules = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    print("| study | " + " | ".join(f"{name} (s)" for name in PHASES) + " |")
    print("|---|" + "---|" * len(PHASES))
    for name in studies:
        with tempfile.TemporaryDirectory() as out:
            command = [sys.executable, "-c", SCRIPT, str(CONFIG.parent / f"{name}.toml"), str(Path(out) / "out")]
            done = subprocess.run(
                command, stdout=subprocess.PIPE, text=True, cwd=CONFIG.parent.parent, check=False, env=modules
            )
        spent = json.loads(done.stdout.splitlines()[-1])
        print(f"| `{name}.toml` | " + " | ".join(f"{spent[phase]:.2f}" for phase in PHASES) + " |", flush=True)
