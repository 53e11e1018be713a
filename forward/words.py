"""Numbers in words: rounded to their errors, with units, for people to read."""

from __future__ import annotations

import math
from typing import Any

_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
DIGITS = 15  # that a number has
MOST = 6  # of a number without its error
TWO = 3.55  # first digits of an error below which a second one is written
NONE = "–"  # shown for a missing number


def number(value: float | None, digits: int = 4) -> str:
    """Write a number with some significant digits; powers of ten where it is very small or large."""
    if value is None or math.isnan(value):
        return NONE
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    power = _power(float(f"{value:.{digits - 1}e}"))
    if power:
        return _scaled(f"{value / 10.0**power:.{digits}g}", power)
    return f"{float(f'{value:.{digits}g}'):,.10g}".replace("-", "−")


def power_of_ten(power: int) -> str:
    """Write a power of ten: 10⁻³."""
    return f"10{str(power).translate(_SUPERSCRIPTS)}"


def places(error: float) -> int:
    """Return to how many decimal places an error is written, by the rule of the Particle Data Group.

    Errors that begin with 10 to 35 have two digits, those with 36 to 94 one, and larger ones are rounded up to 10.
    """
    power = math.floor(math.log10(error))
    return (1 if error < TWO * 10.0**power else 0) - power


def margin(error: float) -> str:
    """Write an error alone, as `with_error` does: 0.012, 0.04."""
    found = _rounded([error], error, error, DIGITS)
    return number(error, 2) if found is None else found


def with_error(value: float, error: float) -> str:
    """Write a value and its error to the same place, that of `places`: 0.12279 ± 0.00015, 12.311 ± 0.009."""
    found = _rounded([value, error], value, error, DIGITS)
    return f"{number(value, 6)} ± {number(error, 2)}" if found is None else found


def rounded(value: float, error: float) -> str:
    """Write a value as `with_error` does, alone and to six digits at most; to four if it has no error."""
    found = _rounded([value], value, error, MOST)
    return number(value, 4) if found is None else found


def _rounded(numbers: list[float], value: float, error: float, most: int) -> str | None:
    """Write a value, or it and its error; None for those that have none to be rounded to."""
    if not (math.isfinite(value) and math.isfinite(error) and error > 0):
        return None
    decimals = places(error)
    if value:
        # Numbers have fifteen digits: an error below them is one of the last.
        decimals = min(decimals, most - 1 - math.floor(math.log10(abs(value))))
        numbers = [numbers[0], *(max(one, 10.0**-decimals) for one in numbers[1:])]
    power = _power(max(abs(value), error))
    after = max(decimals + power, 0)
    text = " ± ".join(f"{round(one, decimals) / 10.0**power + 0.0:,.{after}f}" for one in numbers)
    if not power:
        return text.replace("-", "−")
    return _scaled(f"({text})" if len(numbers) > 1 else text, power)


def duration(seconds: float) -> str:
    """Write a time: 0.23 s, 35 s, 4 min 10 s, 3 h 05 min."""
    if seconds < 99.5:
        return f"{seconds:.2g} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 100:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def worth(ratio: float) -> str:
    """Write how many plain samples one controlled sample replaces."""
    return number(ratio, 3)


def with_unit(text: str, unit: str) -> str:
    """Write the unit after a number, if it has one."""
    return text if unit == "1" or text == NONE else f"{text} {unit}"


def named(name: str, unit: str) -> str:
    """Write the unit after a name, if it has one."""
    return name if unit == "1" else f"{name} ({unit})"


def per(unit: str, divisor: str) -> str:
    """Unit of a derivative."""
    if divisor == "1":
        return unit
    return f"{unit}/({divisor})" if "/" in divisor else f"{unit}/{divisor}"


def settings(block: dict[str, Any], *left_out: str) -> str:
    """Write the settings of a block: a = 2, b = 2."""
    return ", ".join(f"{key} = {listed(value)}" for key, value in block.items() if key not in left_out)


def listed(value: Any) -> str:
    """Write a setting: numbers short, lists in parentheses."""
    if isinstance(value, tuple | list):
        return f"({', '.join(listed(item) for item in value)})"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _power(value: float) -> int:
    """Power of ten that is written separately: 0 for numbers of ordinary size."""
    power = math.floor(math.log10(abs(value))) if value else 0
    return 0 if -3 <= power < 6 else power


def _scaled(text: str, power: int) -> str:
    return f"{text} × {power_of_ten(power)}".replace("-", "−")
