"""Numbers of tables: one parser, one sentence for what is none."""

import math

import pytest

from inverse.data.table import needed, numeric


@pytest.mark.unit
def test_cells_are_numbers_or_empty():
    assert numeric(" 1e3 ", "x") == 1e3
    assert math.isnan(numeric("", "x", positive=True))
    assert needed("-2", "x") == -2


@pytest.mark.unit
@pytest.mark.parametrize("text", ["much", "nan", "inf", "-inf", "1,5"])
@pytest.mark.parametrize("read", [numeric, needed])
def test_what_is_no_number_is_said(read, text):
    with pytest.raises(ValueError, match=f"^x is '{text}', expected a number$"):
        read(text, "x")


@pytest.mark.unit
def test_what_is_not_positive_or_missing_is_said():
    for text in ("0", "-1"):
        with pytest.raises(ValueError, match=f"^sigma is '{text}', expected a number more than 0$"):
            numeric(text, "sigma", positive=True)
    with pytest.raises(ValueError, match=r"^x is '', expected a number$"):
        needed("", "x")
