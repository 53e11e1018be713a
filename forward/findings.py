"""What a user has to know about a result besides its numbers: findings as data, and the table of their words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple, Self

Severity = Literal["note", "warning", "error"]
FREE = ""  # code of words without an entry in the table, such as those of results by another version


@dataclass(frozen=True)
class Words:
    """How a kind of finding is said.

    Parameters
    ----------
    text
        Sentences, with places for values as of `str.format`: "its {n} samples", and {about} for the outputs. With
        `short`, a clause, of which a sentence is made.
    short
        A few words for a verdict, which names its data set itself; None where no verdict has it, "" of a note.
    between
        What stands between outputs.
    listed
        How many outputs are named; 0 for all.
    """

    text: str
    short: str | None = None
    between: str = ", "
    listed: int = 0


CATALOGUE: dict[str, Words] = {FREE: Words("{text}")}


def register(table: Mapping[str, str | Words]) -> None:
    """Add words of findings by their codes; a text alone stands for `Words` of it.

    Raises
    ------
    ValueError
        A code stands for other words already.
    """
    for code, said in table.items():
        words = Words(said) if isinstance(said, str) else said
        if CATALOGUE.setdefault(code, words) != words:
            raise ValueError(f"a finding with code '{code}' has other words already")


class Entry(NamedTuple):
    """What a finding says of one output.

    Parameters
    ----------
    name
        Of the output.
    words
        What follows the name.
    size
        By which outputs are compared, in one unit for all entries of a finding; None if they are not.
    """

    name: str
    words: str = ""
    size: float | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Finding:
    """What a user has to know about a result besides its numbers. Two that say the same are the same.

    Parameters
    ----------
    code
        What kind of finding it is: a key of `CATALOGUE`.
    severity
        "note" is worth knowing; with "warning" a number may be off; with "error" a number cannot be trusted.
    values
        Numbers and words for the places of the text.
    about
        Outputs of which it is said, if it is said of some.
    subject
        What it is said of before all else: a candidate, a data set.
    also
        Where else it holds with other numbers: "at steps 2, 3".
    """

    code: str
    severity: Severity
    values: Mapping[str, Any] = field(default_factory=dict)
    about: tuple[Entry, ...] = ()
    subject: str = ""
    also: str = ""

    @property
    def text(self) -> str:
        """A sentence or two: what, where, by how much, what to do."""
        words, said = CATALOGUE[self.code], self.clause
        if words.short is not None:
            opens = not self.subject and not words.text.startswith("{")  # a name is not written with a capital letter
            said = f"{said[0].upper() + said[1:] if opens else said}."
        subject = f"{self.subject}: " if self.subject else ""
        return f"{subject}{said}" + (f" The same, with other numbers, {self.also}." if self.also else "")

    @property
    def clause(self) -> str:
        """The words alone, as the table has them."""
        return self._filled(CATALOGUE[self.code].text)

    @property
    def short(self) -> str:
        """A few words for a verdict."""
        return self._filled(CATALOGUE[self.code].short or "")

    def _filled(self, text: str) -> str:
        words = CATALOGUE[self.code]
        shown = [entry.name + entry.words for entry in self.about]
        if words.listed and len(shown) > words.listed + 1:
            shown[words.listed :] = [f"and {len(shown) - words.listed} more"]
        return text.format_map({**self.values, "about": words.between.join(shown)})

    def of(self, subject: str) -> Finding:
        """Return the same, said of a subject."""
        return replace(self, subject=f"{subject}: {self.subject}" if self.subject else subject)

    def kept(self) -> dict[str, Any]:
        """Return severity and words, and what they are made of, for a file."""
        said = {"severity": self.severity, "text": self.text, "code": self.code, "subject": self.subject}
        return said | {"values": dict(self.values), "about": self.about, "also": self.also}

    @classmethod
    def read(cls, kept: Mapping[str, Any]) -> Self:
        """Return a finding as `kept` returned it; words that this version does not have stay as they were said."""
        severity, text = kept["severity"], kept["text"]
        try:
            about = tuple(Entry(*entry) for entry in kept["about"])
            found = cls(kept["code"], severity, kept["values"], about, kept["subject"], kept["also"])
            known = found.text == text
        except (KeyError, ValueError):  # no such code, or its text has other places
            known = False
        return found if known else cls(FREE, severity, {"text": text})

    def __eq__(self, other: object) -> bool:
        """Whether both say the same."""
        return isinstance(other, Finding) and (self.severity, self.text) == (other.severity, other.text)

    def __hash__(self) -> int:
        """By what is said."""
        return hash((self.severity, self.text))

    def __str__(self) -> str:
        """Severity and words."""
        return f"{self.severity}: {self.text}"

    __repr__ = __str__


def entries(names: Iterable[str]) -> tuple[Entry, ...]:
    """Return entries of outputs, of which nothing is said beside their names."""
    return tuple(Entry(str(name)) for name in names)
