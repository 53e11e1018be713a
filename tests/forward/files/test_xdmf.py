"""Meshes in XDMF as DOLFINx writes them: cells, tags of cells and of facets, in HDF5 or in the text."""

import numpy as np
import pytest
from pydantic import ValidationError

from forward.bodies.mesh_file import MeshFile
from tests.launch import on_kept_ranks

SCRIPT = """
from mpi4py import MPI
import numpy as np
from dolfinx import io, mesh
for kind in ("tetrahedron", "hexahedron"):
    size = np.array([0.03, 0.02, 0.02])
    box = mesh.create_box(MPI.COMM_WORLD, [np.zeros(3), size], [2, 2, 1], cell_type=getattr(mesh.CellType, kind))
    def tags(dim, name, *where):
        found = [mesh.locate_entities(box, dim, one) for one in where]
        entities = np.concatenate(found).astype(np.int32)
        values = np.concatenate([np.full(len(one), 11 * (k + 1)) for k, one in enumerate(found)]).astype(np.int32)
        order = np.argsort(entities)
        made = mesh.meshtags(box, dim, entities[order], values[order])
        made.name = name
        return made
    cells = tags(3, "parts", lambda x: x[0] > 0.0149)
    facets = tags(2, "sides", lambda x: np.isclose(x[2], 0), lambda x: np.isclose(x[2], 0.02))
    box.topology.create_connectivity(2, 3)
    form = "HDF5" if box.comm.size > 1 else "ASCII"  # of which DOLFINx writes the text of one rank alone
    encoding = getattr(io.XDMFFile.Encoding, form)
    with io.XDMFFile(box.comm, f"FOLDER/{kind}-{form}.xdmf", "w", encoding=encoding) as file:
        file.write_mesh(box)
        file.write_meshtags(cells)
        file.write_meshtags(facets)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    found = tmp_path_factory.mktemp("xdmf")
    for ranks in (1, 2):
        done = on_kept_ranks(ranks, SCRIPT.replace("FOLDER", str(found)))
        assert done.returncode == 0, done.stderr
    return found


@pytest.mark.fem
@pytest.mark.mpi
@pytest.mark.parametrize("form", ["HDF5", "ASCII"])
@pytest.mark.parametrize("kind", ["tetrahedron", "hexahedron"])
def test_bodies_that_dolfinx_wrote(folder, kind, form):
    """Also on two ranks, in an order of their own; a part has tags, the rest has none."""
    body = MeshFile(file=str(folder / f"{kind}-{form}.xdmf"), names={"right": 11, "top": 22}, degree=1)
    assert body.cell == kind
    assert body.contents.regions == pytest.approx({"0": 6e-6, "right": 6e-6}, rel=1e-5)
    assert body.contents.areas == pytest.approx({"right": 6e-4, "top": 6e-4}, rel=1e-5)
    loaded = body.load()
    right = loaded.points[loaded.cells[loaded.region == loaded.regions.index("right")]]
    assert right[..., 0].min() == pytest.approx(0.015)
    np.testing.assert_allclose(loaded.points[np.unique(loaded.boundaries["top"])][:, 2], 0.02)


@pytest.mark.fem
@pytest.mark.mpi
def test_files_of_dolfinx_that_will_not_do(folder, tmp_path):
    text = (folder / "tetrahedron-ASCII.xdmf").read_text()

    def told(changed, **settings):
        (tmp_path / "a.xdmf").write_text(changed)
        with pytest.raises(ValidationError) as caught:
            MeshFile(file=str(tmp_path / "a.xdmf"), **settings)
        (found,) = caught.value.errors()
        return found["msg"].rpartition(f"{tmp_path}/")[2].removeprefix("a.xdmf: ")

    head, _, rest = text.partition('<Grid Name="sides"')
    assert told(head + "</Domain></Xdmf>").startswith("names no boundary, expected triangles of the surface")
    twice = rest.partition("</Grid>")[0].replace('Name="sides"', 'Name="others"')
    twice = f'{head}<Grid Name="others"{twice}</Grid><Grid Name="sides"{rest}'
    assert told(twice) == "has several arrays of numbers, expected tags = one of: parts, others, sides"
    (tmp_path / "a.xdmf").write_text(twice)
    assert set(MeshFile(file=str(tmp_path / "a.xdmf"), tags="sides").boundaries) >= {"11", "22"}
    assert told(text[: len(text) // 2]).startswith("cannot be read as a mesh: ")
    assert "numbers, expected" in told(text.replace("</DataItem>", " 1</DataItem>", 1))
    other = (folder / "tetrahedron-HDF5.xdmf").read_text()
    assert told(other).startswith("tetrahedron-HDF5.h5: cannot be read: No such file")
