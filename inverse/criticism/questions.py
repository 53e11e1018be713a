"""Questions to the shape: whether data call for what a model does not have, and what its answers would be with it.

Let A be the derivatives of the residuals r, over the errors, by the unknowns, and G those by strengths e of an
enlargement in one of its forms, of which N(0, I) is the prior. To first order at the mode the data are N(0, S) without
it, S = I + AAᵀ, and

    s = −Gᵀr ~ N(0, C),   C = GᵀS⁻¹G,   ln B = ½ sᵀ(C + I)⁻¹s − ½ ln det(C + I)

is the score, which the residuals at the mode hold since r = S⁻¹r₀, and what the enlargement adds to ln of the evidence
(C. R. Rao, Proc. Camb. Phil. Soc. 44 (1948) 50–57; C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for Machine
Learning (2006), section 2.7). The B of an enlargement is the mean over its forms. How large it becomes by chance is
seen from draws of s: the best of many places is a maximum, and no χ². All questions together are judged by the smallest
of their probabilities in the same draws (P. H. Westfall, S. S. Young, Resampling-Based Multiple Testing (1993), ch. 2).
Where residuals are larger than errors as stated make likely, probabilities are those of errors as large as they say:
errors that are understated call for nothing, and what explains most of the residuals is called for all the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.special import logsumexp

from forward.findings import Finding
from forward.model import FloatArray, ForwardModel, SolveError
from forward.readable import number
from inverse.criticism.finer import parameters_moved
from inverse.criticism.verdict import UNEXPLAINED, examine, spectrum_of
from inverse.low_dimensional.laplace import Laplace, deviations, laplace, unexplained
from inverse.low_dimensional.posterior import Density, Posterior, Wider, widened
from uq.evaluation.evaluate import ALL_AGAIN, Steps
from uq.evaluation.request import Evaluate

if TYPE_CHECKING:
    import xarray as xr

DRAWS = 4000  # of scores as they are by chance
CALLED = 0.05  # probability up to which data call for something
OPEN, SHOWN = 1.0, 3  # deviations that data leave open from which on that is told, and of how many
ROUNDS, SETTLED = 5, 0.05  # how often a form is moved at most, until it moves by fewer deviations
Forms = Mapping[str, Mapping[Any, FloatArray]]  # names of enlargements → their forms, which say it → patterns (k, N)


class Answer(NamedTuple):
    """What data say of an enlargement.

    Attributes
    ----------
    name, form
        What it is called, and the form that the data like best.
    probability
        That questions to a right model make one of them look as much called for by chance.
    log_evidence
        What it adds to ln Z: to first order, or by Laplace's Gaussian where data call for it.
    move, left
        By how much answers (d,) are larger with it, in their deviations, and the deviation of that: what the data do
        not tell of it.
    strengths, patterns
        Most probable strengths (k,) of that form, and its patterns (k, N).
    searched
        What the search among all forms costs: ln of the mean of B over them, over the largest.
    """

    name: str
    form: Any
    probability: float
    log_evidence: float
    move: FloatArray
    left: FloatArray
    strengths: FloatArray
    patterns: FloatArray
    searched: float


@dataclass(frozen=True, eq=False)
class Questions:
    """A model with d parameters, and N numbers behind them that are zero of a body without enlargements; and these.

    Attributes
    ----------
    model
        The model.
    forms
        Parameters (d,) → the enlargements there.
    having
        Names of parameters, strengths of patterns (k, N) behind the d of the model, and these → the model of these.
    fitted
        A form and its most probable strengths → the form as these move it, its patterns (k, N) there, and the means of
        their strengths (k,); None of forms that do not move.
    """

    model: ForwardModel
    forms: Callable[[FloatArray], Forms]
    having: Callable[[Sequence[str], FloatArray], Evaluate]
    fitted: Callable[[Any, FloatArray], tuple[Any, FloatArray, FloatArray] | None] = lambda form, strengths: None

    def changes(self, posterior: Posterior, point: FloatArray, patterns: FloatArray) -> FloatArray:
        """Return derivatives (k, M) of the outputs by strengths of patterns (k, N) at parameters (d,); collective.

        By tangents or by adjoints, whichever are fewer. Raises `SolveError` if the model has no answer.
        """
        guess = None if posterior.start is None else replace(posterior.start.on(self.model)(point), reference=None)
        solution, d = self.model.solve(np.append(point, np.zeros(patterns.shape[1])), guess), len(point)
        m = len(self.model.outputs)
        if len(patterns) <= m:
            return np.asarray(solution.tangent(np.pad(patterns, ((0, 0), (d, 0)))))
        return np.asarray(patterns @ solution.adjoint(np.eye(m))[:, d:].T)


def asked(
    posterior: Posterior, gaussian: Laplace, at: Density, questions: Questions, seed: int, steps: Steps = ALL_AGAIN
) -> list[Answer]:
    """Ask all questions, and solve for the posterior with each enlargement that data call for, which `steps` keep.

    Answers are NaN if the model has none at the mode.
    """
    try:
        found = answers(posterior, gaussian, at, questions, seed)
    except SolveError:
        none = np.full(len(posterior.inputs.names), np.nan)
        unknown = "no answer", np.nan, np.nan, none, none, np.zeros(0), np.zeros((0, 0)), np.nan
        return [Answer(name, *unknown) for name in questions.forms(at.parameters[0])]
    return [
        steps(f"with {one.name}", partial(_solved, posterior, gaussian, questions, one))
        if one.probability <= CALLED
        else one
        for one in found
    ]


def _solved(posterior: Posterior, gaussian: Laplace, questions: Questions, answer: Answer) -> Answer:
    """Return an answer with evidence and moves by Laplace's Gaussian with the enlargement, as Gauss–Newton has it.

    A form that can be moved is moved to where the data like it best; its evidence is then that over all places. To
    first order if the model has no answer there.
    """
    before, own = posterior.physical(gaussian.mode[None])[0, : len(posterior.inputs.names)], gaussian.log_evidence
    form, patterns, means, searched = answer.form, answer.patterns, np.zeros(len(answer.patterns)), answer.searched
    strengths, found = answer.strengths, answer

    def mode(patterns: FloatArray, means: FloatArray, strengths: FloatArray) -> tuple[Wider, Laplace]:
        """Search for the mode with strengths (k,) of patterns (k, N) too, of which the means beforehand are known."""
        names = [f"{answer.name}, strength {k}" for k in range(len(patterns))]
        wider = widened(
            posterior, gaussian.mode, names, strengths, lambda wanted: questions.having(wanted, patterns), means
        )
        return wider, laplace(wider.posterior, starts=1, exact=False, first=wider.first)

    for _ in range(ROUNDS):
        try:
            wider, end = mode(patterns, means, strengths)
        except SolveError:
            return found
        best = wider.posterior.physical(end.mode[None])[0]
        strengths, move = best[wider.new], (best[wider.own] - before) / deviations(posterior, gaussian)
        found = answer._replace(form=form, log_evidence=end.log_evidence - own + searched, move=move)
        moved = questions.fitted(form, strengths)
        if moved is None or (len(strengths) > 1 and np.abs(strengths[1:]).max() < SETTLED):
            break
        (form, patterns, means), searched = moved, 0.0
        strengths = np.append(strengths[0], np.zeros(len(means) - 1))
    return found


def answers(posterior: Posterior, gaussian: Laplace, at: Density, questions: Questions, seed: int) -> list[Answer]:
    """Ask all questions to a posterior, given it at its mode, with derivatives; collective over ranks of the model.

    Raises `SolveError` if the model has no answer at the mode.
    """
    noise, scale = posterior.noise, posterior.scale(at.x)[0]
    forms = questions.forms(at.parameters[0])
    flat = [(name, label, patterns) for name, by in forms.items() for label, patterns in by.items()]
    changes = questions.changes(posterior, at.parameters[0], np.concatenate([patterns for *_, patterns in flat]))
    residual, slopes = posterior.residuals(at.outputs, at.x)[0], posterior.sensitivities(at)[0]
    G = noise.whitened(changes[:, posterior.which] / scale)

    def scored(size: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """The root of C, scores, A and G with errors that are larger by a factor."""
        root = np.sqrt(noise.information(residual / size)) / size
        A, rows = slopes * root[:, None], G * root
        H = unexplained(A, rows)
        return np.linalg.qr(H.T)[1].T if len(H) < H.shape[1] else H, -G @ noise.score(residual / size) / size, A, rows

    H, scores, A, over = stated = scored(1.0)
    size = _understated(posterior, at, residual)
    larger, fewer, *_ = stated if size == 1 else scored(size)
    by_chance = np.random.default_rng(seed).standard_normal((DRAWS, H.shape[1])) @ larger.T
    moves = parameters_moved(posterior, gaussian, A, over.T) / deviations(posterior, gaussian)[:, None]
    ends = np.cumsum([len(patterns) for *_, patterns in flat])
    found = [
        _Form(
            label,
            *_evidence(H[rows], scores[rows]),
            *_evidence(larger[rows], np.vstack([fewer, by_chance])[:, rows])[:1],
            moves[:, rows],
            patterns,
        )
        for (_, label, patterns), end in zip(flat, ends, strict=True)
        for rows in [slice(end - len(patterns), end)]
    ]
    names = [name for name, *_ in flat]
    return _judged({name: [one for one, of in zip(found, names, strict=True) if of == name] for name in forms})


def _understated(posterior: Posterior, at: Density, residual: FloatArray) -> float:
    """Return the factor on the errors with which residuals (m,) at the mode are as expected; 1 if they may be."""
    test, size = examine(posterior.noise.normal_scores(residual), spectrum_of(posterior, at)), 1.0
    if test.probability < UNEXPLAINED:
        for _ in range(ROUNDS):  # of normal errors one is enough
            size *= float(np.linalg.norm(posterior.noise.normal_scores(residual / size)) / np.sqrt(test.degrees))
    return size


class _Form(NamedTuple):
    """One form: ln B () of the data, strengths (k,), their covariance (k, k), what it is judged by, moves, patterns.

    That is ln B (1 + n,) of the data, and by chance, with errors as large as residuals say; moves are (d, k).
    """

    label: Any
    log_evidence: float
    strengths: FloatArray
    covariance: FloatArray
    judged: FloatArray
    moves: FloatArray
    patterns: FloatArray


def _evidence(H: FloatArray, scores: FloatArray) -> tuple[Any, FloatArray, FloatArray]:
    """Return ln B of scores (…, k), and strengths with their covariance."""
    sizes, axes = np.linalg.eigh(H @ H.T)
    over = 1 / (1 + np.maximum(sizes, 0))
    covariance = (axes * over) @ axes.T
    return ((scores @ axes) ** 2 @ over + np.log(over).sum()) / 2, scores @ covariance, covariance


def _judged(found: Mapping[str, list[_Form]]) -> list[Answer]:
    """Return the answers to questions, by their names, from all their forms."""
    logs = {name: np.array([one.log_evidence for one in forms]) for name, forms in found.items()}
    total = {name: float(logsumexp(each) - np.log(len(each))) for name, each in logs.items()}
    judged = {name: logsumexp([one.judged for one in forms], axis=0) for name, forms in found.items()}
    chance = {name: values[1:] for name, values in judged.items()}
    # How many of the draws are at least as large, of each draw too; the smallest of these shares over the questions.
    ordered = {name: np.sort(values) for name, values in chance.items()}
    n = DRAWS + 1

    def share(name: str, values: FloatArray) -> FloatArray:
        return np.asarray(1 + DRAWS - np.searchsorted(ordered[name], values)) / n

    least = np.min([share(name, values) for name, values in chance.items()], axis=0)
    answered = []
    for name, forms in found.items():
        weights = np.exp(logs[name] - logsumexp(logs[name]))
        each = np.array([one.moves @ one.strengths for one in forms])
        move = weights @ each
        inside = np.array([np.einsum("dk,kl,dl->d", one.moves, one.covariance, one.moves) for one in forms])
        left = np.sqrt(weights @ (inside + (each - move) ** 2))
        alone = share(name, judged[name][:1])[0]
        probability = float((1 + (least <= alone).sum()) / n)
        best, searched = forms[int(weights.argmax())], total[name] - float(logs[name].max())
        known = (best.label, probability, total[name], move, left, best.strengths, best.patterns, searched)
        answered.append(Answer(name, *known))
    return answered


def findings_in(one: xr.Dataset) -> list[Finding]:
    """Return what the results of a data set say of questions: what data call for, and what they leave open."""
    parameters = [str(name) for name in one["parameter"].values]
    moves, left = (one[f"question_{name}"].transpose("question", "parameter").to_numpy() for name in ("move", "left"))
    names, forms = one["question"].values.tolist(), str(one["question_forms"].item()).split("; ")
    probability, gain = one["question_probability"].to_numpy(), one["question_log_evidence"].to_numpy()
    called = [k for k in np.argsort(-gain) if probability[k] <= CALLED]
    found, told = [], list[tuple[float, str]]()
    if called:
        k, others = called[0], called[1:]
        i = int(np.nanargmax(np.abs(moves[k])))
        also = "".join(f", or for {names[other]} (by {number(gain[other], 2)})" for other in others)
        values = {"question": names[k], "form": forms[k], "gain": number(gain[k], 2), "also": also}
        values |= {"answer": parameters[i], "size": abs(moves[k, i]), "way": "larger" if moves[k, i] > 0 else "smaller"}
        found.append(Finding("called-for", "warning", values | {"probability": probability[called].min()}))
    for k, name in enumerate(names):
        i = int(np.nan_to_num(left[k]).argmax())
        if k not in called and left[k, i] >= OPEN:
            told.append((left[k, i], f"{name}, {parameters[i]} by {number(left[k, i], 2)} deviations"))
    listed = "; ".join(text for _, text in sorted(told, reverse=True)[:SHOWN])
    return [*found, *([Finding("left-open", "note", {"listed": listed})] if listed else [])]
