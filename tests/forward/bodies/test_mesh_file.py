"""Bodies from files: the same as a box where the mesh is the same; names, regions, units, mistakes."""

import json
import locale
import random
import shutil
import tomllib

import meshio
import numpy as np
import pytest
import pyvista
import xarray as xr
from mpi4py import MPI
from pydantic import ValidationError

from forward.bodies.geometry import Box
from forward.bodies.mesh_file import MeshFile
from forward.conformance import check_derivatives
from forward.hyperelastic import Hyperelastic
from forward.model import ModelError
from forward.specimen import Specimen
from tests.bodies import loaded_body
from tests.launch import ROOT, on_kept_ranks
from tests.meshes import CELLS, NAMES, SIZE, box, numbered
from tests.steps import STEPS
from workflows.config.mistakes import StudyError
from workflows.config.study import differences, document, load, parse
from workflows.results.directory import label, with_regions, write_fields
from workflows.run.plan import plan


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("mesh") / "box.msh"
    meshio.write(path, box(), file_format="gmsh22", binary=True)
    return path


def spec(file, **changes):
    body = {"kind": "mesh", "file": str(file), "degree": 1} | changes.pop("body", {})
    boxed = loaded_body("mooney-rivlin").model_dump(exclude_none=True)
    return Hyperelastic.model_validate(boxed | {"body": body} | changes)


def built(model, *parameters):
    return model.build(MPI.COMM_SELF, parameters)


@pytest.mark.fem
@pytest.mark.parametrize(("form", "extension"), [("gmsh22", "msh"), ("vtu", "vtu"), ("xdmf", "xdmf")])
def test_the_same_mesh_gives_the_same_solution(tmp_path, form, extension):
    path = tmp_path / f"box.{extension}"
    mesh = box(scale=1000.0)
    body = {"unit": 1e-3}
    if extension != "msh":
        mesh = numbered(mesh)
        body["names"] = {"left": 1, "right": 2} | {name: 10 + k for k, name in enumerate(NAMES)}
    meshio.write(path, mesh, file_format=form)
    own = spec(path, body=body)
    assert set(own.body.boundaries) == set(NAMES)
    assert set(own.body.regions) == {"left", "right"}
    ours, theirs = (built(model).solve(np.zeros(0)) for model in (own, loaded_body("mooney-rivlin")))
    np.testing.assert_allclose(ours.outputs, theirs.outputs, rtol=1e-9)


def test_what_is_found_is_that_of_the_box(file):
    own, boxed = MeshFile(file=str(file)), Box(size=SIZE, cells=CELLS)
    assert own.nodes == boxed.nodes
    assert own.vertex_count == boxed.vertex_count
    assert own.cell_count == boxed.cell_count
    assert own.longest_edge == pytest.approx(boxed.longest_edge)
    np.testing.assert_allclose(own.bounds, boxed.bounds)
    np.testing.assert_allclose(own.vertices, boxed.vertices)
    assert own.contents.regions == pytest.approx({"left": 0.28, "right": 0.28})
    for name in NAMES:
        spanned = np.array(own.corners_of(name))
        assert len(spanned) == 3
        assert {tuple(p) for p in spanned.round(9).tolist()} <= {
            tuple(np.round(p, 9)) for p in boxed.corners_of(name) + np.array(own.corners_of(name)).tolist()
        }


@pytest.mark.parametrize("kind", ["hexahedron", "tetra"])
def test_nearest_places_are_those_of_the_box(tmp_path, kind):
    meshio.write(tmp_path / "box.vtu", numbered(box(kind)))
    points = np.random.default_rng(0).uniform(-0.4, 1.4, (60, 3))
    found = MeshFile(file=str(tmp_path / "box.vtu")).nearest(points)
    np.testing.assert_allclose(found, Box(size=SIZE, cells=CELLS).nearest(points), atol=1e-12)


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("kind", ["hexahedron", "tetra"])
def test_nodes_are_those_of_the_space(tmp_path, kind, degree):
    from forward.fem.dolfinx import meshes, spaces

    meshio.write(tmp_path / "box.vtu", numbered(box(kind)))
    own = MeshFile(file=str(tmp_path / "box.vtu"), degree=degree)
    msh, facets = meshes.mesh_body(MPI.COMM_SELF, own)
    assert len(spaces.node_coordinates(spaces.scalar_space(msh, degree))) == own.nodes
    per_face = 1 if kind == "hexahedron" else 2
    assert {name: len(found) for name, found in facets.items()} == {
        f"{10 + k}": per_face * (1 if k < 2 else 2) for k in range(6)
    }
    assert own.regions == ("1", "2")


REGION = {"C1": 1e4, "C2": 2e4, "D1": 2e5, "contrast": 1.0}  # constants as outside
NUMBERS = ("material.C1", *(f"regions.right.{name}" for name in REGION))
FEW = ({"kind": "max-displacement", "name": "largest"}, {"kind": "strain-energy", "name": "energy"})


def regional(file):
    """A model of which the right half has numbers of its own."""
    return spec(file, regions={"right": REGION}, outputs=FEW)


@pytest.mark.fem
def test_derivatives_by_the_numbers_of_regions(file):
    point = np.array([1e4, 2e4, 3e4, 1e5, 1.5])
    check_derivatives(built(regional(file), *NUMBERS), point, 0.1 * point, accuracy=1e-10, steps=STEPS).require()


@pytest.mark.fem
def test_constants_and_contrast_say_the_same(file):
    model = built(regional(file), *NUMBERS)
    plain = built(spec(file)).solve(np.zeros(0))
    base = np.array([*REGION.values()])
    at_base = model.solve(np.array([1e4, *base]))
    np.testing.assert_allclose(at_base.state, plain.state, rtol=1e-9, atol=1e-12)
    thrice = base * [1, 1, 1, 3]
    stiff = model.solve(np.array([1e4, *thrice])).outputs
    np.testing.assert_allclose(model.solve(np.array([1e4, *(base * [3, 3, 3, 1])])).outputs, stiff, rtol=1e-9)
    assert np.abs(stiff / at_base.outputs - 1).max() > 0.02


def answers(comm, file):
    """Outputs, tangents and adjoints, and the state on the first rank, of the model with regions."""
    model = regional(file).build(comm, NUMBERS)
    solution = model.solve(np.array([1e4, 2e4, 3e4, 1e5, 1.5]))
    state = model.space.gather(solution.state[None])
    found = (solution.outputs, solution.tangent(np.eye(5)), solution.adjoint(np.eye(2)), state)
    return None if state is None else [values.ravel().tolist() for values in found]


RANKS = """
import sys, json
from mpi4py import MPI
from tests.forward.bodies.test_mesh_file import answers
found = answers(MPI.COMM_WORLD, sys.argv[1])
if found is not None:
    print(json.dumps(found))
"""


@pytest.mark.fem
@pytest.mark.mpi
def test_ranks_that_share_the_mesh_agree(file):
    done = on_kept_ranks(2, RANKS, file)
    assert done.returncode == 0, done.stderr
    for a, b in zip(answers(MPI.COMM_SELF, file), json.loads(done.stdout.splitlines()[-1]), strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-9 * np.abs(a).max())


def specimen(file, **changes):
    """The regional model in two load cases that are alike, of which one corner is observed."""
    acting = {key: getattr(regional(file), key) for key in ("clamp", "displacements", "loads")}
    blocks = {
        "body": {"kind": "mesh", "file": str(file), "degree": regional(file).body.degree},
        "material": regional(file).material.model_dump(),
        "regions": {"right": REGION},
        "cases": [{"name": name, **acting} for name in ("first", "second")],
        "observed": [{"at": [SIZE]}],
    }
    return Specimen.model_validate(blocks | changes)


@pytest.mark.fem
def test_specimens_have_regions(file):
    """What is observed of a specimen follows the numbers of its regions; what is wrong with them is said once."""
    found = specimen(file).build(MPI.COMM_SELF, NUMBERS)
    point = np.array([1e4, 2e4, 3e4, 1e5, 1.5])
    expected = built(regional(file), *NUMBERS).solve(point)
    solution = found.solve(point)
    np.testing.assert_allclose(solution.solutions[0].state, expected.state, rtol=1e-9, atol=1e-12)
    check_derivatives(found, point, 0.1 * point, accuracy=1e-10, steps=STEPS).require()
    with pytest.raises(ValidationError, match="unknown region; did you mean 'right'") as caught:
        specimen(file, regions={"rigth": {"contrast": 2.0}})
    assert [error["loc"] for error in caught.value.errors()] == [("regions", "rigth")]


@pytest.mark.fem
def test_results_hold_the_regions(tmp_path, file):
    model = built(regional(file), *NUMBERS)
    nodes = model.space.coordinates
    data = xr.Dataset({"field_mean": (("node", "component"), nodes)}, {"output": ["u"]})
    data = label(data, {"u": "m"}, nodes, *model.space.cells())
    data = with_regions(data, model.spec.body.regions, model.space.regions())
    grid = pyvista.read(write_fields(tmp_path, data))
    middles = grid.cell_centers().points[:, 0]
    assert list(data.region.values) == ["left", "right"]
    np.testing.assert_array_equal(grid.cell_data["region"], middles > 0.5)
    np.testing.assert_array_equal(data["cell_region"], middles > 0.5)


@pytest.mark.fem
def test_fields_on_a_mesh_of_tetrahedra(tmp_path):
    meshio.write(tmp_path / "box.vtu", numbered(box("tetra")))
    field = {"of": "stiffness", "length": 0.5, "std": 0.3, "modes": 2}
    blocks = {
        "fields": (field,),
        "clamp": ("10",),
        "displacements": (),
        "outputs": ({"name": "u", "kind": "max-displacement"},),
    }
    loads = ({"kind": "gravity", "direction": (0.0, -1.0, 0.3), "density": 600.0},)
    model = spec(tmp_path / "box.vtu", loads=loads, **blocks)
    names = ("fields.stiffness.0", "fields.stiffness.1")
    check_derivatives(built(model, *names), np.array([0.3, -0.5]), np.ones(2), accuracy=1e-10).require()


def test_groups_of_gmsh(tmp_path):
    gmsh = pytest.importorskip("gmsh")
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.model.occ.addBox(0, 0, 0, 2, 1, 1)
    gmsh.model.occ.synchronize()
    gmsh.model.addPhysicalGroup(3, [1], name="whole liver")
    gmsh.model.addPhysicalGroup(2, [1], name="held")
    gmsh.model.addPhysicalGroup(2, [2], tag=7)
    gmsh.model.addPhysicalGroup(2, [3, 4], name="whole liver")  # as the volume
    gmsh.model.addPhysicalGroup(2, [1, 2, 3], name="skin")  # which others share
    gmsh.option.setNumber("Mesh.MeshSizeMax", 0.7)
    gmsh.model.mesh.generate(3)
    for form in (2.2, 4.1):
        gmsh.option.setNumber("Mesh.MshFileVersion", form)
        gmsh.write(str(tmp_path / f"box{form}.msh"))
    gmsh.model.addPhysicalGroup(3, [1], name="again")
    gmsh.write(str(tmp_path / "twice.msh"))
    gmsh.option.setNumber("Mesh.SaveAll", 1)
    gmsh.write(str(tmp_path / "all.msh"))
    gmsh.finalize()
    for form in (2.2, 4.1):
        own = MeshFile(file=str(tmp_path / f"box{form}.msh"), unit=0.1, names={"pulled": 7})
        assert set(own.boundaries) == {"held", "pulled", "whole-liver", "skin"}
        assert own.contents.areas == pytest.approx({"held": 0.01, "pulled": 0.01, "whole-liver": 0.04, "skin": 0.04})
        assert own.regions == ("whole-liver",)
    for name, message in (
        ("twice", r"cells are in several groups of volumes \(whole-liver, again\), expected one region for each"),
        ("all", "has cells in no physical group"),
    ):
        with pytest.raises(ValueError, match=message):
            MeshFile(file=str(tmp_path / f"{name}.msh"))
    assert own.contents.regions["whole-liver"] == pytest.approx(2e-3)
    np.testing.assert_allclose(np.array(own.corners_of("held"))[:, 0], 0, atol=1e-12)
    np.testing.assert_allclose(np.array(own.corners_of("pulled"))[:, 0], 0.2)


def write(path, mesh):
    meshio.write(path, mesh)
    return path


def lacking(mesh):
    return meshio.Mesh(mesh.points, mesh.cells[:1])


def doubled(mesh):
    points = np.vstack([mesh.points, mesh.points])
    cells = [(mesh.cells[0].type, np.vstack([mesh.cells[0].data[:1], mesh.cells[0].data[1:] + len(mesh.points)]))]
    cells += [(mesh.cells[1].type, mesh.cells[1].data)]
    return meshio.Mesh(points, cells, cell_data=mesh.cell_data)


def flat(mesh):
    mesh.points[:, 2] = 0
    return mesh


def apart(mesh):
    mesh = doubled(mesh)
    mesh.points[len(mesh.points) // 2 :] += 5
    return mesh


def folded(mesh):
    mesh.points[mesh.points[:, 0] == 1, 0] = 0.2  # the right cell reaches into the left one
    return mesh


def repeated(mesh):
    cells = [(mesh.cells[0].type, mesh.cells[0].data[[0, 1, 1]]), mesh.cells[1]]
    return meshio.Mesh(mesh.points, cells, cell_data={"part": [np.array([1, 2, 2]), mesh.cell_data["part"][1]]})


def mixed(mesh):
    other = box("tetra")
    cells = [*mesh.cells, *other.cells]
    return meshio.Mesh(
        mesh.points, cells, cell_data={"part": [*mesh.cell_data["part"], *other.cell_data["gmsh:physical"]]}
    )


@pytest.mark.parametrize(
    ("change", "settings", "message"),
    [
        (lacking, {}, "names no boundary, expected quads of the surface"),
        (doubled, {}, "4 points lie where others lie: its parts are not joined"),
        (flat, {}, "2 of 2 cells have no volume"),
        (apart, {}, r"its cells are 2 parts that share no face \(of 1, 1 cells\), expected one body"),
        (folded, {}, "1 pairs of neighbouring cells lie on the same side of their common face: some are inside out"),
        (repeated, {}, "1 faces belong to more than two cells: some cells are there twice"),
        (mixed, {}, "holds hexahedron, tetrahedron, expected linear tetrahedra or linear hexahedra alone"),
        (lambda mesh: mesh, {"names": {"tool": 99}}, r"has no number 99 \(names.tool\), expected one of: 1, 2, 10"),
        (lambda mesh: mesh, {"tags": "prt"}, r"has no array 'prt'; did you mean 'part'"),
    ],
)
def test_one_line_for_a_file_that_will_not_do(tmp_path, change, settings, message):
    path = write(tmp_path / "bad.vtu", change(numbered(box())))
    with pytest.raises(ValueError, match=message):
        MeshFile(file=str(path), **settings)


def test_files_that_are_no_meshes(tmp_path, capsys):
    (tmp_path / "text.msh").write_text("hello\n")
    with pytest.raises(ValueError, match=r"cannot be read as a mesh: it is no \.msh file"):
        MeshFile(file=str(tmp_path / "text.msh"))
    assert capsys.readouterr() == ("", "")


def test_numbers_of_an_xdmf_file_count(tmp_path):
    meshio.write(tmp_path / "box.xdmf", numbered(box()))
    before = MeshFile(file=str(tmp_path / "box.xdmf")).contents.digest
    meshio.write(tmp_path / "box.xdmf", numbered(box(scale=2.0)))  # the same text, other numbers beside it
    assert MeshFile(file=str(tmp_path / "box.xdmf")).contents.digest != before


ABAQUS = """*HEADING
 two tetrahedra
*NODE
 1, 0, 0, 0
 2, 1, 0, 0
 3, 0, 1, 0
 4, 0, 0, 1
 5, 1, 1, 1
*ELEMENT, TYPE=C3D4, ELSET=ALL
 10, 1, 2, 3, 4
 11, 2, 3, 4, 5
*ELSET, ELSET=LUMP
 11
*NSET, NSET=BOTTOM
 1, 2, 3
*NSET, NSET=INNER
 2, 3, 4
*NSET, NSET=SIDES, GENERATE
 1, 4, 1
"""


def test_sets_of_abaqus(tmp_path):
    """Of elements they are regions, of nodes boundaries; a set of all elements says nothing, and faces inside none."""
    path = tmp_path / "a.inp"
    path.write_text(ABAQUS)
    body = MeshFile(file=str(path))
    assert body.contents.regions == pytest.approx({"body": 1 / 6, "LUMP": 1 / 3}, rel=1e-5)
    assert body.contents.areas == pytest.approx({"BOTTOM": 0.5, "SIDES": 1.5}, rel=1e-5)
    path.write_text(ABAQUS.replace("ELSET=LUMP\n 11", "ELSET=BOTTOM\n 10, 11").replace(", ELSET=ALL", ""))
    body = MeshFile(file=str(path))
    assert (body.regions, body.boundaries) == (("BOTTOM",), ("BOTTOM-nodes", "SIDES"))
    path.write_text(ABAQUS + "*ELSET, ELSET=SOFT\n 11\n")
    with pytest.raises(ValidationError, match="1 cells are in several groups of volumes"):
        MeshFile(file=str(path))
    path.write_text(ABAQUS.partition("*NSET")[0])
    assert MeshFile(file=str(path)).boundaries == ("surface",)


def test_files_of_pyvista(tmp_path):
    mesh = box("tetra")
    grid = pyvista.UnstructuredGrid(
        {pyvista.CellType.TETRA: mesh.cells[0].data, pyvista.CellType.TRIANGLE: mesh.cells[1].data}, mesh.points
    )
    grid.save(tmp_path / "bare.vtu")
    bare = MeshFile(file=str(tmp_path / "bare.vtu"))
    assert (bare.boundaries, bare.regions) == (("surface",), ("body",))
    grid.cell_data["part"] = np.concatenate(mesh.cell_data["gmsh:physical"]).astype(np.int64)
    for form in ("vtu", "vtk"):
        before = locale.setlocale(locale.LC_ALL)
        grid.save(tmp_path / f"box.{form}")
        locale.setlocale(locale.LC_ALL, before)  # which VTK changes
        own = MeshFile(file=str(tmp_path / f"box.{form}"))
        assert set(own.boundaries) == {f"{10 + k}" for k in range(6)}
        assert own.regions == ("1", "2")


STUDY = """
[model]
body = {{ kind = "mesh", file = "box.msh", unit = {unit} }}
material = {{ kind = "neo-hookean", C1 = 1e4, D1 = 1e5 }}
regions = {{ {region} = {{ {number} = 2e4 }} }}
clamp = ["{clamp}"]
loads = [{{ kind = "gravity", density = 1000 }}]
outputs = [{{ name = "u", kind = "max-displacement" }}]
[parameters]
"material.C1" = {{ kind = "uniform", lower = 5e3, upper = 2e4 }}
[method]
kind = "{method}"
samples = {samples}
"""


def text(**changes):
    usual = {"unit": 1.0, "samples": 16, "region": "right", "number": "C1", "clamp": "x-min", "method": "monte-carlo"}
    return STUDY.format(**(usual | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"region": "rigth"}, "model.regions.rigth: unknown region; did you mean 'right'"),
        ({"number": "C2"}, "model.regions.right.C2: not a constant of 'neo-hookean'; did you mean 'C1'"),
        ({"clamp": "x-mid"}, "model.clamp[0]: unknown boundary; did you mean 'x-min'"),
    ],
)
def test_mistakes_in_a_study(file, changes, message):
    with pytest.raises(StudyError) as caught:
        parse(tomllib.loads(text(**changes)), folder=file.parent)
    assert len(caught.value.args) == 1, caught.value.args
    assert caught.value.args[0].startswith(message)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(StudyError, match=r"model\.body: file: .*box\.msh: cannot be read: No such file"):
        parse(tomllib.loads(text()), folder=tmp_path)


def test_what_was_found_is_listed(file):
    lines = plan(parse(tomllib.loads(text()), folder=file.parent))
    assert "body        mesh box.msh of 1 × 0.7 × 0.8 m" in lines
    assert any(line.startswith("boundaries  x-min (0.56 m²), x-max (0.56 m²), y-min (0.8 m²)") for line in lines)
    assert "regions     left (0.28 m³), right (0.28 m³)" in lines


def test_units_are_checked(file):
    warned = [line for line in plan(parse(tomllib.loads(text(unit=1e-5)), folder=file.parent)) if "warning" in line]
    assert len(warned) == 1
    assert "model.body.unit = 1e-05 makes the body 10 µm long" in warned[0]
    assert not any("warning" in line for line in plan(parse(tomllib.loads(text()), folder=file.parent)))


def test_a_study_knows_its_mesh_again(file, tmp_path):
    path = tmp_path / "elsewhere" / "box.msh"
    path.parent.mkdir()
    shutil.copy(file, path)
    here, there = (parse(tomllib.loads(text()), folder=place.parent) for place in (file, path))
    assert differences(document(here), document(there)) == []
    path.unlink()
    again = parse(document(there))  # as a report reads it where the file is not
    assert again == there
    meshio.write(path, box(scale=2.0), file_format="gmsh22", binary=True)
    with pytest.raises(ModelError, match="is not the file that the study was made for"):
        again.model.body.load()


@pytest.mark.fem
@pytest.mark.slow
def test_the_organ(tmp_path):
    from workflows.run.run import run

    study = load(ROOT / "configs" / "organ.toml", ["method.samples=16"])
    assert study.model.unknowns >= 10_000
    assert run(study, "organ", tmp_path / "organ", quiet=True, report=False) == 0
    data = xr.load_dataset(tmp_path / "organ" / "results.nc")
    assert -0.01 < float(data["mean"].sel(output="push")) < 0


@pytest.mark.fem
@pytest.mark.slow
def test_derivatives_by_the_numbers_of_regions_in_the_mixed_form(file):
    model = spec(file, body={"degree": 2}, formulation="mixed", regions={"right": REGION}, outputs=FEW)
    point = np.array([1e4, 2e4, 3e4, 1e6, 1.5])
    check_derivatives(built(model, *NUMBERS), point, 0.1 * point, accuracy=1e-10, steps=STEPS).require()


@pytest.mark.parametrize("binary", [True, False])
def test_damaged_meshes_are_one_line_each(tmp_path, binary):
    """Cut anywhere, with lines that are missing and with numbers that cannot be; some changes leave a mesh."""
    organ = ROOT / "configs" / "organ.toml"
    document_ = tomllib.loads(organ.read_text())
    whole = (organ.parent / document_["model"]["body"]["file"]).read_bytes()
    if not binary:
        meshio.write(
            tmp_path / "text.msh", meshio.gmsh.read(organ.parent / "meshes" / "organ.msh"), "gmsh22", binary=False
        )
        whole = (tmp_path / "text.msh").read_bytes()
    document_["model"]["body"]["file"] = "damaged.msh"
    chance = random.Random(7)
    for kind in ("empty", "zeros", *(["cut", "line", "-7", "99999999999999999999", "nan", "1e308", "word"] * 2)):
        lines = whole.split(b"\n")
        at = chance.randrange(len(lines))
        if kind == "line":
            del lines[at]
        elif kind not in {"empty", "zeros", "cut"}:
            words = lines[at].split() or [b""]
            words[chance.randrange(len(words))] = kind.encode()
            lines[at] = b" ".join(words)
        damaged = {"empty": b"", "zeros": bytes(1000), "cut": whole[: chance.randrange(len(whole))]}
        (tmp_path / "damaged.msh").write_bytes(damaged.get(kind, b"\n".join(lines)))
        try:
            parse(document_, folder=tmp_path)
            said = ()
        except StudyError as error:
            said = error.args
        assert all(line.isprintable() and len(line) <= 620 for line in said), (kind, at)
