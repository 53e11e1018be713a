"""What is above all exceptions of the program; nothing is imported here."""


class Error(Exception):
    """Something that the user of the program can mend, or has to know: the message says what, a line for each.

    Every exception that the program raises on purpose is one, beside what else it is (a ValueError, a KeyError).
    """


class UnknownError(Error, KeyError):
    """A name that is not there; the message says which one was probably meant."""

    __str__ = Exception.__str__  # that of a KeyError is in quotes
