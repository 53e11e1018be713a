"""The model of a study as a server of the UM-Bridge protocol, version 1.0: outputs and derivatives by HTTP.

There is one model, `forward`, with one vector of parameters (the random ones of the study, in their order) and one of
outputs. Requests wait for each other: answers are computed one at a time, in the thread that made the model.
"""

from __future__ import annotations

import json
import signal
import sys
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import replace
from queue import Empty, SimpleQueue
from threading import Thread
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pydantic import FiniteFloat, TypeAdapter, ValidationError

from forward.external.models import PROTOCOL
from forward.model import FloatArray, ForwardModel, Guess, ModelError, Solution, SolveError, displacements
from forward.settings import nearest, shown
from uq.evaluation.evaluate import SerialEvaluate
from uq.surrogates.linearisation import linearise
from workflows.http import RefusalError, Server, listen

if TYPE_CHECKING:
    from forward.spec import ModelSpec
    from uq.inputs.random_parameters import Inputs
    from workflows.studies.study import Sampled

NAME = "forward"
OPTIONS = ("level", "tolerance")
WAKE = 1.0  # seconds after which an idle server looks for signals
KEPT = 4  # models of different options
MOST_UNKNOWNS = 2_000_000  # of a mesh that a request may ask for
NUMBERS, OPTIONS_BY_NAME = TypeAdapter(list[FiniteFloat]), TypeAdapter(dict[str, Any])
STEP = 1e-3  # of differences of gradients, in standard deviations of the parameters


class Service:
    """What the server answers of a model, to requests as the protocol has them.

    Distributions of the parameters only determine where the solver starts and how large a difference is.
    """

    def __init__(self, sampled: Sampled) -> None:
        self._inputs, self._spec = sampled
        self._made: dict[str, _Solver] = {}
        self.parameters = sampled.inputs.names
        self.outputs = tuple(output.name for output in sampled.spec.returned)
        self._differentiable = self._solver({}).model.differentiable

    def answer(self, what: str, question: dict[str, Any]) -> dict[str, Any]:
        """Answer a request, such as "Evaluate" with its fields.

        A RefusalError says that it is not of the protocol, or that the model has no answer.
        """
        if what == "Info":
            return {"protocolVersion": PROTOCOL, "models": [NAME]}
        answers: dict[str, Callable[[dict[str, Any]], Any]] = {
            "Evaluate": self._evaluate,
            "Gradient": self._gradient,
            "ApplyJacobian": self._jacobian,
            "ApplyHessian": self._hessian,
        }
        if what not in {*answers, "ModelInfo", "InputSizes", "OutputSizes"}:
            raise RefusalError(f"{shown(what)} is not of the protocol", "UnsupportedFeature", 404)
        if question.get("name") != NAME:
            raise RefusalError(f"there is no model {shown(question.get('name'))}, expected '{NAME}'", "ModelNotFound")
        if what == "ModelInfo":
            return {"support": {"Evaluate": True} | dict.fromkeys(list(answers)[1:], self._differentiable)}
        if what == "InputSizes":
            return {"inputSizes": [len(self.parameters)]}
        if what == "OutputSizes":
            return {"outputSizes": [len(self.outputs)]}
        if what != "Evaluate" and not self._differentiable:
            raise RefusalError("the model has no derivatives", "UnsupportedFeature")
        try:
            return {"output": answers[what](question)}
        except SolveError as error:
            raise RefusalError(str(error), "SolveError", 500) from error

    def _evaluate(self, question: dict[str, Any]) -> list[list[float]]:
        return [self._solver(question).at(self._point(question)).outputs.tolist()]

    def _gradient(self, question: dict[str, Any]) -> list[float]:
        point, weights = self._point(question), _numbers(question.get("sens"), "sens", len(self.outputs))
        _first(question, "inWrt", "outWrt")
        return list(self._solver(question).at(point).adjoint(weights).tolist())

    def _jacobian(self, question: dict[str, Any]) -> list[float]:
        point, direction = self._point(question), _numbers(question.get("vec"), "vec", len(self.parameters))
        _first(question, "inWrt", "outWrt")
        return list(self._solver(question).at(point).tangent(direction).tolist())

    def _hessian(self, question: dict[str, Any]) -> list[float]:
        """Central difference of gradients, each from the factor at its own solution."""
        point, weights = self._point(question), _numbers(question.get("sens"), "sens", len(self.outputs))
        direction = _numbers(question.get("vec"), "vec", len(self.parameters))
        _first(question, "inWrt1", "inWrt2", "outWrt")
        length = np.abs(direction / self._inputs.std).max()
        if length == 0:
            return [0.0] * len(point)
        step = STEP / length * direction
        solver = self._solver(question)
        ahead, behind = (solver.exactly_at(point + sign * step).adjoint(weights) for sign in (1, -1))
        return list(((ahead - behind) * length / (2 * STEP)).tolist())

    def _point(self, question: dict[str, Any]) -> FloatArray:
        match question.get("input"):
            case [vector]:
                return _numbers(vector, "input[0]", len(self.parameters))
            case _:
                raise RefusalError(f"input: expected one vector of {len(self.parameters)} numbers, in a list")

    def _solver(self, question: dict[str, Any]) -> _Solver:
        """The model with the options of a request."""
        try:
            options = OPTIONS_BY_NAME.validate_python(question.get("config") or {})
        except ValidationError:
            raise RefusalError("config: expected options by name") from None
        for option in options:
            if option not in OPTIONS:
                raise RefusalError(f"config.{option[:40]}: unknown option; {nearest(option[:40], OPTIONS)}")
        key = json.dumps(options, sort_keys=True)
        if key not in self._made:
            made = _Solver(self._inputs, self._specified(options))
            while len(self._made) >= KEPT:
                del self._made[next(iter(self._made))]
            self._made[key] = made
        return self._made[key]

    def _specified(self, options: dict[str, Any]) -> ModelSpec:
        """Return the specification of the model with options."""
        model = self._spec
        if not options:
            return model
        if not model.meshed:
            raise RefusalError(f"config: a model of kind '{model.kind}' has no options")
        level = options.get("level", 0)
        said = f"config.level: {shown(level)}, expected"
        if type(level) is not int or level < 0 or (level > 0 and model.coefficients):
            raise RefusalError(f"{said} a number of refinements, and 0 where there are random fields")
        if level > 0 and 8 ** min(level, 20) * model.unknowns > MOST_UNKNOWNS:
            raise RefusalError(f"{said} a mesh of at most {MOST_UNKNOWNS:,} unknowns")
        try:
            refined = model.refined(level)
            return refined.solved_to(options["tolerance"]) if "tolerance" in options else refined
        except ValidationError as error:
            message = f"config: {error.errors()[0]['msg']}"
        except ModelError as error:  # meshes that are divided towards boundaries have no finer ones
            message = f"config.level: {error}"
        raise RefusalError(message)


class _Solver:
    """A model whose solves start from the tangent at the mean parameters, if possible."""

    def __init__(self, inputs: Inputs, spec: ModelSpec) -> None:
        from mpi4py import MPI

        self.model: ForwardModel = spec.build(MPI.COMM_SELF, inputs.names)
        self._guess: Callable[[FloatArray], Guess] | None = None
        self._last: tuple[bytes, Solution] | None = None
        if displacements(self.model):
            with suppress(SolveError):  # or else every solve starts from zero
                prediction = linearise(inputs, SerialEvaluate(self.model)).prediction
                self._guess = None if prediction is None else prediction.on(self.model)

    def at(self, point: FloatArray) -> Solution:
        """Solve, unless that is where the last solution was."""
        if self._last is None or self._last[0] != point.tobytes():
            solution = self.model.solve(point, None if self._guess is None else self._guess(point))
            self._last = point.tobytes(), solution
        return self._last[1]

    def exactly_at(self, point: FloatArray) -> Solution:
        """Solve such that derivatives come from a separate factor."""
        return self.model.solve(point, None if self._guess is None else replace(self._guess(point), reference=None))


def _numbers(given: Any, key: str, length: int) -> FloatArray:
    try:
        found = NUMBERS.validate_python(given, strict=True)
    except ValidationError:
        found = []
    if len(found) != length:
        raise RefusalError(f"{key}: expected {length} finite numbers")
    return np.array(found)


def _first(question: dict[str, Any], *keys: str) -> None:
    """Refuse other vectors than the first: there is only one of parameters, and one of outputs."""
    for key in keys:
        if question.get(key) != 0:
            raise RefusalError(f"{key}: {shown(question.get(key))}, expected 0")


def _settle(job: _Job, service: Service) -> None:
    """Answer a request, or say why there is no answer."""
    try:
        job.future.set_result(service.answer(job.what, job.question))
    except KeyboardInterrupt:
        job.future.set_exception(RefusalError("the server was interrupted", "Interrupted", 503))
        raise
    except RefusalError as refusal:
        job.future.set_exception(refusal)
    except ModelError as error:
        job.future.set_exception(RefusalError(str(error), "ModelError", 500))
    except Exception as error:  # the next request may succeed
        traceback.print_exc()
        job.future.set_exception(RefusalError(str(error), type(error).__name__, 500))


def serve(sampled: Sampled, port: int, host: str = "127.0.0.1", *, quiet: bool = False) -> int:
    """Serve the model of a study until the process is interrupted; return the number of answers that were computed.

    Port 0 is any free one, a StudyError says that another is taken; host 0.0.0.0 also accepts requests of other
    machines. A ModelError says that the model cannot be made.
    """
    jobs: SimpleQueue[_Job] = SimpleQueue()

    def ask(what: str, question: dict[str, Any]) -> dict[str, Any]:
        job = _Job(Future(), what, question)
        jobs.put(job)
        return job.future.result()

    server = Server(host, listen(host, port, "--port"), ask)
    previous = signal.signal(signal.SIGTERM, signal.default_int_handler)
    answered, listening = 0, None
    try:
        service = Service(sampled)
        if not quiet:
            sys.stdout.write(
                f"serving '{NAME}' at http://{host}:{server.server_address[1]}, until interrupted\n"
                f"input       {', '.join(service.parameters)}\noutput      {', '.join(service.outputs)}\n"
            )
            sys.stdout.flush()
        listening = Thread(target=server.serve_forever, daemon=True)
        listening.start()
        while True:
            try:
                job = jobs.get(timeout=WAKE)
            except Empty:  # by waking, signals are heard that came just as the wait began
                continue
            _settle(job, service)
            answered += 1
    except KeyboardInterrupt:
        if not quiet:
            sys.stdout.write(f"interrupted after {answered} requests\n")
        if listening is not None:
            server.shutdown()
        return answered
    finally:
        server.server_close()
        signal.signal(signal.SIGTERM, previous)


class _Job(NamedTuple):
    """A request on its way to the solving thread."""

    future: Future[dict[str, Any]]
    what: str
    question: dict[str, Any]
