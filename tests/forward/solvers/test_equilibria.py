"""Which equilibria are accepted: the screen against dense eigenvalues, and whole bodies that buckle on every path."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from mpi4py import MPI
from scipy.linalg import eigh
from scipy.stats import binom

from benchmarks import buckling
from forward.hyperelastic import Hyperelastic
from forward.model import Guess, ReferenceSolution, SolveError, Stability
from forward.solvers import stability
from forward.solvers.rotations import turn
from forward.solvers.steps import finish, plain
from uq.estimators import failure_domain
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.request import Evaluations, Failure
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import random_points
from uq.surrogates.linearisation import linearise

N = 60
FREE = np.ones(N)


def whole(values):
    return values


def matrices(seed):
    """A stiffness that is stable, and the changes of it by two parameters, of which the first softens one direction."""
    random = np.random.default_rng(seed)
    Q = np.linalg.qr(random.standard_normal((N, N)))[0]
    K = (Q * np.geomspace(1, 1e4, N)) @ Q.T
    root = np.linalg.cholesky(K)
    hidden = np.linalg.qr(root @ random.standard_normal((N, 3)))[0]
    changes = [-0.5 * np.outer(root @ hidden[:, 0], root @ hidden[:, 0]), 0.02 * K]
    changes = [change + 0.02 * root @ np.diag(random.standard_normal(N)) @ root.T for change in changes]
    return K, changes


def vectors(K, changes, seed=0):
    forces = np.random.default_rng(seed).standard_normal((stability.BLOCK, N))
    products = [lambda rows, change=change: rows @ change for change in changes]
    return stability.screening_vectors(products, lambda rows: np.linalg.solve(K, rows.T).T, forces, FREE, whole)


@pytest.mark.parametrize("seed", range(5))
def test_the_screen_bounds_the_lowest_eigenvalue_from_above_and_sees_its_sign(seed):
    K, changes = matrices(seed)
    V = vectors(K, changes)
    np.testing.assert_allclose(V @ K @ V.T, np.eye(len(V)), atol=1e-8)
    for t in np.linspace(-3, 3, 25):
        there = K + t * changes[0] + np.cos(t) * changes[1]
        steps = stability.screen(V, lambda rows: rows @ there, plain, FREE, whole)  # noqa: B023
        seen = finish(steps, lambda right: np.linalg.solve(K, right))
        lowest = eigh(there, K, eigvals_only=True)[0]
        assert seen.lowest >= lowest - 1e-9
        if lowest < 0.7:
            assert seen.lowest == pytest.approx(lowest, abs=0.02)
        if lowest < 0:
            assert not seen.clear
            assert seen.chance == 1


def test_states_that_do_not_resemble_the_reference_are_counted():
    assert stability.Screened(0.9, 1.2).clear
    assert stability.Screened(4.0, 5.0).clear  # stiffer altogether
    for suspicious in (stability.Screened(0.3, 1.0), stability.Screened(0.9, 50.0), stability.NOT_SCREENED):
        assert not suspicious.clear
        assert suspicious.chance == 1


def test_the_subset_that_is_counted_depends_on_the_parameters_only():
    points = np.random.default_rng(0).random((4000, 3))
    drawn = np.array([stability.draw(point) for point in points])
    assert drawn[7] == stability.draw(points[7].copy()) == stability.draw(points[5:8][2])
    counts, _ = np.histogram(drawn, 20, (0, 1))
    assert np.abs(counts - 200).max() < 60
    counted = (drawn < stability.Screened(1.0, 1.0).chance).mean()
    assert 0.02 < counted < 0.06


# --- bodies ----------------------------------------------------------------------------------------------------------


@pytest.mark.few(1)
@pytest.mark.fem
@pytest.mark.parametrize("name", ["column", "clamped block", "sideways cantilever", "mixed form", "follower pressure"])
def test_no_unstable_equilibrium_is_returned(name):
    found = buckling.samples(buckling.PROBLEMS[name](), 8, seed=3)
    assert any(one.negative > 0 for one in found), "nothing to find"
    assert any(one.returned == 0 for one in found)
    for one in found:
        assert one.returned <= 0
        if one.negative > 0:
            assert one.returned < 0 or one.stability == Stability.COUNTED
            assert not one.screened.clear  # nor would the screen alone have passed it
        if one.returned == 0:
            assert one.stability in {Stability.SCREENED, Stability.COUNTED}


@pytest.fixture(scope="module")
def column():
    problem = buckling.column()
    centre = linearise(problem.inputs, SerialEvaluate(problem.spec.build(MPI.COMM_SELF, problem.inputs.names)))
    return problem, centre


def changed(spec, **solver):
    # Near its first buckling load the column is soft: what a looser tolerance leaves of the residual moves it.
    return Hyperelastic.model_validate(spec.model_dump() | {"solver": {"tolerance": 1e-11} | solver})


@pytest.mark.slow
@pytest.mark.fem
def test_the_answer_does_not_depend_on_the_path(column):
    problem, centre = column
    spec, names = problem.spec, problem.inputs.names
    model, textbook, lenient = (
        changed(spec, **solver).build(MPI.COMM_SELF, names)
        for solver in ({}, {"kind": "newton"}, {"accept_unstable": True})
    )
    guess = centre.prediction.on(model)
    reference = guess(problem.inputs.mean).reference
    without = ReferenceSolution(reference.parameters, reference.state)  # no spread, so no screen
    for load, stable in ((85.0, True), (112.0, True), (123.0, True), (127.0, False), (145.0, False)):
        point = np.array([load])
        straight = np.array(lenient.solve(point, guess(point)).state)
        assert lenient.solve(point).stability == Stability.NOT_TESTED
        # Corrected and screened, corrected, a few corrections; Newton from the prediction, at the state, from zero.
        paths = (
            lambda p: model.solve(p, guess(p)),
            lambda p: model.solve(p, Guess(guess(p).state, without)),
            lambda p: model.solve(p, replace(guess(p), iterations=30)),
            lambda p: model.solve(p, Guess(guess(p).state)),
            lambda p, straight=straight: model.solve(p, Guess(straight)),
            model.solve,
            textbook.solve,
            lambda p: textbook.solve(p, Guess(guess(p).state, None, 20)),
        )
        for path in paths:
            if stable:
                solution = path(point)
                assert solution.stability in {Stability.SCREENED, Stability.COUNTED}
                np.testing.assert_allclose(solution.state, straight, rtol=0, atol=1e-8)
            else:
                with pytest.raises(
                    SolveError, match=r"unstable \(its stiffness has 2 negative eigenvalues\)"
                ) as refused:
                    path(point)
                assert refused.value.stability == Stability.REFUSED
    # A few iterations that are not enough for an equilibrium claim nothing.
    point = np.array([145.0])
    few = model.solve(point, replace(guess(point), iterations=1))
    assert (few.converged, few.stability) == (False, Stability.NOT_TESTED)


@pytest.mark.fem
def test_lanczos_takes_the_place_of_the_factor_for_counting_where_there_is_nothing_to_count(column, monkeypatch):
    problem, centre = column
    model = problem.spec.build(MPI.COMM_SELF, problem.inputs.names)
    guess = centre.prediction.on(model)
    monkeypatch.setattr(stability.Screened, "clear", property(lambda seen: True))
    monkeypatch.setattr(stability.Screened, "chance", property(lambda seen: 1.0))
    points = np.linspace(100, 140, 9)[:, None]
    found = list(model.solve_many(points, map(guess, points)))
    stable = [one for one in found if not isinstance(one, SolveError)]
    refused = [one for one in found if isinstance(one, SolveError)]
    assert 2 < len(refused) < 6
    for error in refused:
        assert error.stability == Stability.MISSED
        assert error.work.factorisations > 0
    for solution in stable:
        assert solution.stability == Stability.COUNTED
        assert solution.work.factorisations == 0
        solution.visit()
        assert model.equations.negative_eigenvalues(solution.state) == 0


@pytest.mark.fem
def test_what_a_derivative_sees_counts(column, monkeypatch):
    problem, centre = column
    model = problem.spec.build(MPI.COMM_SELF, problem.inputs.names)
    guess = centre.prediction.on(model)
    point = np.array([100.0])
    many = np.ones((5, 1))
    solution = model.solve(point, guess(point))
    assert solution.stability == Stability.SCREENED
    solution.state_tangent(many)
    assert solution.stability == Stability.COUNTED
    before = solution.work.factorisations
    solution.state_tangent(many)
    assert solution.work.factorisations == before
    # A screen that sees nothing, as a fault: derivatives and counting find what it misses.
    monkeypatch.setattr(stability.Screened, "clear", property(lambda seen: True))
    monkeypatch.setattr(stability.Screened, "chance", property(lambda seen: 0.0))
    beyond = np.array([140.0])
    wrong = model.solve(beyond, guess(beyond))
    assert wrong.stability == Stability.SCREENED
    with pytest.raises(SolveError, match="which a derivative has shown") as seen:
        wrong.state_tangent(many)
    assert seen.value.stability == Stability.MISSED
    monkeypatch.setattr(stability.Screened, "chance", property(lambda seen: 1.0))
    with pytest.raises(SolveError) as counted:
        model.solve(beyond, guess(beyond))
    assert counted.value.stability == Stability.MISSED


@pytest.mark.fem
@pytest.mark.parametrize(("load", "most"), [(124.6, 25), (145.0, 25)])
def test_what_a_refusal_costs_is_bounded(column, load, most):
    problem, centre = column
    model = problem.spec.build(MPI.COMM_SELF, problem.inputs.names)
    point = np.array([load])
    with pytest.raises(SolveError, match=r"^stopped at") as refused:
        model.solve(point, centre.prediction.on(model)(point))
    work = refused.value.work
    assert work.factorisations <= most
    # Where the branch ends is still said to a sixty-fourth of the load; the column buckles at 123 to 125 Pa.
    reached = float(re.match(r"stopped at ([\d.]+) %", refused.value.reason)[1])
    assert 123 / load - 1 / 64 < reached / 100 < 125 / load
    assert refused.value.history.count("load 1: " + refused.value.history[-1].partition(": ")[2]) <= 3


@pytest.mark.fem
def test_changes_of_the_stiffness_are_those_of_assembled_ones(column):
    problem, centre = column
    model = problem.spec.build(MPI.COMM_SELF, problem.inputs.names)
    reference = centre.prediction.on(model)(np.array([115.0])).reference
    factor, equations = model.reference.at(reference), model.equations
    spread, step = float(reference.spread[0]), 1e-3
    rows = np.random.default_rng(0).standard_normal((3, equations.size)) * equations.free_displacements
    slope = spread * factor.slopes()[0]
    assembled = np.zeros_like(rows)
    for h in (step, -step):
        state = reference.state + h * slope
        equations.set_parameters(reference.parameters + h * spread)
        equations.at_load(1.0)
        equations.set_state(state)
        matrix = equations.sparse_stiffness()
        R = factor.rotation(state)
        along = turn(rows, R) * equations.free_displacements
        assembled += turn((matrix @ along.T).T, R.swapaxes(0, 1)) / (2 * h)
    assembled *= equations.free_displacements
    (change,) = factor._changes(reference, np.random.default_rng(0))
    np.testing.assert_allclose(change(rows), assembled, rtol=0, atol=1e-3 * np.abs(assembled).max())


# --- what is said of it ----------------------------------------------------------------------------------------------


def evaluations(points, refused, known=None):
    n = len(points)
    codes = np.where(refused, Stability.REFUSED, Stability.SCREENED).astype(np.int8) if known is None else known
    failures = tuple(Failure(int(i), tuple(points[i]), "unstable") for i in np.flatnonzero(refused))
    outputs = np.where(refused, np.nan, 1.0)[:, None]
    zero = np.zeros(n)
    return Evaluations(
        points, outputs, None, failures, zero, np.zeros((n, 5), dtype=np.int64), zero, ~refused, codes, np.zeros((0, 0))
    )


UNITS = {"W": "J"}
CODES = "no-stable-state", "answers-missing"


@pytest.fixture(scope="module")
def inputs():
    return Inputs(buckling.uniform(loads_traction_size=(80, 150), material_C1=(0.5e4, 1.5e4)))


def test_where_a_branch_ends_is_found(inputs):
    points = inputs.points(random_points(0, 0, 200, 2))
    load, C1 = points.T
    for refused, expected in (
        (load > 120, r"all with loads.traction.size ≥ 120\.\d+, none with loads.traction.size ≤ 1(19|20)\.\d+"),
        (C1 < 7e3, r"all with material.C1 ≤ 69\d\d(\.\d)?, none with material.C1 ≥ 7\d\d\d"),
        (load / C1 > 1.3e-2, r"− 0\.\d+ |^all with .*material.C1"),
    ):
        found = list(failure_domain.findings(inputs, evaluations(points, refused), UNITS, continued=False))
        assert [(one.code, one.severity) for one in found] == [(code, "warning") for code in CODES]
        assert f"{refused.sum()} of 200 samples have no stable equilibrium" in found[0].text
        where = failure_domain.separated(inputs, points, refused, ~refused)
        assert re.search(expected, where), where
    one, _ = failure_domain.findings(inputs, evaluations(points, load > 120), UNITS, continued=True)
    assert one.severity == "error"
    assert "expansion" in one.text
    # A half-space of both parameters that no bound of one can tell.
    scaled = (points - inputs.mean) / inputs.std
    where = failure_domain.separated(inputs, points, scaled @ [1, -0.5] > 0.4, scaled @ [1, -0.5] <= 0.4)
    assert "loads.traction.size − 0." in where
    assert where.endswith(("have an answer", "has an answer")) or "none with" in where


def test_loads_that_follow_the_body_are_named():
    problem = buckling.follower()
    (note,) = problem.spec.findings
    assert note.severity == "note"
    assert "pressure follows the body" in note.text
    assert "flutter" in note.text
    assert not changed(problem.spec, accept_unstable=True).findings
    assert not buckling.column().spec.findings


def test_without_refusals_nothing_is_said(inputs):
    points = inputs.points(random_points(0, 0, 20, 2))
    none = np.zeros(20, dtype=bool)
    assert list(failure_domain.findings(inputs, evaluations(points, none), UNITS, continued=True)) == []
    untested = evaluations(points, none, np.zeros(20, dtype=np.int8))
    assert failure_domain.counts([untested]) == {}
    assert failure_domain.counts([evaluations(points, none)])["screened"] == 20


@pytest.mark.parametrize(
    ("continued", "words"), [(True, "The expansion continues"), (False, "missing from the estimates")]
)
def test_where_solves_failed_is_found(inputs, continued, words):
    points = inputs.points(random_points(0, 0, 60, 2))
    failed = points[:, 0] > 120
    states = evaluations(points, failed, np.zeros(60, dtype=np.int8))
    one, _ = failure_domain.findings(inputs, states, UNITS, continued=continued)
    assert one.severity == "warning"
    assert f"{failed.sum()} of 60 samples have no answer: all with loads.traction.size ≥ 12" in one.text
    assert words in one.text


def test_failures_here_and_there_have_no_bound(inputs):
    points = inputs.points(random_points(0, 0, 60, 2))
    failed = np.sin(37 * points[:, 0]) > 0.5
    said = failure_domain.separated(inputs, points, failed, ~failed)
    place = f"loads.traction.size = {points[failed][0, 0]:.5g}"
    assert said.startswith("no bound on the parameters separates them from the others; the first is at ")
    assert place in said
    by_chance = [np.random.default_rng(seed).permutation(60) < 3 for seed in range(40)]
    said = [failure_domain.separated(inputs, points, failed, ~failed) for failed in by_chance]
    told = sum(not one.startswith("no bound") for one in said)  # each of two kinds once in forty, by chance
    assert binom.sf(told - 1, 40, 2 / 40) > 1e-3


def test_what_is_missing_bounds_the_whole(inputs):
    """Where missing outputs lie in the range of the others, the mean and the median of all are where it says."""
    held, shares = [], []
    for seed in range(20):
        points = inputs.points(random_points(seed, 0, 100, 2))
        load, refused = points[:, 0], points[:, 0] > 130
        found = replace(evaluations(points, refused), outputs=np.where(refused, np.nan, abs(load - 115))[:, None])
        (one,) = [one for one in failure_domain.findings(inputs, found, {"u": "1"}, continued=False) if one.about]
        assert one.code == "answers-missing"
        ends = np.array(re.findall(r"[\d.]+", one.about[0].words), dtype=float).reshape(2, 2)
        held.append((ends[:, 0] <= 17.5) & (ends[:, 1] >= 17.5))
        shares.append(one.values["most"])
    assert np.all(binom.cdf(np.sum(held, axis=0), 20, 0.95) > 1e-3)
    assert binom.cdf(np.sum(np.array(shares) > 2 / 7), 20, 0.975) > 1e-3  # 20 of 70 Pa are missing


def test_what_the_screen_missed_is_an_error(inputs):
    points = inputs.points(random_points(0, 0, 20, 2))
    refused = np.arange(20) < 2
    known = np.where(refused, [Stability.MISSED], [Stability.SCREENED]).astype(np.int8)
    texts = list(failure_domain.findings(inputs, evaluations(points, refused, known), UNITS, continued=False))
    assert [one.code for one in texts] == [*CODES, "screen-missed"]
    assert texts[-1].severity == "error"
    assert "2 unstable equilibria" in texts[-1].text


def test_samples_get_what_is_known_of_them(inputs):
    points = inputs.points(random_points(0, 0, 4, 2))
    known = np.array([1, 2, 3, 2], dtype=np.int8)
    made = evaluations(points, known == 3, known)
    again = replace(made, stability=np.array([2, 2, 2, 1], dtype=np.int8))
    both = evaluations(np.vstack([points, points]), np.tile(known == 3, 2), np.append(known, again.stability))
    np.testing.assert_array_equal(failure_domain.by_sample(points[::-1], both), [1, 3, 2, 1])


@pytest.mark.fem
def test_a_study_says_it_all(tmp_path, undrawn):
    """The shared case of a column beyond buckling, coarser: exit 3, the error, counts, and a code for every sample."""
    import xarray as xr

    from workflows.__main__ import main

    study = tmp_path / "column.toml"
    study.write_text(
        """
        [model]
        kind = "hyperelastic"
        body = { kind = "box", size = [1.0, 0.1, 0.1], cells = [8, 1, 1], cell = "hexahedron", degree = 2 }
        material = { kind = "neo-hookean", C1 = 1e4, D1 = 1e5 }
        clamp = ["x-min"]
        loads = [{ kind = "traction", on = "x-max", direction = [-1, 0, 0], size = 115 }]
        outputs = [{ name = "umax", kind = "max-displacement" }, { name = "W", kind = "strain-energy" }]
        [parameters]
        "loads.traction.size" = { kind = "uniform", lower = 80, upper = 140 }
        [method]
        kind = "chaos"
        samples = 9
        fields = false
        """
    )
    assert main(["run", str(study), "--out", str(tmp_path / "out"), "--quiet"]) == 3
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    refused = summary["stability"]["refused"]
    assert refused > 0
    assert refused == summary["failed"]
    assert sum(summary["stability"].values()) == 10
    assert any(one["severity"] == "error" and "loads.traction.size ≥ 1" in one["text"] for one in summary["findings"])
    with xr.open_dataset(tmp_path / "out" / "results.nc", engine="h5netcdf") as data:
        assert (data["stability"].to_numpy() == Stability.REFUSED).sum() == refused
        assert data["points"].to_numpy()[data["stability"].to_numpy() == Stability.REFUSED].min() > 120
    report = (tmp_path / "out" / "report.html").read_text()
    assert "Stability of the states" in report
