"""Numbers in words: in a unit of the right size, rounded to their errors, for people to read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
DIGITS = 15  # that a number has
MOST = 6  # of a number without its error
TWO = 3.55  # first digits of an error below which a second one is written
NONE = "–"  # shown for a missing number
# From large to small: what one of it is in the SI unit, and its name. The first that a value reaches is taken.
SIZES: dict[str, tuple[tuple[float, str], ...]] = {
    "m": ((1.0, "m"), (1e-2, "cm"), (1e-3, "mm"), (1e-6, "µm"), (1e-9, "nm")),
    "Pa": ((1e9, "GPa"), (1e6, "MPa"), (1e3, "kPa"), (1.0, "Pa"), (1e-3, "mPa")),
    "N": ((1e3, "kN"), (1.0, "N"), (1e-3, "mN"), (1e-6, "µN")),
    "J": ((1e3, "kJ"), (1.0, "J"), (1e-3, "mJ"), (1e-6, "µJ"), (1e-9, "nJ")),
    "N m": ((1.0, "N m"), (1e-3, "mN m"), (1e-6, "µN m")),
    "m²": ((1.0, "m²"), (1e-4, "cm²"), (1e-6, "mm²")),
    "m³": ((1.0, "m³"), (1e-6, "cm³"), (1e-9, "mm³")),
    "N/m": ((1e3, "kN/m"), (1.0, "N/m"), (1e-3, "mN/m")),
}
LEAD = ("loads", "displacements", "material", "inclusions", "regions", "fields", "model")  # of paths, not said
ROUNDING = 1e-9  # of the largest coordinate of a place


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


def with_error(value: float, error: float) -> str:
    """Write a value and its error to the same place, that of `places`: 0.12279 ± 0.00015, 12.311 ± 0.009, 12 ± ∞."""
    found = _rounded([value, error], value, error, DIGITS)
    return f"{number(value, 2 if error == math.inf else MOST)} ± {number(error, 2)}" if found is None else found


def rounded(value: float, error: float) -> str:
    """Write a value as `with_error` does, alone; to four digits if it has no error, to two if that has no end."""
    found = _rounded([value], value, error, MOST)
    return number(value, 2 if error == math.inf else 4) if found is None else found


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


def scale(value: float, unit: str) -> tuple[float, str]:
    """Return what one of the fitting unit is in the SI unit, and its name: of 0.12 m, (0.01, "cm").

    What is zero, not finite or beyond all units keeps its own.
    """
    sizes = SIZES.get(unit)
    if sizes is None or not math.isfinite(value) or value == 0:
        return 1.0, unit
    smallest = sizes[-1][0]
    for one, name in sizes:
        if abs(value) >= one * (1 - 1e-12):
            return (one, name) if abs(value) < 1e6 * sizes[0][0] else (1.0, unit)
    return (smallest, sizes[-1][1]) if abs(value) > 1e-3 * smallest else (1.0, unit)


def quantity(value: float, error: float, unit: str) -> str:
    """Write a value to the place of its error (`places`) in a fitting unit: 12.28 cm."""
    one, name = scale(value, unit)
    return _with(rounded(value / one, error / one), name)


def size(value: float, unit: str, digits: int = 2, like: float | None = None) -> str:
    """Write a number without an error in a fitting unit: 0.33 mm; or in that of `like`."""
    one, name = scale(value if like is None else like, unit)
    return _with(number(value / one, digits), name)


def told(value: float, unit: str, digits: int = 2) -> str:
    """Write what `size` writes for a line of text: with an ordinary space before the unit."""
    return size(value, unit, digits).replace("\u00a0", " ")


def margin(error: float, unit: str = "1", like: float | None = None) -> str:
    """Write an error alone, as `with_error` does, in a fitting unit: 0.012, 0.33 mm; or in that of `like`."""
    one, name = scale(error if like is None else like, unit)
    found = _rounded([error / one], error / one, error / one, DIGITS)
    return _with(number(error / one, 2) if found is None else found, name)


def and_error(value: float, error: float, unit: str, like: float | None = None) -> str:
    """Write a value and its error in a fitting unit: 12.311 ± 0.009 cm; or in that of `like`."""
    largest = max(abs(value), error) if math.isfinite(error) else value
    one, name = scale(largest if like is None else like, unit)
    return _with(with_error(value / one, error / one), name)


def place(x: Sequence[float], digits: int = 3) -> str:
    """Write a place (m) in one unit; a coordinate that is rounding beside the others is zero."""
    largest = max(map(abs, x))
    one, unit = scale(largest, "m")
    return _with(", ".join(number(c / one if abs(c) > ROUNDING * largest else 0.0, digits) for c in x), unit)


def interval(lower: float, upper: float, unit: str, at: float) -> str:
    """Write an interval, to three digits of its width, in the unit of `at`: 11.0–13.7 cm."""
    if not (math.isfinite(lower) and math.isfinite(upper)):
        return NONE
    one, name = scale(at, unit)
    width = (upper - lower) / one
    last = 5 * 10.0 ** (math.floor(math.log10(width)) - 1) if width > 0 else 0.0
    ends = [rounded(end / one, last) for end in (lower, upper)]
    return _with((" to " if min(lower, upper) < 0 else "–").join(ends), name)


def spoken(path: str) -> str:
    """Name a number of a model by the end of its path: `loads.gravity.density` is the gravity density."""
    parts = path.split(".")
    return " ".join(parts[1:] if is_path(path) else parts)


def is_path(name: str) -> bool:
    """Whether a name is the path of a number of a model, as `loads.gravity.density` is."""
    return "." in name and name.split(".", maxsplit=1)[0] in LEAD


def percent(share: float) -> str:
    """Write a share: 71 %, 3.2 %, below 0.1 %."""
    if not math.isfinite(share):
        return NONE
    if share < 1e-3:
        return "below 0.1\u00a0%"
    if 0.9995 <= share < 1:
        return "above 99.9\u00a0%"
    return f"{100 * share:.{0 if share >= 0.1 else 1}f}\u00a0%"


def _with(text: str, unit: str) -> str:
    return text if unit == "1" or text == NONE else f"{text}\u00a0{unit}"
