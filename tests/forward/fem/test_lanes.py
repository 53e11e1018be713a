"""Kernels for several cells at once: what DOLFINx's own loop over cells gives."""

import copy
import platform
import subprocess

import numpy as np
import pytest
import ufl
from mpi4py import MPI

from forward import native
from forward.bodies.geometry import Box
from forward.fem.dolfinx import assembly, compile, lanes, meshes, spaces, version
from tests.bodies import loaded_body
from tests.forward.fem.test_lockstep import field
from tests.forward.fem.test_mixed import cantilever

pytestmark = [pytest.mark.fem, pytest.mark.flags]


def cell_by_cell(assembler):
    """The same without lanes."""
    assert assembler._lanes is not None
    plain = copy.copy(assembler)
    plain._lanes, plain._alone = None, False
    if isinstance(plain, assembly.VectorAssembler):
        plain._forms = [plain._of_cells, *plain._forms]
    return plain


def bodies():
    for material in ("mooney-rivlin", "ogden", "holzapfel-gasser-ogden", "neo-hookean-coupled"):
        yield loaded_body(material).build(MPI.COMM_SELF, ())
    yield cantilever("hexahedron", (5, 1, 1))
    yield field()[0]


def test_forces_are_those_of_one_cell_after_the_other():
    for model in bodies():
        equations = model.equations
        rng = np.random.default_rng(0)
        for random in equations.fields:
            random.set(0.3 * rng.standard_normal(len(equations.parameters)))
        equations.set_state(1e-3 * model._extent * rng.standard_normal(equations.size))
        for assembler in (equations._residual, equations._jacobians):
            expected = cell_by_cell(assembler)()
            np.testing.assert_allclose(assembler(), expected, rtol=0, atol=1e-13 * np.abs(expected).max())
        averaged, equations.gradients._sums = equations.gradients(), None
        np.testing.assert_allclose(averaged, equations.gradients(), rtol=0, atol=1e-13)


def test_functions_of_vectors():
    """Powers of thirds, which are not the library's, far from one; conditions; what is not defined."""
    comm, corner = MPI.COMM_SELF, np.zeros((1, 3))
    msh, _ = meshes.mesh_body(comm, Box(size=(6.0, 1.0, 1.0), cells=(43, 1, 1), degree=1))
    space, rest = spaces.scalar_space(msh, 1), spaces.constant(msh, 1.7)
    x = spaces.function(space)
    x.x.array[:] = np.logspace(-4, 4, len(x.x.array))
    thirds = [k / 3 for k in range(-10, 11) if k]
    chosen = ufl.conditional(ufl.lt(abs(x - 1), 0.5), ufl.ln(x), 2 + ufl.conditional(ufl.gt(x, 3), 1 / x, x))
    same = ufl.conditional(ufl.lt(ufl.as_ufl(0.0), 0.1), x, -x)  # of numbers that are the same in all cells
    others = [chosen, same, ufl.max_value(x, 2), ufl.sqrt(x), ufl.tanh(x), ufl.sin(x), ufl.exp(-x), version.atan2(x, 2)]
    functions = ufl.as_vector([x**power for power in (*thirds, 0.3, -1.7, rest)] + others)
    values = assembly.PointValues(functions, corner, space, comm, often=True)
    found = values()
    np.testing.assert_allclose(found, cell_by_cell(values)(), rtol=4e-15)
    assert found.min() < 1e-12
    assert found.max() > 1e12
    x.x.array[:] -= 1.0
    roots = assembly.PointValues(ufl.as_vector([x**power for power in thirds]), corner, space, comm, often=True)
    found = roots()
    np.testing.assert_allclose(found, cell_by_cell(roots)(), rtol=4e-15)
    assert np.isnan(found).any()


@pytest.mark.skipif(platform.machine() != "x86_64", reason="processors of one kind are compared")
def test_lanes_fill_a_register_of_what_is_compiled_for():
    """Never more, which compilers take apart badly, whatever this processor is."""

    def defined(flags):
        command = [*lanes.sysconfig.get_config_var("CC").split(), *flags, "-E", "-dM", "-xc", str(lanes._SOURCE)]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    for march, width in (("x86-64-v2", 2), ("x86-64-v3", 4), ("x86-64-v4", 8)):
        assert f"#define LANES {width}\n" in defined([f"-march={march}"])
    equations = next(bodies()).equations
    assert f"#define LANES {equations._residual._lanes.lanes}\n" in defined(native.FLAGS)


def test_without_a_compiler_cells_come_one_after_the_other(tmp_path, monkeypatch, caplog):
    comm = MPI.COMM_SELF
    monkeypatch.setattr(compile, "_CACHE", tmp_path)
    monkeypatch.setattr(lanes.sysconfig, "get_config_var", lambda name: "false")
    msh, _ = meshes.mesh_body(comm, Box(size=(1.0, 2.0, 3.0), cells=(2, 2, 2), degree=1))
    v = ufl.TestFunction(spaces.scalar_space(msh, 1))
    volume = assembly.VectorAssembler(spaces.constant(msh, 1.0) * v * ufl.dx(domain=msh), None, comm, often=True)
    assert volume._lanes is None
    assert volume().sum() == pytest.approx(6.0)
    again = assembly.VectorAssembler(spaces.constant(msh, 1.0) * v * ufl.dx(domain=msh), None, comm, often=True)
    assert again._lanes is None
    (said,) = caplog.messages
    assert said == "forces take longer, one cell after the other: false does not compile vectors of cells"
