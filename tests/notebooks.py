"""Run notebooks by Jupyter, with their pictures: ``python -m tests.notebooks [NAME ...]`` (`make notebooks`)."""

import sys
from pathlib import Path

import jupytext
import nbclient

ROOT = Path(__file__).parent.parent
OUT = ROOT / "results" / "notebooks"


def executed(path, timeout=600):
    """The notebook of a file with what its cells print and show."""
    notebook = jupytext.read(path)
    notebook.metadata.pop("kernelspec", None)  # this Python, whatever its kernel is called
    nbclient.NotebookClient(notebook, timeout=timeout, resources={"metadata": {"path": str(path.parent)}}).execute()
    return notebook


def main(names):
    OUT.mkdir(parents=True, exist_ok=True)
    for path in sorted((ROOT / "notebooks").glob("*.py")):
        if not names or path.stem in names or path.stem.partition("_")[0] in names:
            made = OUT / f"{path.stem}.ipynb"
            jupytext.write(executed(path), made)
            sys.stdout.write(f"{made.relative_to(ROOT)}\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
