"""Scripts by which shells complete the command line: commands, options, kinds of studies, files and directories.

They are made from the parser itself, so that they know every command and option that there is.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import NamedTuple

SHELLS = ("bash", "zsh", "fish")
STUDY, FOLDER, FILE, ANYTHING = "study", "folder", "file", ""
TAKEN = {"STUDY.toml": STUDY, "DIR": FOLDER, "FILE": FILE}


class Option(NamedTuple):
    """An option of a command: its name with dashes, its help, what it takes (None: nothing), and words to choose."""

    name: str
    text: str
    takes: str | None


class Command(NamedTuple):
    """A command: its name, its help, its options, what its arguments are, and the words among which these are."""

    name: str
    text: str
    options: tuple[Option, ...]
    takes: str
    words: tuple[str, ...]


def completion(shell: str, parser: argparse.ArgumentParser) -> str:
    """Return the script for a shell of `SHELLS`."""
    found = tuple(commands(parser))
    return {"bash": _bash, "zsh": _zsh, "fish": _fish}[shell](found)


def commands(parser: argparse.ArgumentParser) -> Iterator[Command]:
    """Return the commands of a parser, in the order of its help."""
    from workflows.starter import starter

    (group,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    texts = {action.dest: action.help or "" for action in group._choices_actions}
    for name, command in group.choices.items():
        options, takes = [], ANYTHING
        words: tuple[str, ...] = ()
        for action in command._actions:
            kind = TAKEN.get(str(action.metavar), ANYTHING)
            if action.option_strings:
                text = (action.help or "").partition(" (")[0]
                options.append(Option(action.option_strings[-1], text, None if action.nargs == 0 else kind))
            else:
                takes, words = kind, tuple(action.choices or ())
        if name == "init":
            words = (*starter("list").split(), "list")
        yield Command(name, texts[name], tuple(options), takes, words)


def _bash(found: tuple[Command, ...]) -> str:
    cases = "\n".join(
        f"        {one.name}) options={_quoted(' '.join(o.name for o in one.options))}"
        f" words={_quoted(' '.join(one.words))} takes={one.takes or 'none'} ;;"
        for one in found
    )
    valued = ((f"{one.name} {o.name}", o.takes) for one in found for o in one.options if o.takes is not None)
    after = "\n".join(f"        {_quoted(pair)}) takes={takes or 'none'} options= words= ;;" for pair, takes in valued)
    return f"""\
# Completion of tissuq for bash: source <(tissuq completion bash)
_tissuq() {{
    local word=${{COMP_WORDS[COMP_CWORD]}} before=${{COMP_WORDS[COMP_CWORD-1]}} options= words= takes=none
    COMPREPLY=()
    if [ "$COMP_CWORD" = 1 ]; then
        COMPREPLY=($(compgen -W {_quoted(" ".join([*(one.name for one in found), "--help", "--version"]))} -- "$word"))
        return
    fi
    case ${{COMP_WORDS[1]}} in
{cases}
    esac
    case "${{COMP_WORDS[1]}} $before" in
{after}
    esac
    case $word in
        -*) COMPREPLY=($(compgen -W "$options" -- "$word")); return ;;
    esac
    COMPREPLY=($(compgen -W "$words" -- "$word"))
    compopt -o filenames 2>/dev/null
    case $takes in
        study) COMPREPLY+=($(compgen -f -X '!*.toml' -- "$word") $(compgen -d -- "$word")) ;;
        folder) COMPREPLY+=($(compgen -d -- "$word")) ;;
        file) COMPREPLY+=($(compgen -f -- "$word")) ;;
    esac
}}
complete -F _tissuq tissuq
"""


def _zsh(found: tuple[Command, ...]) -> str:
    of = {STUDY: "_files -g '*.toml'", FOLDER: "_files -/", FILE: "_files", ANYTHING: ""}
    names = "\n".join(f"        {_quoted(f'{one.name}:{one.text}')}" for one in found)
    cases = []
    for one in found:
        given = f"({' '.join(one.words)})" if one.words else of[one.takes]
        lines = [
            _quoted(f"{'*' if o.name == '--set' else ''}{o.name}[{_bare(o.text)}]" + _value(o, of)) for o in one.options
        ]
        if given:
            lines.append(_quoted(f"*:{one.takes or 'word'}:{given}".replace("'", '"')))
        body = " \\\n                ".join(["_arguments", *lines])
        cases.append(f"        {one.name})\n            {body} ;;")
    joined = "\n".join(cases)
    return f"""\
#compdef tissuq
# Completion of tissuq for zsh: tissuq completion zsh > a folder of $fpath, as _tissuq
_tissuq() {{
    local -a commands=(
{names}
    )
    if (( CURRENT == 2 )); then
        _describe command commands
        return
    fi
    shift words
    (( CURRENT-- ))
    case $words[1] in
{joined}
    esac
}}
if [ "$funcstack[1]" = _tissuq ]; then _tissuq "$@"; else compdef _tissuq tissuq; fi
"""


def _value(option: Option, of: dict[str, str]) -> str:
    if option.takes is None:
        return ""
    return f":{option.takes or 'value'}:{of[option.takes]}".replace("'", '"')


def _fish(found: tuple[Command, ...]) -> str:
    lines = ["# Completion of tissuq for fish: tissuq completion fish > ~/.config/fish/completions/tissuq.fish"]
    lines += ["complete -c tissuq -f", "complete -c tissuq -n __fish_use_subcommand -l version -d 'print the version'"]
    files = {
        STUDY: "-a '(__fish_complete_suffix .toml)'",
        FOLDER: "-a '(__fish_complete_directories)'",
        FILE: "-F",
        ANYTHING: "",
    }
    for one in found:
        lines.append(f"complete -c tissuq -n __fish_use_subcommand -a {one.name} -d {_quoted(one.text)}")
        here = f"complete -c tissuq -n '__fish_seen_subcommand_from {one.name}'"
        if one.words:
            lines.append(f"{here} -a {_quoted(' '.join(one.words))}")
        elif one.takes:
            lines.append(f"{here} {files[one.takes]}")
        for option in one.options:
            takes = "" if option.takes is None else f" -r {files[option.takes]}".rstrip()
            lines.append(f"{here} -l {option.name.removeprefix('--')}{takes} -d {_quoted(option.text)}")
    return "\n".join(lines) + "\n"


def _bare(text: str) -> str:
    """Without what `_arguments` of zsh reads as its own."""
    return text.replace("[", "(").replace("]", ")").replace(":", ",").replace("`", "")


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "'\\''") + "'"
