"""Evaluation in blocks: order, failures, restart."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from forward.materials.material_point import HomogeneousModel, MaterialTest
from forward.model import ModelError, SolveError
from forward.pointwise import FunctionModel
from uq.evaluation.block import merge
from uq.evaluation.checkpoint import HEAD, Checkpoint, DamagedError, _put, _write
from uq.evaluation.checkpoint import load as load_evaluations
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.hdf5 import image, in_memory
from uq.evaluation.request import BLOCKS, OWN, ROWS, Evaluations, Request, calibration
from uq.inputs.distributions import Uniform
from uq.inputs.random_parameters import Inputs
from uq.methods.chaos import Chaos
from uq.methods.monte_carlo import MonteCarlo
from uq.methods.quasi_monte_carlo import QuasiMonteCarlo


def product(p):
    if p[0] > 0.9:
        message = "too stiff"
        raise SolveError(message, ["iteration 0"])
    return [p[0] * p[1], p[0]]


MODEL = FunctionModel(product, ("a", "b"), ("ab", "a"), lambda p: [[p[1], p[0]], [1, 0]])
POINTS = np.random.default_rng(0).random((1000, 2))


def test_rows_are_in_the_order_of_the_points():
    evaluations = SerialEvaluate(MODEL)(Request(POINTS, tangents=True))
    ok = POINTS[:, 0] <= 0.9
    np.testing.assert_array_equal(evaluations.ok, ok)
    np.testing.assert_array_equal(evaluations.outputs[ok, 0], POINTS[ok].prod(axis=1))
    np.testing.assert_array_equal(evaluations.tangents[ok, 0], POINTS[ok][:, ::-1])


@pytest.mark.unit
def test_failures_are_kept_with_their_reason():
    evaluations = SerialEvaluate(MODEL)(Request(POINTS))
    assert len(evaluations.failures) == (POINTS[:, 0] > 0.9).sum()
    for failure in evaluations.failures:
        assert failure.reason == "too stiff"
        assert failure.history == ("iteration 0",)
        assert failure.parameters == tuple(POINTS[failure.index])
        assert np.isnan(evaluations.outputs[failure.index]).all()


@pytest.mark.unit
def test_arrays_are_kept_by_their_names(tmp_path):
    """Two blocks are joined, written, read: each array is what it was, also those with names of their own."""
    known = np.zeros(200, calibration(2))
    for number, name in enumerate(known.dtype.names):
        known[name] = number + np.random.default_rng(number).random(known[name].shape)
    whole = SerialEvaluate(MODEL)(Request(POINTS[:200], tangents=True))
    whole = replace(whole, mesh_errors=whole.outputs / 7, saturations=known)
    parts = [
        Evaluations.of({name: rows[some] for name, rows in whole.rows.items()}, failures, whole.fields)
        for some, failures in (
            (slice(120), [one for one in whole.failures if one.index < 120]),
            (slice(120, None), [replace(one, index=one.index - 120) for one in whole.failures if one.index >= 120]),
        )
    ]
    checkpoint = Checkpoint(tmp_path, "study")
    checkpoint.save("joined", merge(parts))
    found = checkpoint.find("joined")
    assert found.rows.keys() == whole.rows.keys() == set(ROWS)
    for name, rows in whole.rows.items():
        np.testing.assert_array_equal(found.rows[name], rows)
        assert found.rows[name].dtype == rows.dtype
    assert found.failures == whole.failures != ()


@pytest.mark.unit
def test_residuals_are_kept(tmp_path):
    request = Request(POINTS[:200], iterations=3)
    evaluations = SerialEvaluate(MODEL)(request)
    ok = POINTS[:200, 0] <= 0.9
    np.testing.assert_array_equal(evaluations.residuals, np.where(ok, 0.0, np.nan))
    np.testing.assert_array_equal(evaluations.converged, ok)
    checkpoint = Checkpoint(tmp_path, "study")
    assert checkpoint.key(request) != checkpoint.key(replace(request, iterations=4))
    checkpoint.save("block", evaluations)
    found = checkpoint.find("block")
    np.testing.assert_array_equal(found.residuals, evaluations.residuals)
    np.testing.assert_array_equal(found.converged, evaluations.converged)


@pytest.mark.unit
@pytest.mark.parametrize("n", [1, 2, BLOCKS, BLOCKS + 1, 10_000])
def test_blocks_cover_all_points_in_order(n):
    points = np.arange(n, dtype=float)[:, None]
    blocks = Request(points).blocks()
    assert len(blocks) <= BLOCKS
    np.testing.assert_array_equal(np.concatenate([block.points for block in blocks]), points)
    assert len(Request(points).blocks(n)) == n


@pytest.mark.unit
def test_points_that_begin_from_predictions_go_in_company():
    points, start = np.zeros((10_000, 1)), object()
    largest = [
        max(len(one.points) for one in Request(points[:n], start=start, company=64).blocks()) for n in (100, 10_000)
    ]
    assert largest == [6, 79]  # no fewer than 16 blocks, no more than 128
    assert max(len(one.points) for one in Request(points[:400], start=start).blocks()) == 16


@pytest.mark.unit
def test_what_a_model_evaluates_at_once_is_in_one_block():
    model = HomogeneousModel("neo-hookean", {}, [MaterialTest(mode="uniaxial", at=(1.1, 1.3))], ("C1",))
    points = np.linspace(1.0, 2.0, 100)[:, None]
    blocks = Request(points).of(model, OWN).blocks()
    assert [len(block.points) for block in blocks] == [64, 36]
    assert len(Request(points).of(MODEL, OWN).blocks()) == 100
    found = SerialEvaluate(model)(Request(points, tangents=True))
    np.testing.assert_array_equal(found.outputs, model.stresses(points))
    np.testing.assert_allclose(found.tangents[:, :, 0] * points, found.outputs, rtol=1e-12)  # linear in C1


@pytest.mark.unit
def test_checkpoint_returns_what_was_saved(tmp_path):
    checkpoint = Checkpoint(tmp_path, "study")
    request = Request(POINTS[:8], tangents=True)
    evaluations = SerialEvaluate(MODEL)(request)
    key = checkpoint.key(request)
    assert not checkpoint.has(key)
    checkpoint.save(key, evaluations)
    assert checkpoint.has(key)
    found = checkpoint.find(key)
    np.testing.assert_array_equal(found.outputs, evaluations.outputs)
    np.testing.assert_array_equal(found.tangents, evaluations.tangents)
    assert found.failures == evaluations.failures
    checkpoint.consolidate({"/": evaluations})
    checkpoint.clear()
    assert not (tmp_path / "evaluations").exists()
    np.testing.assert_array_equal(load_evaluations(tmp_path / "evaluations.h5").outputs, evaluations.outputs)


@pytest.mark.unit
def test_a_damaged_block_is_computed_again(tmp_path):
    checkpoint = Checkpoint(tmp_path, "study")
    request = Request(POINTS[:8])
    key = checkpoint.key(request)
    checkpoint.save(key, SerialEvaluate(MODEL)(request))
    path = tmp_path / "evaluations" / f"{key}.block"
    path.write_bytes(path.read_bytes()[:100])
    assert not checkpoint.has(key)
    assert not path.exists()


def test_a_flipped_bit_anywhere_is_found(tmp_path, capsys):
    checkpoint = Checkpoint(tmp_path, "study")
    request = Request(POINTS[:8], tangents=True)
    key = checkpoint.key(request)
    whole = SerialEvaluate(MODEL)(request)
    checkpoint.save(key, whole)
    path = tmp_path / "evaluations" / f"{key}.block"
    content = path.read_bytes()
    for place in np.random.default_rng(1).integers(8 * len(content), size=300):
        damaged = bytearray(content)
        damaged[place // 8] ^= 1 << place % 8
        path.write_bytes(damaged)
        head = 64 <= place // 8 < 512  # what nobody reads
        assert checkpoint.has(key) == head
        assert capsys.readouterr().err == (
            "" if head else f"{path}: damaged, or not what it is named after; computed again\n"
        )


@pytest.mark.unit
def test_exchanged_blocks_are_found(tmp_path, capsys):
    checkpoint = Checkpoint(tmp_path, "study")
    requests = [Request(POINTS[:8]), Request(POINTS[8:16])]
    keys = [checkpoint.key(request) for request in requests]
    for key, request in zip(keys, requests, strict=True):
        checkpoint.save(key, SerialEvaluate(MODEL)(request))
    one, two = (tmp_path / "evaluations" / f"{key}.block" for key in keys)
    one.rename(tmp_path / "other")
    two.rename(one)
    (tmp_path / "other").rename(two)
    assert [checkpoint.has(key) for key in keys] == [False, False]
    assert len(capsys.readouterr().err.splitlines()) == 2


@pytest.mark.unit
@pytest.mark.parametrize("name", ["points", "residuals", "work"])
def test_a_file_without_one_of_the_arrays_is_damaged(tmp_path, name):
    """One whose checksum is right."""
    path = tmp_path / "evaluations.h5"
    with in_memory(HEAD) as file:
        _put(file, SerialEvaluate(MODEL)(Request(POINTS[:5])))
        del file[name]
        _write(path, image(file))
    with pytest.raises(DamagedError):
        load_evaluations(path)


@pytest.mark.unit
def test_damage_of_all_evaluations_is_found(tmp_path):
    evaluations = SerialEvaluate(MODEL)(Request(POINTS[:8]))
    Checkpoint(tmp_path, "study").consolidate({"a/b": evaluations, "c": evaluations})
    path = tmp_path / "evaluations.h5"
    assert load_evaluations(path, "c").failures == evaluations.failures
    with pytest.raises(DamagedError):
        load_evaluations(path, "d")
    with h5py.File(path, "r+") as file:
        file["a/b/outputs"][0, 0] += 1e-12
    with pytest.raises(DamagedError, match=r"evaluations.h5: damaged"):
        load_evaluations(path, "c")


@pytest.mark.unit
def test_a_block_is_found_by_what_was_asked(tmp_path):
    checkpoint = Checkpoint(tmp_path, "study")
    request = Request(POINTS[:8])
    key = checkpoint.key(request)
    assert key == checkpoint.key(Request(np.asfortranarray(POINTS[:8])))
    assert key != checkpoint.key(replace(request, tangents=True))
    assert key != checkpoint.key(Request(POINTS[:8] + 1e-15))
    assert key != Checkpoint(tmp_path, "another study").key(request)


@pytest.mark.unit
def test_wrong_number_of_outputs_is_the_callers_mistake():
    model = FunctionModel(lambda p: p, ("a",), ("x", "y"))
    with pytest.raises(ValueError, match="expected"):
        SerialEvaluate(model)(Request(np.ones((1, 1))))


@pytest.mark.unit
def test_values_that_are_not_finite_are_failures():
    model = FunctionModel(lambda p: np.inf, ("a",), ("x",))
    assert len(SerialEvaluate(model)(Request(np.ones((3, 1)))).failures) == 3


@pytest.mark.unit
@pytest.mark.parametrize("scale", [1e-200, 1e-90, 1e90, 1e200])
@pytest.mark.parametrize("kind", [MonteCarlo, QuasiMonteCarlo, Chaos])
def test_outputs_of_which_no_moments_are_numbers_are_refused(kind, scale):
    """Standard deviations of 0 ± 0, and tracebacks: squares and fourth powers vanish or overflow."""
    inputs = Inputs({"a": Uniform(lower=1.0, upper=2.0)})
    model = FunctionModel(lambda p: [scale * p[0], p[0]], ("a",), ("y", "z"), lambda p: [[scale], [1.0]])
    with pytest.raises(ModelError, match="output y is of size"):
        kind(samples=32).run(inputs, SerialEvaluate(model))


@pytest.mark.unit
@pytest.mark.parametrize("scale", [1e-59, 1e59])
def test_other_outputs_are_estimated_whatever_their_size(scale):
    inputs = Inputs({"a": Uniform(lower=1.0, upper=2.0)})

    def model(s):
        return FunctionModel(lambda p: [s * p[0] ** 2], ("a",), ("y",), lambda p: [[2 * s * p[0]]])

    one, other = (QuasiMonteCarlo(samples=32).run(inputs, SerialEvaluate(model(s))) for s in (1.0, scale))
    for name in ("mean", "mean_error", "std", "std_error", "variance_ratio"):
        power = 0 if name == "variance_ratio" else 1
        assert other[name].item() == pytest.approx(one[name].item() * scale**power, rel=1e-9)
