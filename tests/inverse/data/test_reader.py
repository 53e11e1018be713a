"""Readers of one's own: what they return is a table like any other, and what goes wrong in them is one line."""

import math

import numpy as np
import pytest

from inverse.data.scans import Scan, read
from inverse.data.table import DataError, Reader, table_of

pytestmark = pytest.mark.unit
PLACES = [[0.0, 0.1, 0.2], [1.0, 0.1, 0.2]]


class Camera(Reader):
    """What a camera has seen: lines of numbers with blanks between them."""

    kind: str = "camera"
    missing: float = -9.0

    def columns(self, path):
        rows = np.loadtxt(path)
        rows[rows == self.missing] = math.nan
        return dict(zip(("x", "y", "z", "ux", "uy", "sigma"), rows.T, strict=True)) | {"case": ["press"] * len(rows)}


class Returns(Reader):
    """What is given, or raised."""

    kind: str = "returns"

    def columns(self, path):
        if isinstance(GIVEN[path.name], Exception):
            raise GIVEN[path.name]
        return GIVEN[path.name]


GIVEN = {
    "none": {},
    "empty": {"x": [], "y": []},
    "uneven": {"x": [1.0], "y": [1.0, 2.0]},
    "raises": KeyError("depth"),
    "absent": FileNotFoundError(2, "No such file or directory"),
    "texts": {"output": ["a", " b "], "value": [0.1, 1e-300]},
}


def test_displacements_are_those_of_a_table_of_the_same_numbers(tmp_path):
    (tmp_path / "seen.cam").write_text("0 0.1 0.2 1e-3 -9 1e-4\n1 0.1 0.2 2e-3 3e-3 1e-4\n")
    (tmp_path / "seen.csv").write_text(
        "x,y,z,ux,uy,sigma,case\n0,0.1,0.2,1e-3,,1e-4,press\n1,0.1,0.2,2e-3,3e-3,1e-4,press\n"
    )
    cases = {"press": {}}
    found = read(tmp_path, Scan(file="seen.cam", reader=Camera()), cases)
    other = read(tmp_path, Scan(file="seen.csv"), cases)
    for name in ("values", "sigma", "cases", "axes", "places"):
        np.testing.assert_array_equal(vars(found)[name], vars(other)[name])
    np.testing.assert_array_equal(found.places_of_points, PLACES)


def test_numbers_are_read_again_as_they_are(tmp_path):
    table = table_of(tmp_path / "texts", Returns())
    assert table.columns == ("output", "value")
    assert [row["output"] for row in table.rows] == ["a", "b"]
    assert [float(row["value"]) for row in table.rows] == GIVEN["texts"]["value"]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("none", "none: columns of lengths none, expected one length, and rows"),
        ("empty", "empty: columns of lengths x 0, y 0, expected one length, and rows"),
        ("uneven", "uneven: columns of lengths x 1, y 2, expected one length, and rows"),
        ("raises", "raises: cannot be read by Returns: KeyError: 'depth'"),
        ("absent", "absent: cannot be read: No such file or directory"),
    ],
)
def test_what_goes_wrong_is_one_line(tmp_path, name, said):
    with pytest.raises(DataError) as raised:
        table_of(tmp_path / name, Returns())
    assert raised.value.args == (said,)
