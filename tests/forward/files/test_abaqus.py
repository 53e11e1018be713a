"""Files of Abaqus as its own programs, gmsh and people write them: the same body, region by region, face by face."""

import meshio
import numpy as np
import pytest
from pydantic import ValidationError

from forward.bodies.mesh_file import MeshFile
from forward.bodies.mesh_reading import digest_of

# Two cubes of 10 side by side, as Abaqus/CAE exports a model with a rigid tool.
CAE = """*Heading
** Job name: Job-1 Model name: Model-1
*Preprint, echo=NO, model=NO
*Part, name=Tool
*Node
 1, 0., 0., 30.
 2, 9., 0., 30.
 3, 0., 9., 30.
*Element, type=R3D3
 1, 1, 2, 3
*End Part
*Part, name=Block
*Node
      1,           0.,           0.,           0.
      2,          10.,           0.,           0.
      3,          20.,           0.,           0.
      4,           0.,          10.,           0.
      5,          10.,          10.,           0.
      6,          20.,          10.,           0.
      7,           0.,           0.,          10.
      8,          10.,           0.,          10.
      9,          20.,           0.,          10.
     10,           0.,          10.,          10.
     11,          10.,          10.,          10.
     12,          20.,          10.,          10.
*Element, type=C3D8RH
1, 1, 2, 5, 4, 7, 8, 11,
 10
2, 2, 3, 6, 5, 8, 9, 12, 11
*Nset, nset=Set-1, generate
  1,  12,   1
*Elset, elset=Set-1, generate
  1,  2,   1
*Elset, elset="stiff lump"
 2,
*Solid Section, elset=Set-1, material=Tissue
,
*End Part
*Assembly, name=Assembly
*Instance, name=Tool-1, part=Tool
*End Instance
*Instance, name=Block-1, part=BLOCK
          5.,           0.,           0.
          5.,           0.,           0.,           5.,           0.,           1.,          90.
*End Instance
*Node
      1,           5.,           5.,          20.
*Nset, nset=_PickedSet13, internal
 1,
*Nset, nset=bottom, instance=Block-1, generate
 1,  6
*Elset, elset=_top_S2, internal, instance=Block-1
 1, 2
*Surface, type=ELEMENT, name=top
_top_S2, S2
*Surface, type=ELEMENT, name=skin
Block-1.Set-1,
*Surface, type=NODE, name=side
Block-1.1, 1
Block-1.4, 1
Block-1.7, 1
Block-1.10, 1
*End Assembly
*Material, name=Tissue
*Hyperelastic, mooney-rivlin
 1e-3, 5e-4, 0.01
*Step, name=Step-1, nlgeom=YES
*Boundary
bottom, ENCASTRE
*End Step
"""


def approx(found):
    return pytest.approx(found, rel=1e-5)  # to six digits


def body_of(path, text):
    path.write_text(text)
    return MeshFile(file=str(path))


def test_models_of_abaqus_itself(tmp_path):
    """Parts and instances (shifted, then turned), hybrid elements, surfaces of sides, reference points and tools."""
    body = body_of(tmp_path / "cae.inp", CAE)
    assert body.contents.regions == approx({"body": 1000, "stiff-lump": 1000})
    assert body.contents.areas == approx({"top": 200, "skin": 1000, "side": 100, "Set-1": 1000, "bottom": 200})
    np.testing.assert_allclose(body.bounds, [(-5, 5), (0, 20), (0, 10)], atol=1e-12)
    loaded = body.load()
    assert np.ptp(loaded.points[np.unique(loaded.boundaries["top"])][:, 2]) == 0
    lump = loaded.points[loaded.cells[loaded.region == loaded.regions.index("stiff-lump")]]
    assert lump[..., 1].min() == pytest.approx(10)  # x of the part is y here


@pytest.mark.parametrize("side", range(1, 7))
def test_sides_of_hexahedra(tmp_path, side):
    """S1 … S6 by their normals."""
    text = CAE.replace("_top_S2, S2", f"_top_S2, S{side}").replace(" 1, 2\n*Surface", " 1,\n*Surface")
    loaded = body_of(tmp_path / "cae.inp", text).load()
    if side == 4:  # between the cells
        assert "top" not in loaded.boundaries
        return
    # in the part: z = 0, z = 10, y = 0, x = 10, y = 10, x = 0; turned by 90° about z there
    axis, value = {1: (2, 0), 2: (2, 10), 3: (0, 5), 5: (0, -5), 6: (1, 0)}[side]
    np.testing.assert_allclose(loaded.points[np.unique(loaded.boundaries["top"])][:, axis], value, atol=1e-12)


TETRAHEDRA = """*NODE, NSET=ALL
 1, 0, 0, 0
 2, 1, 0
 3, 0, 1, 0
 4, 0, 0, 1
 5, 1, 1, 1
*ELEMENT, TYPE=CPS3, ELSET=Surface1
 1, 1, 2, 3
*element, type=c3d4h, elset=Volume1
 10, 1, 2, 3, 4
*ELEMENT, TYPE=C3D4, ELSET=Volume2
 11, 2, 3, 4, 5
*ELEMENT, TYPE=MASS
 99, 1
*ELSET, ELSET=lump
 11
*ELSET, ELSET=tissue
 10
*ELSET, ELSET=bottom
 1
"""


def test_models_of_gmsh(tmp_path):
    """Sets of the user win over those of the entities; triangles are boundaries; types in any case."""
    body = body_of(tmp_path / "a.inp", TETRAHEDRA)
    assert body.contents.regions == approx({"lump": 1 / 3, "tissue": 1 / 6})
    assert {name: body.contents.areas[name] for name in ("bottom", "Surface1")} == {"bottom": 0.5, "Surface1": 0.5}
    body = body_of(tmp_path / "a.inp", TETRAHEDRA.partition("*ELSET")[0])
    assert set(body.regions) == {"Volume1", "Volume2"}
    for one in (1, 2):  # the same set in two blocks
        text = TETRAHEDRA.partition("*ELSET")[0].replace(f"Volume{3 - one}", f"Volume{one}")
        assert body_of(tmp_path / "a.inp", text).contents.regions == approx({f"Volume{one}": 0.5})
    text = TETRAHEDRA.replace("ELSET=Volume2", "OFFSET=0").replace(", ELSET=Surface1", "")
    assert body_of(tmp_path / "a.inp", text.partition("*ELSET")[0]).contents.regions == approx(
        {"Volume1": 1 / 6, "body": 1 / 3}
    )


def test_sections_say_what_is_which_where_sets_overlap(tmp_path):
    more = "*ELSET, ELSET=output\n lump, tissue\n*ELSET, ELSET=near\n 11\n"
    with pytest.raises(ValidationError, match="cells are in several groups of volumes"):
        body_of(tmp_path / "a.inp", TETRAHEDRA + more)
    sections = "*SOLID SECTION, ELSET=LUMP, MATERIAL=a\n*SOLID SECTION, ELSET=tissue, MATERIAL=b\n"
    assert set(body_of(tmp_path / "a.inp", TETRAHEDRA + more + sections).regions) == {"lump", "tissue"}


def test_files_that_are_included_count(tmp_path):
    head, _, rest = TETRAHEDRA.partition("*ELEMENT")
    (tmp_path / "nodes.inp").write_text(head)
    (tmp_path / "rows.txt").write_text(" 10, 1, 2, 3, 4\n")
    whole = f"*INCLUDE, INPUT=nodes.inp\n*ELEMENT{rest}".replace(
        "elset=Volume1\n 10, 1, 2, 3, 4\n", "elset=Volume1,\ninput=rows.txt\n"
    )
    body = body_of(tmp_path / "a.inp", whole)
    assert body.contents.regions == approx({"lump": 1 / 3, "tissue": 1 / 6})
    before = digest_of(str(tmp_path / "a.inp"))
    (tmp_path / "nodes.inp").write_text(head.replace(" 5, 1, 1, 1", " 5, 1, 1, 2"))
    assert digest_of(str(tmp_path / "a.inp")) != before
    (tmp_path / "nodes.inp").unlink()
    with pytest.raises(ValidationError, match=r"nodes\.inp: cannot be read: No such file"):
        body_of(tmp_path / "a.inp", whole)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (" 10, 1, 2, 3, 4", " 10, 1, 2, 3, 7", "element 10 has the node 7, which is not there"),
        (" 10, 1, 2, 3, 4", " 10, 1, 2, 3", r"line 9: \*ELEMENT: 4 numbers, expected 5 for each element of type c3d4h"),
        (" 10, 1, 2, 3, 4", " 10, 1, 2, 3, x", r"line 9: \*ELEMENT: invalid literal"),
        ("c3d4h", "C3D99", r"line 9: \*ELEMENT: unknown type of element 'C3D99'"),
        ("type=c3d4h, ", "", r"line 9: \*ELEMENT without TYPE="),
        ("c3d4h", "C3D10", "expected 11 for each"),
        ("*ELSET, ELSET=bottom\n 1", "*ELSET, ELSET=bottom\n tisue", "no set 'tisue'"),
        ("*NODE, NSET=ALL", "*NODE, SYSTEM=C", "nodes in cylindrical or spherical coordinates"),
        ("*ELSET, ELSET=lump\n 11", "*NGEN\n 1, 5, 1", "a mesh that Abaqus would make, expected all nodes"),
        ("*ELSET, ELSET=lump\n 11", "*SURFACE, NAME=a\n Volume2, E1", r"the side 'E1', expected S1, S2"),
        ("*ELSET, ELSET=lump\n 11", "*INCLUDE, INPUT=a.inp", "files that include each other"),
        (TETRAHEDRA, "Hello\n", r"no \*NODE with rows"),
        (TETRAHEDRA, CAE.replace("part=BLOCK", "part=Blok"), r"\*INSTANCE: no part 'Blok'"),
        (
            "*ELSET, ELSET=lump\n 11",
            "*ELEMENT, TYPE=C3D10\n 12, 1, 2, 3, 4, 5, 1, 2, 3, 4, 5",
            r"holds tetra10, tetrahedron, expected linear",
        ),
    ],
)
def test_one_line_for_what_is_wrong(tmp_path, old, new, told):
    with pytest.raises(ValidationError, match=told) as caught:
        body_of(tmp_path / "a.inp", TETRAHEDRA.replace(old, new))
    assert len(caught.value.errors()) == 1


def test_what_meshio_writes(tmp_path):
    """Its own sets of cells and points, and both kinds of cells."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1.0]])
    meshio.Mesh(
        points,
        [("tetra", [[0, 1, 2, 3], [1, 2, 3, 4]])],
        cell_sets={"lump": [np.array([1])]},
        point_sets={"bottom": np.array([0, 1, 2])},
    ).write(tmp_path / "a.inp")
    body = MeshFile(file=str(tmp_path / "a.inp"))
    assert body.contents.regions == approx({"body": 1 / 6, "lump": 1 / 3})
    assert body.boundaries == ("bottom",)
