"""Completion of the command line, in the shells themselves."""

import shutil
import subprocess

import pytest

from tests.launch import ROOT, TISSUQ
from workflows.__main__ import _parser
from workflows.completion import SHELLS, completion
from workflows.starter import KINDS


def in_shell(shell, text, folder=ROOT):
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    done = subprocess.run([shell, "-c", text], check=False, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def in_bash(*words, folder=ROOT):
    """What bash offers for the last of some words."""
    typed = " ".join(f"'{word}'" for word in ("tissuq", *words))
    script = completion("bash", _parser())
    at = f"COMP_WORDS=({typed}); COMP_CWORD={len(words)}; _shtab_tissuq; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    return in_shell("bash", f"{script}\n{at}", folder)


def test_every_command_and_option_is_known():
    commands = ["check", "run", "report", "serve", "reduce", "init", "live", "schema", "completion"]
    options = ["set", "out", "quiet", "no-report", "code", "host", "port", "output"]
    for shell in SHELLS:
        script = completion(shell, _parser())
        for word in (*commands, *options):
            assert word in script, (shell, word)


def test_bash_completes_commands_options_kinds_and_files(tmp_path):
    assert in_bash("re") == ["report", "reduce"]
    assert in_bash("run", "--no") == ["--no-report"]
    assert set(in_bash("init", "sens")) == {"sensitivity-monte-carlo"}
    assert set(in_bash("init", "")) == {*KINDS, "list"}
    for name in ("one.toml", "other.txt"):
        (tmp_path / name).touch()
    (tmp_path / "on").mkdir()
    assert in_bash("check", "o", folder=tmp_path) == ["one.toml", "on"]
    assert set(in_bash("report", "--out", "o", folder=tmp_path)) == {"on", "one.toml", "other.txt"}
    assert in_bash("run", "--out", "o", folder=tmp_path) == ["on"]  # a directory, where that of a report is a file
    assert in_bash("run", "--set", "") == []


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_can_read_theirs(shell, tmp_path):
    (tmp_path / "script").write_text(completion(shell, _parser()))
    in_shell(shell, f"{shell} -n script", tmp_path)


def test_fish_completes():
    script = completion("fish", _parser())
    offered = in_shell("fish", f"{script}\ncomplete -C 'tissuq re'")
    assert {"reduce", "report"} <= set(offered)


def test_the_command_prints_it():
    done = subprocess.run([TISSUQ, "completion", "bash"], check=True, capture_output=True, text=True)
    assert done.stdout == completion("bash", _parser())
