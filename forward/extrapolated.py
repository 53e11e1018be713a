"""What finer and finer meshes tend to: a model on two meshes, from whose difference the rest is extrapolated.

Where the error of a mesh falls as h^p, and the cells of a fine mesh are t times smaller than those of a coarse one of
the same kind, what the fine one still misses is the difference ψ_f − ψ_c times 1/(t^p − 1) (L. F. Richardson, Phil.
Trans. R. Soc. A 226 (1927) 299–361). The difference itself is an output too: it says how far that may be wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import csr_matrix, identity, kron

from forward.combine import Joined, JoinedSolution, Rows
from forward.model import FloatArray, ForwardModel, Guess, OfOne, Solution, SolveError

Begun = tuple[tuple[FloatArray, FloatArray], ...]
# Where all cells are halved, errors at held faces fall slowly, whatever the degree: 1/(2^1.6 − 1).
HALVED = 0.5
TANGENTS = 20  # parameters up to which a state is predicted from the first one with its derivatives


def limit(model: ForwardModel, observed: csr_matrix, outputs: tuple[str, ...], share: float) -> Rows:
    """Return the model of what is observed in the limit of finer meshes.

    Parameters
    ----------
    model
        On a fine and a coarse mesh: its outputs (2m,) are those on the one and then those on the other.
    observed, outputs
        Weights (n, m) of the outputs in what is observed, and its names.
    share
        1/(t^p − 1).

    Returns
    -------
    Rows
        With 2n outputs: ψ_f + share (ψ_f − ψ_c), and then ψ_f − ψ_c.
    """
    names = (*outputs, *(f"{name} (between the meshes)" for name in outputs))
    one = identity(len(outputs))
    gaps = Rows(model, kron([[1, 0], [1, -1]], observed, format="csr"), names)
    return Rows(gaps, kron([[1, share], [0, 1]], one, format="csr"), names)


@dataclass(frozen=True)
class Otherwise(OfOne):
    """A model, and another one where it has no answer."""

    model: ForwardModel
    other: ForwardModel

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> Solution:
        """Solve at `parameters` (d,).

        Raises
        ------
        SolveError
            Where neither has an answer.
        """
        try:
            return self.model.solve(parameters)
        except SolveError:
            return self.other.solve(parameters)


@dataclass(frozen=True)
class FromStart(OfOne):
    """Models whose solves begin at what the linearisation at a start predicts.

    Parameters
    ----------
    model
        The models.
    start
        Parameters (d,) that are solved for first; None: every solve begins at rest.
    begun
        States there, and their derivatives, once they are known, or why there are none; models of the same meshes share
        it.
    needed
        Whether there is no answer anywhere without one at the start: then searches end at once, which may take minutes.
    """

    model: Joined
    start: FloatArray | None = None
    begun: list[Begun | SolveError] = field(default_factory=list)
    needed: bool = False

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> JoinedSolution:
        """Solve at `parameters` (d,).

        Raises
        ------
        SolveError
            Where there is no answer.
        """
        if self.start is None:
            return self.model.solve(parameters)
        if not self.begun:
            at_start = np.array_equal(parameters, self.start)
            try:
                here = self._begin(self.start)
            except SolveError as error:
                self.begun.append(error)
                if at_start:
                    raise
            else:
                if at_start:
                    return here
        begun = self.begun[0]
        if not isinstance(begun, SolveError):
            step = parameters - self.start
            guesses = [Guess(state + step @ slopes if slopes.size else state) for state, slopes in begun]
            return self.model.solve_each(parameters, guesses)
        if self.needed:
            raise begun
        return self.model.solve(parameters)

    def _begin(self, start: FloatArray) -> JoinedSolution:
        """Solve at the start, once, and keep the states with their derivatives."""
        d, found = len(start), self.model.solve(start)
        few = d <= TANGENTS and self.differentiable
        kept = ((one.state, one.state_tangent(np.eye(d)) if few else np.zeros((d, 0))) for one in found.solutions)
        self.begun.append(tuple(kept))
        return found
