"""Scans: every format gives the same data, pairs of surfaces their difference, and one line for what is wrong."""

import locale
import random
import struct
from pathlib import Path

import h5py
import meshio
import numpy as np
import pytest
from pydantic import ValidationError
from vtkmodules.vtkIOLegacy import vtkUnstructuredGridWriter
from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

from forward.bodies.geometry import Box
from forward.bodies.surface import Surface
from forward.specimen import Specimen
from inverse.data.registration import turned
from inverse.data.scans import Reading, Scan, read
from inverse.data.table import DataError
from tests.fuzz import damaged_bytes
from workflows.config.study import load
from workflows.data.measured import DisplacementFile, digest_of, motion_of, read_on, scan_of

CONFIGS = Path(__file__).parent.parent.parent.parent / "configs"
POINTS = 50 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 0, 1.0]])  # mm
TRIANGLES = np.array([[0, 1, 2], [0, 1, 3], [1, 4, 2], [1, 5, 3]])
MOTION = POINTS @ np.array([[0.02, 0.01, 0], [0, -0.03, 0.01], [0.01, 0, 0.04]]) + 1.0
HOLES = np.where(np.arange(18).reshape(6, 3) % 5 == 3, np.nan, MOTION)
SIGMA = 0.1 + 0.01 * np.arange(6.0)
BODY = Box(size=(0.05, 0.05, 0.05), cells=(2, 2, 2))

XDMF = """<?xml version="1.0"?>
<!DOCTYPE Xdmf SYSTEM "Xdmf.dtd" []>
<Xdmf Version="3.0" xmlns:xi="http://www.w3.org/2001/XInclude"><Domain>
<Grid Name="mesh" GridType="Uniform">
<Topology TopologyType="Triangle" NumberOfElements="4" NodesPerElement="3">
<DataItem Dimensions="4 3" NumberType="Int" Format="HDF">scan.h5:/Mesh/mesh/topology</DataItem></Topology>
<Geometry GeometryType="XYZ"><DataItem Dimensions="6 3" Format="HDF">scan.h5:/Mesh/mesh/geometry</DataItem></Geometry>
</Grid>
<Grid Name="displacement" GridType="Collection" CollectionType="Temporal">STEPS</Grid>
</Domain></Xdmf>
"""
STEP = """<Grid Name="displacement" GridType="Uniform">
<xi:include xpointer="xpointer(/Xdmf/Domain/Grid[@GridType='Uniform'][1]/*[self::Topology or self::Geometry])" />
<Time Value="{k}" /><Attribute Name="displacement" AttributeType="Vector" Center="Node">
<DataItem Dimensions="6 3" Format="HDF">scan.h5:/Function/displacement/{k}</DataItem></Attribute></Grid>
"""


def as_dolfinx(path):
    """Write two steps of a series as DOLFINx does; the last one counts."""
    with h5py.File(path.with_suffix(".h5"), "w") as file:
        file["Mesh/mesh/topology"], file["Mesh/mesh/geometry"] = TRIANGLES, POINTS
        file["Function/displacement/0"], file["Function/displacement/1"] = 0 * HOLES, HOLES
    path.write_text(XDMF.replace("STEPS", "".join(STEP.format(k=k) for k in (0, 1))))


def write(path):
    """Write the same points in the format of a path."""
    arrays = {"displacement": HOLES, "sigma": SIGMA}
    if path.name == "dolfinx.xdmf":
        as_dolfinx(path.with_name("scan.xdmf"))
        path.with_name("scan.xdmf").rename(path)
    elif path.suffix == ".csv":
        rows = ["x [mm], y [mm], z [mm], ux [mm], uy [mm], uz [mm], sigma [mm]"]
        rows += [", ".join(map(repr, map(float, (*p, *u, s)))) for p, u, s in zip(POINTS, HOLES, SIGMA, strict=True)]
        path.write_text("\n".join(rows))
    elif path.suffix in {".vtp", ".vtk"} and "polygons" in path.name:
        import pyvista

        found = pyvista.PolyData(POINTS, np.column_stack([np.full(4, 3), TRIANGLES]).ravel())
        for name, values in arrays.items():
            found.point_data[name] = values
        words = locale.setlocale(locale.LC_ALL)
        found.save(path, binary="ascii" not in path.name)
        locale.setlocale(locale.LC_ALL, words)  # VTK leaves "C"
    elif path.name in BY_VTK:
        import pyvista

        grid = pyvista.UnstructuredGrid({pyvista.CellType.TRIANGLE: TRIANGLES}, POINTS)
        for name, values in arrays.items():
            grid.point_data[name] = values
        grid.field_data["words"] = ["which meshio does not read"]
        writer = vtkXMLUnstructuredGridWriter() if path.suffix == ".vtu" else vtkUnstructuredGridWriter()
        if path.suffix == ".vtu":
            writer.SetNumberOfPieces(BY_VTK[path.name])
            writer.SetCompressorTypeToLZ4()
        else:
            writer.SetFileType(BY_VTK[path.name])
        writer.SetInputData(grid)
        writer.SetFileName(str(path))
        words = locale.setlocale(locale.LC_ALL)
        writer.Write()
        locale.setlocale(locale.LC_ALL, words)
    elif path.suffix == ".ply":
        columns = dict(zip(("ux", "uy", "uz"), HOLES.T, strict=True))
        triangles = TRIANGLES.astype(np.int32)
        meshio.Mesh(POINTS, [("triangle", triangles)], point_data=columns | {"sigma": SIGMA}).write(path)
    else:
        meshio.Mesh(POINTS, [("triangle", TRIANGLES)], point_data=arrays).write(path)


BY_VTK = {"one.vtu": 1, "pieces.vtu": 2, "ascii.vtk": 1, "binary.vtk": 2}  # pieces, or types of file
FORMATS = (
    "scan.csv",
    "scan.vtu",
    "scan.vtk",
    "scan.xdmf",
    "dolfinx.xdmf",
    "scan.ply",
    "polygons.vtp",
    "polygons.vtk",
    "ascii-polygons.vtk",
    *BY_VTK,
)


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_says_the_same(tmp_path, name):
    write(tmp_path / name)
    scan = Scan(file=name, units=None if name.endswith("csv") else "mm", sigma=1e-4)
    before = locale.setlocale(locale.LC_ALL)
    found = read(tmp_path, scan, {"press": {}}).with_sigma(scan.sigma)
    assert locale.setlocale(locale.LC_ALL) == before
    np.testing.assert_allclose(found.places_of_points, POINTS / 1e3, rtol=1e-6)
    np.testing.assert_allclose(found.values, np.ravel(HOLES) / 1e3, rtol=1e-6)
    expected = np.full(6, 1e-4) if name == "dolfinx.xdmf" else SIGMA / 1e3
    np.testing.assert_allclose(found.sigma, np.repeat(expected, 3), rtol=1e-6)
    assert len(found.measured()) == np.isfinite(HOLES).sum()


def test_what_dolfinx_writes_is_read(tmp_path):
    """DOLFINx itself wrote it, in a process of its own."""
    from tests.launch import run_script

    script = """
from mpi4py import MPI
import numpy as np
from dolfinx import fem, io, mesh
from forward.fem.dolfinx import spaces
box = mesh.create_box(MPI.COMM_WORLD, [np.zeros(3), np.full(3, 0.05)], [1, 2, 1])
u = fem.Function(spaces.vector_space(box, 1))
u.name = "displacement"
with io.XDMFFile(box.comm, FILE, "w") as file:
    file.write_mesh(box)
    for k in (1, 2):
        u.interpolate(lambda x: k * np.array([[0.1], [0.2], [0.3]]) * x)
        file.write_function(u, float(k))
"""
    path = tmp_path / "run.xdmf"
    run_script(1, script.replace("FILE", repr(str(path))))
    found = read(tmp_path, Scan(file="run.xdmf", sigma=1e-5), {"press": {}})
    places = found.places_of_points
    assert len(places) == 12
    np.testing.assert_allclose(found.values, np.ravel(places * [0.2, 0.4, 0.6]), atol=1e-15)


@pytest.mark.parametrize("form", [".stl", "binary.stl", ".ply", ".inp", ".vtu"])
def test_pairs_of_surfaces(tmp_path, form):
    """The difference of surfaces with the same numbering; corners of facets that coincide count once."""
    for name, points in (("rest", POINTS), ("press", POINTS + MOTION), ("pull", POINTS - MOTION)):
        more = {"binary": form.startswith("binary")} if form.endswith("stl") else {}
        path = tmp_path / f"{name}{Path(form).suffix or form}"
        meshio.write(path, meshio.Mesh(points.copy(), [("triangle", TRIANGLES)]), **more)
        if form.endswith("stl"):
            write_stl(path, points, binary=form.startswith("binary"))
    suffix = Path(form).suffix or form
    (tmp_path / "scan.toml").write_text(
        f'reference = "rest{suffix}"\nunits = "mm"\nsigma = 1e-4\n'
        f'deformed = {{ press = "press{suffix}", pull = "pull{suffix}" }}\n'
    )
    scan = scan_of(tmp_path / "scan.toml", Reading(unit=7.0, tolerance=0.2))
    assert (scan.metres, scan.tolerance, scan.surface) == (1e-3, 0.2, True)
    found = read(tmp_path, scan, {"press": {}, "pull": {}})
    places, motions = found.places_of_points, found.values.reshape(-1, 3)
    assert len(places) == 12
    order = [int(np.linalg.norm(POINTS / 1e3 - place, axis=1).argmin()) for place in places[:6]]
    assert sorted(order) == list(range(6))
    np.testing.assert_allclose(motions[:6], MOTION[order] / 1e3, atol=1e-8)
    np.testing.assert_allclose(motions[6:], -MOTION[order] / 1e3, atol=1e-8)
    before = digest_of(tmp_path / "scan.toml")
    with (tmp_path / f"pull{suffix}").open("ab") as file:
        file.write(b"\n")
    assert digest_of(tmp_path / "scan.toml") != before


@pytest.mark.unit
@pytest.mark.parametrize("form", ["HDF", "Binary"])
def test_numbers_that_are_stored_elsewhere_belong_to_a_scan(tmp_path, form):
    """A file whose numbers have changed is another one, also where its text is the same."""
    (tmp_path / "scan.toml").write_text('file = "scan.xdmf"\n')
    files, found = [tmp_path / "scan.xdmf", tmp_path / "scan.toml"], []
    for motion in (HOLES, HOLES, 2 * HOLES):
        mesh = meshio.Mesh(POINTS, [("triangle", TRIANGLES)], point_data={"displacement": motion})
        mesh.write(files[0], data_format=form)
        found.append([digest_of(path) for path in files])
    assert found[0] == found[1]
    assert all(found[0])
    assert all(a != b for a, b in zip(found[1], found[2], strict=True))
    for path in tmp_path.glob("scan*.[hb]*"):
        path.unlink()
    assert [digest_of(path) for path in files] == ["", ""]


def write_stl(path, points, *, binary):
    """Write the facets one after another, each with its corners, as scanners do."""
    if binary:
        facets = [struct.pack("<12fH", 0, 0, 1, *points[t].ravel(), 0) for t in TRIANGLES]
        path.write_bytes(b"scan".ljust(80) + struct.pack("<I", len(TRIANGLES)) + b"".join(facets))
        return
    corners = "\n".join(
        "facet normal 0 0 1\nouter loop\n"
        + "\n".join("vertex " + " ".join(f"{x:.9g}" for x in points[i]) for i in t)
        + "\nendloop\nendfacet"
        for t in TRIANGLES
    )
    path.write_text(f"solid scan\n{corners}\nendsolid scan\n")


@pytest.mark.parametrize(
    ("head", "settings", "told"),
    [
        ("x [mm],y [mm],z [m],ux [mm]", {}, "mixed units: x [mm], y [mm], z [m], ux [mm]; expected the same unit"),
        ("x [mm],y [mm],z [mm],ux", {}, "mixed units: x [mm], y [mm], z [mm], ux; expected"),
        ("x [mm],y [mm],z [mm],ux [um]", {}, "mixed units"),
        ("x [mm],y [mm],z [mm],ux [mm]", {"units": "cm"}, "its heads state mm, but the study says 0.01 m per unit"),
        ("x [mN],y [mN],z [mN],ux [mN]", {}, "column 'x' has the unit 'mN', expected m, mm or µm"),
        ("x [mm],y [mm],z [mm],x (mm)", {}, "several columns 'x'"),
    ],
)
def test_units_of_heads(tmp_path, head, settings, told):
    (tmp_path / "scan.csv").write_text(f"{head}\n0,0,0,1\n")
    with pytest.raises(DataError) as caught:
        read(tmp_path, Scan(file="scan.csv", **settings), {"press": {}})
    assert len(caught.value.args) == 1
    assert told in str(caught.value)


@pytest.mark.unit
def test_units_agree(tmp_path):
    (tmp_path / "scan.csv").write_text("x [mm],y [mm],z [mm],ux [mm]\n1,2,3,4\n")
    for settings in ({}, {"units": "mm"}, {"unit": 1e-3}):
        found = read(tmp_path, Scan(file="scan.csv", **settings), {"press": {}})
        assert found.places_of_points.tolist() == [[1e-3, 2e-3, 3e-3]]
    for settings, told in (({"units": "furlong"}, "unit 'furlong'"), ({"units": "mm", "unit": 1.0}, "either unit or")):
        with pytest.raises(ValidationError, match=told):
            Reading(**settings)


def broken():
    """Formats and damages; VTK reads in a process each time: of its formats one is damaged in all ways by default."""
    for damage in ("empty", "garbage", "missing", "cut", "words"):
        for name in (*FORMATS[:-3], "scan.stl", "scan.inp", "scan.msh"):
            by_vtk = Path(name).suffix in (".vtu", ".vtk", ".vtp")
            later = by_vtk and name != "one.vtu" and damage not in ("missing", "cut")
            yield pytest.param(name, damage, marks=[pytest.mark.slow] if later else [])


@pytest.mark.parametrize(("name", "damage"), broken())
def test_files_that_cannot_be_read(tmp_path, name, damage, capfd):
    """One line that begins with the name of the file, and nothing printed beside it."""
    path = tmp_path / name
    if damage != "missing":
        (write_stl(path, POINTS, binary=True) if name.endswith("stl") else write(path))
        whole = path.read_bytes()
        some = {"empty": b"", "garbage": random.Random(1).randbytes(500), "words": b"not what it says\n"}
        path.write_bytes(some.get(damage, whole[: len(whole) // 2]))
    with pytest.raises(DataError) as caught:
        read(tmp_path, Scan(file=name), {"press": {}})
    assert len(caught.value.args) == 1, caught.value.args
    assert caught.value.args[0].startswith(f"{name}: ")
    assert "\n" not in caught.value.args[0]
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
def test_files_damaged_by_chance(tmp_path, capfd):
    """Whatever is wrong, it is a line, or data: nothing else."""
    chance = random.Random(3)
    for name in (*FORMATS, "rest.stl"):
        path = tmp_path / name
        (write_stl(path, POINTS, binary=chance.random() < 0.5) if name.endswith("stl") else write(path))
        whole = path.read_bytes()
        for _ in range(2 if path.suffix.startswith(".vt") else 12):  # VTK takes a process for each
            path.write_bytes(damaged_bytes(whole, chance)[0])
            scan = Scan(file=name) if name != "rest.stl" else Scan(reference=name, deformed={"press": name})
            said: tuple[str, ...] = ()
            try:
                read(tmp_path, scan, {"press": {}})
            except DataError as error:
                said = error.args
            assert all(line.isprintable() for line in said), said
    assert capfd.readouterr() == ("", "")


@pytest.mark.unit
def test_pairs_that_do_not_belong_together(tmp_path):
    def told(deformed, reference="rest.ply", case="press"):
        with pytest.raises(DataError) as caught:
            read(tmp_path, Scan(reference=reference, deformed={case: deformed}), {"press": {}})
        return str(caught.value)

    mesh = meshio.Mesh(POINTS, [("triangle", TRIANGLES)])
    mesh.write(tmp_path / "rest.ply")
    meshio.Mesh(POINTS[:5], [("triangle", TRIANGLES[:2])]).write(tmp_path / "fewer.ply")
    meshio.Mesh(POINTS, [("triangle", TRIANGLES[::-1])]).write(tmp_path / "other.ply")
    write_stl(tmp_path / "rest.stl", POINTS, binary=True)
    write_stl(tmp_path / "turned.stl", POINTS[[5, 3, 1, 0, 2, 4]] + MOTION, binary=True)
    text = (tmp_path / "turned.stl").read_bytes()
    (tmp_path / "turned.stl").write_bytes(text[:84] + text[134:] + text[84:134])
    assert told("fewer.ply").startswith("fewer.ply: 5 points, and 6 in the reference: expected the same numbering")
    assert "other cells than the reference" in told("other.ply")
    assert "coincide, but move by different displacements" in told("turned.stl", "rest.stl")
    assert "deformed: unknown load case 'pres'; did you mean 'press'?" in told("rest.ply", case="pres")
    with pytest.raises(DataError, match=r"rest.ply: no displacements; expected data at its points, or a file in TOML"):
        read(tmp_path, Scan(file="rest.ply"), {"press": {}})


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("reference = ", "scan.toml: not a file in TOML"),
        ('reference = "rest.ply"', "scan.toml: expected either file, or reference and deformed"),
        ('deformed = { press = "a.ply" }', "scan.toml: expected either file, or reference and deformed"),
        ('file = "a.csv"\nunit = "mm"', "scan.toml: unit: input should be a valid number; given 'mm'"),
        ('fle = "a.csv"', "scan.toml: fle: unknown key; did you mean 'file'?"),
        ('file = "a.csv"', "a.csv: cannot be read: No such file"),
        ('file = "a.exe"', "a.exe: unknown kind of file"),
        (
            'file = "a.csv"\nregistration = { kind = "given", rotaton = [0, 0, 5] }',
            "scan.toml: registration.rotaton: unknown key; did you mean 'rotation'?",
        ),
    ],
)
def test_mistakes_in_descriptions(tmp_path, text, told):
    path = tmp_path / "scan.toml"
    path.write_text(text)
    with pytest.raises(DataError) as caught:
        read(tmp_path, scan_of(path, Reading()), {"press": {}})
    assert any(told in line for line in caught.value.args), caught.value.args


@pytest.mark.unit
def test_scans_of_another_body(tmp_path):
    """Distances that are huge, a wrong unit, points within the body that should lie on its surface."""
    write(tmp_path / "scan.vtu")
    usual = {"sigma": 1e-4, "on_surface": True, "tolerance": 1e-3}
    loads = [{"kind": "traction", "on": "z-max", "direction": [1, 0, 0], "size": 50.0}]
    case = {"name": "press", "clamp": ["z-min"], "loads": loads}
    material = {"kind": "neo-hookean-coupled", "mu": 1e3, "lmbda": 4e3}
    it = Specimen.model_validate({"body": BODY, "material": material, "cases": [case]})
    placed = read_on(tmp_path / "scan.vtu", it, Reading(units="mm", **usual))
    assert placed.registered is None
    assert placed.moves.max() < 1e-12
    with pytest.raises(DataError, match="half of the points are far away: is it another body, another unit, or"):
        read_on(tmp_path / "scan.vtu", it, Reading(units="cm", **usual))
    other = it.model_copy(update={"body": Box(size=(0.05, 0.05, 0.049), cells=(1, 1, 1))})
    reading = Reading(units="mm", **usual | {"tolerance": 5e-4})
    with pytest.raises(DataError, match=r"lies 0.001 m from the surface of the body, expected at most .* \(and 1 more"):
        read_on(tmp_path / "scan.vtu", other, reading)
    placed = read_on(tmp_path / "scan.vtu", other, Reading(**reading.model_dump() | {"beyond": "leave-out"}))
    assert placed.left_out == ("scan.vtu: point 3 (1 mm)", "scan.vtu: point 5 (1 mm)")
    assert len(placed.places_of_points) == 4


@pytest.mark.unit
def test_nearest_places_of_surfaces():
    """Those of a box by its planes, on any division of its faces."""
    points = np.random.default_rng(1).uniform(-0.02, 0.07, size=(300, 3))
    inside = ((points > 0) & (points < 0.05)).all(axis=1)
    expected = np.clip(points, 0, 0.05)
    for i in np.flatnonzero(inside):
        gaps = np.concatenate([points[i], 0.05 - points[i]])
        k = int(gaps.argmin())
        expected[i, k % 3] = 0.0 if k < 3 else 0.05
    for cells in ((1, 1, 1), (3, 4, 2)):
        places, normals = Surface.of(Box(size=(0.05, 0.05, 0.05), cells=cells)).nearest(points)
        np.testing.assert_allclose(places, expected, atol=1e-15)
        np.testing.assert_allclose(np.abs(normals).max(axis=1), 1)


def test_what_the_plan_says_of_a_scan(tmp_path):
    """The shipped one is found askew; points that do not belong to the body are named."""
    study = load(CONFIGS / "scan.toml")
    (found,) = study.measurements
    assert found.registered is not None
    np.testing.assert_allclose(found.registered.motion.angles, [0, 0, 5], atol=1e-4)
    np.testing.assert_allclose(found.registered.motion.shift, [0.01, 0, 0], atol=1e-7)
    lines = study.plan(1)
    assert any(
        line.startswith("registered  rotated by 0, 0, 5° about x, y and z, shifted by 0.01, 0, 0 m") for line in lines
    )
    text = (CONFIGS / "data" / "scan.csv").read_text(encoding="utf-8")
    stray = "".join(f"{100 + k},100,100,1,1,1,0.1,shear\n" for k in range(7))
    (tmp_path / "scan.csv").write_text(text + stray, encoding="utf-8")
    changes = [f"data.files=['{tmp_path}/scan.csv']", "data.beyond='leave-out'"]
    study = load(CONFIGS / "scan.toml", changes)
    (found,) = study.measurements
    np.testing.assert_allclose(found.registered.motion.angles, [0, 0, 5], atol=1e-2)
    (unusual,) = found.findings
    line = unusual.clause
    assert line.startswith("7 points do not belong to the body and are left out: scan.csv: line 278 (")
    assert line.endswith("and 2 others")
    assert f"warning     {line}" in study.plan(1)


@pytest.mark.fem
def test_comparisons_take_scans_in_their_own_frame(tmp_path):
    """The same predictions along the axes of the scanner; what is uncertain of its motion is read."""
    from mpi4py import MPI

    specimen = Specimen.model_validate(
        {
            "body": {"size": [0.05] * 3, "cells": [1, 1, 1], "degree": 1},
            "material": {"kind": "neo-hookean-coupled", "mu": 1e3, "lmbda": 4e3},
            "cases": [
                {
                    "name": "press",
                    "clamp": ["z-min"],
                    "loads": [{"kind": "traction", "on": "z-max", "direction": [1, 0, 0], "size": 50.0}],
                }
            ],
        }
    )
    write(tmp_path / "scan.csv")
    R = turned((0.0, 0.0, 5.0))
    whole = [[*row, 0.0] for row in R.tolist()]
    inside = np.array([25.0, 20, 30])  # the corners would leave the body
    text = (tmp_path / "scan.csv").read_text().splitlines()
    rows = [line.split(", ") for line in text[1:]]
    for row in rows:
        row[:3] = map(repr, map(float, (inside + 0.1 * np.array(row[:3], dtype=float)) @ R))
    (tmp_path / "scan.csv").write_text("\n".join([text[0], *(", ".join(row) for row in rows)]))
    how = {"file": "scan.csv", "registration": {"kind": "given", "matrix": whole}}
    data = DisplacementFile.model_validate(how).read(tmp_path, specimen)
    places, axes, cases = data.places, data.axes, data.cases
    np.testing.assert_allclose(data.along, R.T[axes], atol=1e-12)
    expected = {tuple(x) for x in ((inside + 0.1 * POINTS) / 1e3).round(9).tolist()}
    assert {tuple(x) for x in places.round(9).tolist()} == expected
    model = specimen.build(MPI.COMM_SELF, ())
    seen = model.observing(places, axes, cases, data.along).solve(np.zeros(0)).outputs
    plain = model.observing(np.repeat(places, 3, axis=0), [0, 1, 2] * len(places), [0] * 3 * len(places))
    vectors = plain.solve(np.zeros(0)).outputs.reshape(-1, 3)
    np.testing.assert_allclose(seen, [(u @ R)[axis] for u, axis in zip(vectors, axes, strict=True)], atol=1e-12)
    how["registration"] = {"kind": "given", "rotation_std": 1.0}
    read = DisplacementFile.model_validate(how | {"tolerance": 1.0}).read(tmp_path, specimen)
    root = motion_of(read, specimen.body).root  # of what is not known exactly
    np.testing.assert_allclose(root, np.radians(1.0) * np.eye(3, 6), atol=1e-15)
