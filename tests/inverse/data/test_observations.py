"""Files of measured displacements: what they hold, and one line for what is wrong with them."""

from pathlib import Path

import numpy as np
import pytest

from forward.bodies.geometry import Block, Box
from inverse.data import scans
from inverse.data.files import distinct, files
from inverse.data.scans import Scan
from inverse.data.table import DataError

BODY = Box(size=(1.0, 1.0, 1.0), cells=(1, 1, 1))
CASES = ("shear", "extension")
TABLE = """\
# speckles of the camera
# truth.inclusions.lump.x = 0.5
x, y, z, ux, uz, sigma, case
0, 0.5, 0.5, 0.1, , 0.01, shear
1, 0.5, 0.5, nan, 0.2, 0.02, shear
0, 0.5, 0.5, 0.3, 0.4, 0.01, extension
"""


def read(path, cases, **more):
    return scans.read(path.parent, Scan(file=path.name, **more), cases)


@pytest.fixture
def table(tmp_path):
    def write(text=TABLE):
        path = tmp_path / "data.csv"
        path.write_text(text)
        return path

    return write


@pytest.mark.unit
def test_patterns_say_files_also_in_full(tmp_path):
    """From the root on, in folders below, in a folder whose name looks like a pattern; folders are no files."""
    place = tmp_path / "[a]*"
    for name in ("1.csv", "2.csv", "below/3.csv", ".4.csv"):
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).touch()
    for pattern, names in (
        (f"{tmp_path}/*/?.csv", ["1", "2"]),
        ("?.csv", ["1", "2"]),
        ("**/*.csv", [".4", "1", "2", "3"]),
        ("*/3*", ["3"]),
    ):
        assert [path.stem for path in files([pattern], [place])] == names
    for pattern in ("*/", "below*", "*" * 200, "a\0*", "/", "[", "~"):
        with pytest.raises(DataError, match="no such file"):
            files([pattern], [tmp_path / "none"])


@pytest.mark.unit
def test_different_files_have_different_names():
    """Results, and what is kept of solves, are by these."""
    for paths, names in (
        (["a/1.csv", "b/2.csv"], ["1", "2"]),
        (["a/1.csv", "a/1.vtu", "2.csv"], ["1.csv", "1.vtu", "2"]),
        (["a/1.csv", "b/1.csv", "2.csv"], ["a-1.csv", "b-1.csv", "2"]),
        (["/a/1.csv", "/b/a/1.csv"], ["a-1.csv", "b-a-1.csv"]),
        (["a/1.csv", "b/1.csv", "a/1.vtu"], ["a-1.csv", "b-1.csv", "1.vtu"]),
        (["a-b/1.csv", "a/b-1.csv", "b/1.csv", "x/b-1.csv"], ["a-b-1.csv", "a-b-1.csv-2", "b-1.csv", "x-b-1.csv"]),
        (["1.csv", "1.vtu", "1.csv.csv"], ["1.csv", "1.vtu", "1.csv-2"]),
    ):
        found = distinct([Path(path) for path in paths])
        assert len(set(found)) == len(paths)
        assert found == names


@pytest.mark.unit
def test_a_table_is_read_component_by_component(table):
    found = read(table(), CASES, unit=1e-3)
    assert found.source == ("speckles of the camera",)
    assert found.truth == {"inclusions.lump.x": "0.5"}
    np.testing.assert_allclose(found.places[0], [0, 5e-4, 5e-4])
    rows = found.measured()
    np.testing.assert_array_equal(rows.cases, [0, 0, 1, 1])
    np.testing.assert_array_equal(rows.axes, [0, 2, 0, 2])
    np.testing.assert_allclose(rows.values, [1e-4, 2e-4, 3e-4, 4e-4])
    np.testing.assert_allclose(rows.sigma, [1e-5, 2e-5, 1e-5, 1e-5])


@pytest.mark.unit
@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("ux, uz", "ux, vz", "unknown column 'vz'; did you mean"),
        ("x, y, z", "x, y, sigma_x", "no column 'z', expected x, y, z"),
        ("ux, uz", "sigma_x, sigma_z", "no column of displacements"),
        (", case", ", sigma_x", "no column 'case'"),
        ("0, 0.5, 0.5, 0.1", "nan, 0.5, 0.5, 0.1", "line 4: x is 'nan', expected a number"),
        ("0.1, ,", "much, ,", "line 4: ux is 'much', expected a number"),
        ("0.3, 0.4", "inf, 0.4", "line 6: ux is 'inf', expected a number"),
        ("0.02", "-0.02", "line 5: sigma is '-0.02', expected a number more than 0"),
        ("0.01, extension", "0.01, shear", "line 6: the point of line 4 again in load case 'shear'"),
        ("0.01, extension", "0.01, shear", "no data in load case 'extension'"),
        ("0.3, 0.4", ", nan", "no data in load case 'extension'"),
        ("0.4, 0.01, ext", "0.4, 0.01, 1, ext", "line 6: 8 cells, expected 7, one for each column"),
        ("0.02, shear", "0.02", "line 5: 6 cells, expected 7"),
        ("ux, uz", "ux, ux", "line 3: several columns 'ux', expected different names"),
        ("x, y, z, ux, uz, sigma, case", "x;y;z;ux;uz;sigma;case", "line 3: columns with ';' between them"),
        (TABLE[TABLE.index("0, 0.5") :], "", "no rows"),
        (TABLE, "# nothing\n", "empty, expected a line with the names of columns"),
        ("extension\n", "extensoin\n", "line 6: unknown load case 'extensoin'; did you mean 'extension'"),
    ],
)
def test_one_line_for_a_mistake(table, old, new, told):
    with pytest.raises(DataError) as caught:
        read(table(TABLE.replace(old, new, 1)), CASES)
    assert any(told in line for line in caught.value.args), caught.value.args
    assert all(line.startswith("data.csv: ") and "\n" not in line for line in caught.value.args)


@pytest.mark.unit
def test_marks_of_other_programs_do_not_matter(table):
    found = read(table("\ufeff" + TABLE.replace("\n", "\r\n") + ",,,,,,\n"), CASES)
    assert len(found.places_of_points) == 3
    assert found.source == ("speckles of the camera",)


@pytest.mark.unit
def test_points_are_put_on_the_body(table):
    found = read(table(TABLE.replace("0, 0.5, 0.5, 0.1", "-0.01, 0.5, 0.5, 0.1")), CASES)
    with pytest.raises(DataError, match=r"data.csv: line 4: \(-0.01, 0.5, 0.5\) lies 0.01 m outside the body"):
        found.on(BODY.nearest, 1.0, 1e-3)
    placed = found.on(BODY.nearest, 1.0, 0.02)
    np.testing.assert_allclose(placed.places[0], [0, 0.5, 0.5])
    np.testing.assert_allclose(placed.moves, [0.01, 0, 0])
    left = found.on(BODY.nearest, 1.0, 1e-3, leave_out=True)
    assert left.left_out == ("data.csv: line 4 (1 cm)",)
    assert left.labels.tolist() == found.labels[3:].tolist()
    with pytest.raises(DataError, match=r"a displacement of 400 m in a body of 1 m.*data\.unit"):
        read(table(TABLE.replace("0.4", "400")), CASES).on(BODY.nearest, 1.0, 0.0)


def test_nearest_places_of_a_block():
    corners = [(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 1.0, 0.0), (2.0, 1.5, 0.0)]
    block = Block(corners=(*corners, *((x, y, z + 1.0) for x, y, z in corners)), cells=(1, 1, 1))
    inside = block.place(np.random.default_rng(0).uniform(size=(20, 3)))
    np.testing.assert_allclose(block.nearest(inside), inside, atol=1e-9)
    points = np.array([[1.0, -0.2, 0.5], [2.3, 0.5, 0.5], [2.5, 2.0, 0.5], [0.0, 1.25, 0.5]])
    expected = [[1.0, 0.0, 0.5], [2.0, 0.5, 0.5], [2.0, 1.5, 0.5]]
    np.testing.assert_allclose(block.nearest(points)[:3], expected, atol=1e-6)
    foot = np.array([4.0, 1.0]) * (0.25 / 17) + [0, 1]  # of the plumb line on the slanted face
    np.testing.assert_allclose(block.nearest(points)[3], [*foot, 0.5], atol=1e-6)


@pytest.mark.unit
def test_sigma_is_needed_where_something_was_measured(table):
    found = read(table(TABLE.replace("0.02", "")), CASES)
    with pytest.raises(DataError, match=r"line 5: no sigma, expected a column sigma or data\.sigma"):
        found.checked()
    assert found.with_sigma(np.array(0.5)).checked().measured().sigma[1] == 0.5


@pytest.mark.unit
def test_files_folders_and_patterns(tmp_path):
    for name in ("b.csv", "a.csv", "note.md"):
        (tmp_path / name).touch()
    names = [path.name for path in files(["."], [tmp_path])]
    assert names == ["a.csv", "b.csv"]
    assert [path.name for path in files(["b.csv", "?.csv"], [tmp_path / "no", tmp_path])] == ["b.csv", "a.csv"]
    with pytest.raises(DataError, match=r"c\.csv: no such file"):
        files(["c.csv"], [tmp_path])
    assert [path.name for path in files(["c.csv", "b.csv"], [tmp_path])] == ["c.csv", "b.csv"]
    with pytest.raises(DataError, match=r"c\.csv: cannot be read: No such file"):
        read(tmp_path / "c.csv", CASES)


def test_meshes(tmp_path):
    meshio = pytest.importorskip("meshio")
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    data = {"displacement_shear": 0.1 * points, "displacement_extension": np.where(points == 0, np.nan, points)}
    path = tmp_path / "data.vtu"
    meshio.Mesh(points, [("tetra", [[0, 1, 2, 3]])], point_data=data).write(path)
    rows = read(path, CASES, unit=0.5).measured()
    assert len(rows.values) == 12 + 3
    np.testing.assert_allclose(rows.values[-3:], 0.5)
    with pytest.raises(DataError, match="no point data 'displacement_pull'"):
        read(path, ("shear", "pull"))
    path.write_text("nothing")
    with pytest.raises(DataError, match=r"data.vtu: cannot be read as \.vtu: expected a data set of VTK"):
        read(path, CASES)
