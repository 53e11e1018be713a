"""Scripts by which shells complete the command line: commands, options, kinds of studies, files and directories."""

from __future__ import annotations

import argparse

import shtab

SHELLS = ("bash", "zsh", "fish")
STUDIES = '_tissuq_studies() { compgen -f -X "!*.toml" -- "$1"; compgen -d -- "$1"; }'  # in bash
STUDY = shtab.FILE | {"bash": "_tissuq_studies", "zsh": "_files -g '*.toml'"}
TAKEN = {"STUDY.toml": STUDY, "FILE": shtab.FILE, "DIR": shtab.DIRECTORY}


def completion(shell: str, parser: argparse.ArgumentParser) -> str:
    """Return the script for a shell of `SHELLS`, made from the parser itself: it knows every command and option."""
    from workflows.starter import KINDS

    assert parser._subparsers is not None
    (group,) = parser._subparsers._group_actions
    assert group.choices is not None
    for command in dict(group.choices).values():
        for action in command._actions:
            if action.metavar in TAKEN:
                action.complete = TAKEN[action.metavar]
            elif action.metavar == "KIND":
                action.choices = (*KINDS, "list")
    return shtab.complete(parser, shell, preamble=STUDIES if shell == "bash" else "")
