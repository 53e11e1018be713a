"""Specifications: what cannot be a body is refused before anything is built, with all mistakes at once."""

import numpy as np
import pytest
from pydantic import ValidationError

from forward.hyperelastic import Hyperelastic
from forward.materials.material import MATERIALS, constants, measures
from forward.solvers.settings import SolverSettings
from forward.specimen import Specimen
from workflows.studies.sampling import Study

pytestmark = pytest.mark.unit

BLOCKS = {
    "body": {"kind": "box", "size": (1.0, 1.0, 1.0), "cells": (2, 2, 2)},
    "material": {"kind": "neo-hookean", "C1": 1.0, "D1": 1.0},
    "clamp": ("x-min",),
    "loads": ({"kind": "gravity", "density": 1.0},),
    "outputs": ({"kind": "strain-energy", "name": "energy"},),
}
BLOCK = {
    "kind": "block",
    "corners": tuple((x * (1 + y), y, z) for z in (0.0, 1.0) for y in (0.0, 1.0) for x in (0.0, 1.0)),
    "cells": (1, 1, 1),
}
MIRRORED = tuple((-x, y, z) for x, y, z in BLOCK["corners"])
FLAT = tuple((x, y, x + y) for x, y, z in BLOCK["corners"])
TRACTION = {"kind": "traction", "on": "x-max", "direction": (1.0, 0.0, 0.0), "size": 1.0}
COUPLED = {"kind": "neo-hookean-coupled", "mu": 1.0, "lmbda": 1e6}
MOVED = {"on": "x-max", "x": 0.1}
TUMOUR = {"name": "tumour", "x": 0.5, "y": 0.5, "z": 0.5, "radius": 0.2, "contrast": 10.0, "width": 0.1}


def mistakes(**changes):
    """The mistakes of a changed specification: place and message."""
    with pytest.raises(ValidationError) as error:
        Hyperelastic.model_validate(BLOCKS | changes)
    return {".".join(map(str, line["loc"])): line["msg"] for line in error.value.errors()}


def test_points_within_a_thousandth_are_moved_and_that_is_said():
    def at(*points):
        outputs = [{"kind": "displacement", "name": f"u{k}", "at": p, "component": "x"} for k, p in enumerate(points)]
        return Hyperelastic.model_validate(BLOCKS | {"outputs": outputs}).findings

    assert not at((1.0, 0.5, 0.5), (1.0 + 1e-15, 0.5, 0.5))
    (note,) = at((1.001, 0.5, 0.5), (0.5, 0.5, -2e-4), (0.1, 0.1, 0.1))
    assert note.severity == "note"
    assert note.text == "2 points lie outside the body and are moved to its surface, by up to 1 mm ('u0')."


def test_the_specification_without_mistakes_is_accepted():
    assert Hyperelastic.model_validate(BLOCKS).unknowns == 3 * 5**3


@pytest.mark.parametrize(
    ("changes", "place", "message"),
    [
        ({"clamp": ("x-mim",)}, "clamp.0", "did you mean 'x-min'"),
        ({"loads": (TRACTION | {"on": "top"},)}, "loads.0.on", "unknown boundary"),
        ({"displacements": (MOVED | {"on": "w-max"},)}, "displacements.0.on", "did you mean"),
        (
            {"outputs": ({"kind": "reaction", "name": "r", "on": "q", "component": "x"},)},
            "outputs.0.on",
            "unknown boundary",
        ),
        ({"loads": (TRACTION, TRACTION)}, "loads", "2 of them are called 'traction'"),
        ({"outputs": BLOCKS["outputs"] * 2}, "outputs", "2 of them are called 'energy'"),
        ({"outputs": ()}, "outputs", "at least 1 item"),
        ({"clamp": ()}, "clamp", "nothing holds the body along x, y, z"),
        ({"clamp": (), "displacements": (MOVED,)}, "clamp", "nothing holds the body along y, z"),
        ({"displacements": (MOVED | {"on": "x-min"},)}, "displacements.0.on", "is clamped"),
        (
            {"displacements": (MOVED, MOVED | {"name": "again"})},
            "displacements.1.on",
            "x prescribed more than once",
        ),
        ({"displacements": ({"on": "x-max"},)}, "displacements.0", "prescribes nothing"),
        (
            {"outputs": ({"kind": "reaction", "name": "r", "on": "x-max", "component": "x"},)},
            "outputs.0.on",
            "nothing holds this boundary",
        ),
        (
            {"outputs": ({"kind": "displacement", "name": "u", "at": (0.5, 0.5, 1.1), "component": "x"},)},
            "outputs.0.at",
            "outside the body",
        ),
        ({"loads": (TRACTION | {"direction": (0.0, 0.0, 0.0)},)}, "loads.0.direction", "length zero"),
        ({"loads": ({"kind": "gravity", "density": -1.0},)}, "loads.0.density", "greater than or equal to 0"),
        ({"loads": ({"kind": "gravity", "density": "heavy"},)}, "loads.0.density", "valid number"),
        ({"loads": ({"kind": "gravity", "denisty": 1.0},)}, "loads.0.denisty", "did you mean 'density'"),
        ({"loads": ({"kind": "magnet", "size": 1.0},)}, "loads.0.kind", "expected one of: gravity, traction, pressure"),
        (
            {"material": {"kind": "neo-hookean", "C1": 0.0, "D1": 1.0}},
            "material",
            "μ = 2 C1 = 0 Pa",
        ),
        ({"material": {"kind": "neo-hookean", "C1": np.nan, "D1": 1.0}}, "material.C1", "finite"),
        ({"material": {"kind": "neo-hookean", "D1": 1.0}}, "material.C1", "missing"),
        ({"body": BLOCKS["body"] | {"cells": (0, 2, 2)}}, "body.box.cells.0", "greater than 0"),
        ({"body": BLOCKS["body"] | {"cells": (2000, 2000, 2000)}}, "body.box", "at most 60 million"),
        ({"body": BLOCKS["body"] | {"degree": 3}}, "body.box.degree", "1 or 2"),
        ({"body": BLOCKS["body"] | {"quadrature_degree": 3}}, "body.box", "without energy, expected at least 4"),
        ({"body": {"kind": "bock"}}, "body.kind", "did you mean 'block'?"),
        ({"body": BLOCK | {"corners": BLOCK["corners"][:7]}}, "body.block.corners.7", "missing"),
        ({"body": BLOCK | {"corners": MIRRORED}}, "body.block", "inside out"),
        ({"body": BLOCK | {"corners": FLAT}}, "body.block", "no volume"),
        ({"body": BLOCK | {"cells": (2000, 2000, 2000)}}, "body.block", "at most 60 million"),
        ({"body": BLOCK, "clamp": ("left",)}, "clamp.0", "unknown boundary"),
        ({"inclusions": (TUMOUR | {"y": 1.1},)}, "inclusions.0", "centre lies outside the body, which lies in [0, 1]"),
        ({"inclusions": (TUMOUR, TUMOUR)}, "inclusions", "2 of them are called 'tumour'"),
        ({"inclusions": (TUMOUR | {"contrast": 0.0},)}, "inclusions.0.sphere.contrast", "greater than 0"),
        ({"inclusions": (TUMOUR | {"radius": 0.0},)}, "inclusions.0.sphere.radius", "greater than 0"),
        ({"inclusions": (TUMOUR | {"width": 0.0},)}, "inclusions.0.sphere.width", "greater than 0"),
        ({"inclusions": (TUMOUR | {"kind": "cube"},)}, "inclusions.0.kind", "expected one of: sphere, ellipsoid"),
        (
            {"inclusions": (TUMOUR | {"name": "a.b"},)},
            "inclusions.0.sphere.name",
            "expected a name without dots and blanks",
        ),
        ({"inclusions": (TUMOUR | {"raduis": 0.1},)}, "inclusions.0.sphere.raduis", "did you mean 'radius'"),
        ({"solver": {"tolerance": 0.0}}, "solver.tolerance", "greater than 0"),
        ({"formulation": "mixd"}, "formulation", "'displacement', 'mixed' or 'auto'"),
        ({"formulation": "mixed", "body": BLOCKS["body"] | {"degree": 1}}, "formulation", "expected body.degree = 2"),
        ({"formulation": "mixed", "material": COUPLED}, "formulation", "has no part of the volume alone"),
        ({"lodas": ()}, "lodas", "did you mean 'loads'"),
    ],
)
def test_a_mistake_is_named_with_its_place(changes, place, message):
    assert message in mistakes(**changes)[place]


def test_all_mistakes_are_reported_together():
    found = mistakes(
        clamp=("x-mim",),
        loads=(TRACTION | {"on": "x-mx"},),
        displacements=({"on": "y-mn", "y": 0.0},),
        outputs=BLOCKS["outputs"] * 2,
    )
    assert set(found) == {"clamp.0", "loads.0.on", "displacements.0.on", "outputs"}


@pytest.mark.parametrize(
    ("boundaries", "held"),
    [
        ({"x-min": "x", "y-min": "y", "z-min": "z"}, True),
        ({"x-min": "xyz"}, True),
        ({"y-min": "x", "z-min": "y", "x-min": "z"}, True),
        ({"y-min": "x", "x-min": "y", "z-min": "z"}, False),  # turns about z
        ({"y-min": "x", "x-min": "y", "z-min": "z", "y-max": "x"}, True),
    ],
)
def test_a_body_on_rollers_must_not_turn(boundaries, held):
    displacements = tuple({"on": on} | dict.fromkeys(axes, 0.0) for on, axes in boundaries.items())
    if held:
        assert Hyperelastic.model_validate(BLOCKS | {"clamp": (), "displacements": displacements})
    else:
        found = mistakes(clamp=(), displacements=displacements)
        assert found == {
            "displacements": "nothing stops the body from turning, expected a clamp or more prescribed displacements"
        }


def test_a_number_that_is_not_admissible_is_objected_to():
    spec = Hyperelastic.model_validate(BLOCKS | {"loads": (TRACTION, *BLOCKS["loads"]), "displacements": (MOVED,)})
    assert set(spec.scalars) == {
        "material.C1",
        "material.D1",
        "loads.traction.size",
        "loads.gravity.density",
        "displacements.x-max.x",
    }
    assert "greater than or equal to 0" in spec.scalars["loads.gravity.density"].objection(-1.0)
    for path in spec.scalars:
        assert spec.scalars[path].objection(2.0) is None
    for path in ("loads.traction.size", "displacements.x-max.x"):
        assert spec.scalars[path].objection(-2.0) is None


def test_every_number_of_an_inclusion_has_limits():
    spec = Hyperelastic.model_validate(BLOCKS | {"inclusions": (TUMOUR, TUMOUR | {"name": ""})})
    paths = {path for path in spec.scalars if path.startswith("inclusions.")}
    numbers = ("x", "y", "z", "radius", "contrast", "width")
    assert paths == {f"inclusions.{label}.{name}" for label in ("tumour", "sphere") for name in numbers}
    for name in numbers:
        scalar = spec.scalars[f"inclusions.tumour.{name}"]
        assert scalar.value == TUMOUR[name]
        assert scalar.objection(0.7) is None
    for name in ("radius", "contrast", "width"):
        assert "greater than 0" in spec.scalars[f"inclusions.tumour.{name}"].objection(0.0)
    for name in "xyz":
        # The centre stays in the body.
        assert "less than or equal to 1" in spec.scalars[f"inclusions.tumour.{name}"].objection(1.1)
        assert "greater than or equal to 0" in spec.scalars[f"inclusions.tumour.{name}"].objection(-0.1)


def test_a_specification_cannot_be_changed():
    spec = Hyperelastic.model_validate(BLOCKS | {"clamp": ["x-min"]})
    assert spec.clamp == ("x-min",)
    with pytest.raises(ValidationError, match="frozen"):
        spec.clamp = ()
    with pytest.raises(ValidationError, match="frozen"):
        spec.body.degree = 1


@pytest.mark.parametrize("kind", MATERIALS)
def test_the_constants_of_a_material_are_the_arguments_of_its_energy(kind):
    values = dict.fromkeys(constants(MATERIALS[kind]), 2.0)
    fibres = {"fibres": [[0.0, 3.0, 4.0]]} if "i4" in measures(kind) else {}
    spec = Hyperelastic.model_validate(BLOCKS | {"material": {"kind": kind} | values | fibres})
    assert spec.fibres == (((0.0, 0.6, 0.8),) if fibres else ())
    assert [path for path in spec.scalars if path.startswith("material.")] == [f"material.{name}" for name in values]


@pytest.mark.parametrize(
    ("bulk", "degree", "formulation", "mixed"),
    [
        (1.0, 2, "auto", False),
        (2.9, 2, "auto", False),
        (3.1, 2, "auto", True),
        (1e6, 2, "auto", True),
        (1e6, 1, "auto", False),
        (1e6, 2, "displacement", False),
        (1.0, 2, "mixed", True),
    ],
)
@pytest.mark.parametrize("constants_", [{"kind": "neo-hookean", "C1": 3.0}, {"C1": 1.0, "C2": 2.0}])
def test_the_mixed_form_is_chosen_for_nearly_incompressible_bodies(constants_, bulk, degree, formulation, mixed):
    material = {"kind": "mooney-rivlin", "D1": 3.0 * bulk} | constants_  # μ = 6, κ = 6 bulk
    body = BLOCKS["body"] | {"degree": degree}
    spec = Hyperelastic.model_validate(BLOCKS | {"material": material, "body": body, "formulation": formulation})
    assert spec.mixed == mixed
    assert spec.unknowns == 3 * (2 * degree + 1) ** 3 + 27 * mixed


def test_an_energy_that_does_not_split_keeps_the_displacement_form():
    assert not Hyperelastic.model_validate(BLOCKS | {"material": COUPLED}).mixed


def test_settings_of_the_solver_have_defaults():
    assert Hyperelastic.model_validate(BLOCKS).solver == SolverSettings()


PULLS = (  # in two load cases, with and without names
    {"kind": "traction", "on": "x-max", "direction": (1.0, 0.0, 0.0), "size": 10.0},
    {"kind": "traction", "on": "x-max", "direction": (0.0, 1.0, 0.0), "size": 20.0},
)


def pulled(*loads, displacements=((), ())):
    """A specimen with a load in each of two load cases."""
    case = {
        "clamp": ("x-min",),
        "outputs": ({"name": "sag", "kind": "displacement", "at": (1, 0, 0), "component": "y"},),
    }
    cases = [
        case | {"name": name, "loads": (load,), "displacements": moved}
        for name, load, moved in zip(("pull", "shear"), loads, displacements, strict=True)
    ]
    body = {"kind": "box", "size": (1.0, 1.0, 1.0), "cells": (1, 1, 1)}
    return Specimen(body=body, material={"kind": "neo-hookean", "C1": 1e3, "D1": 1e4}, cases=cases)


def study_of(specimen, *paths):
    parameters = {path: {"kind": "uniform", "lower": 10.0, "upper": 20.0} for path in paths}
    return Study(model=specimen, parameters=parameters, method={"kind": "monte-carlo", "samples": 4})


@pytest.mark.unit
def test_unnamed_loads_of_different_size_are_no_one_parameter():
    several = pulled(*PULLS)
    (note,) = [one for one in several.findings if "share a path" in one.text]
    assert note.severity == "note"
    assert "loads.traction.size" in note.text
    with pytest.raises(ValidationError, match=r"'loads\.traction\.size' is 10 in pull, 20 in shear, without a name"):
        study_of(several, "loads.traction.size")
    study_of(several, "material.C1")  # no parameter touches it
    same = PULLS[1] | {"size": 10.0}
    one_named = (PULLS[0] | {"name": "traction"}, PULLS[1])
    with pytest.raises(ValidationError, match="without a name"):
        study_of(pulled(*one_named), "loads.traction.size")
    both = [one | {"name": "hook"} for one in PULLS]
    for fine, path in (
        (pulled(PULLS[0], same), "loads.traction.size"),
        (pulled(*both), "loads.hook.size"),
        (pulled(PULLS[0], PULLS[1] | {"name": "hook"}), "loads.hook.size"),
    ):
        assert not [one for one in fine.findings if "share a path" in one.text]
        study_of(fine, path)


@pytest.mark.unit
def test_displacements_of_one_boundary_in_several_load_cases():
    moved = [({"on": "y-max", "y": y},) for y in (0.1, -0.1)]
    several = pulled(PULLS[0], PULLS[0], displacements=moved)
    with pytest.raises(ValidationError, match=r"'displacements\.y-max\.y' is 0\.1 in pull, -0\.1 in shear"):
        study_of(several, "displacements.y-max.y")
    named = [({"on": "y-max", "y": y, "name": name},) for y, name in ((0.1, "up"), (-0.1, "down"))]
    study_of(pulled(PULLS[0], PULLS[0], displacements=named), "displacements.up.y")
