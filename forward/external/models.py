"""Specifications of models outside this program: a Python function, or a server that speaks UM-Bridge.

UM-Bridge: L. Seelinger et al., J. Open Source Softw. 8 (2023) 4748; protocol 1.0.

Functions and servers share this file because only the way a point is evaluated differs.
"""

from __future__ import annotations

import json
import signal
import threading
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Annotated, Any, Literal, NoReturn

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from forward.external.own_modules import imported
from forward.machine import MIB, StopError, headroom, out_of_memory, reason_to_stop
from forward.model import FloatArray, ModelError, SolveError
from forward.pointwise import FunctionModel, real
from forward.scalars import Ranges, Scalar
from forward.settings import Settings, Sized, nearest, written_out
from forward.spec import ModelSpec

SECONDS_TO_ANSWER = 30.0  # for questions that need no solve
PROTOCOL = 1.0
LITTLE = 1024 * MIB  # memory left, below which a message mentions it
MISUSED = ("InvalidInput", "UnsupportedFeature", "ModelNotFound")  # errors of a server at any parameters
AGAIN = 0.5  # seconds after which code that swallowed the exception is interrupted again


class Value(Settings):
    """An output of an external model.

    Parameters
    ----------
    name
        Its name in results.
    unit
        Its unit, for display.
    """

    name: str = Field(min_length=1)
    unit: str = "1"


def _named(given: Any) -> Any:
    return {"name": given} if isinstance(given, str) else given


def _values(given: Any) -> Any:
    """Write out vectors among values: x = [0.1, 0.2], or x = { size = 64, value = 0.1 }."""
    if not isinstance(given, dict):
        return given
    lists = {name: {"size": len(one), "value": one} for name, one in given.items() if isinstance(one, list | tuple)}
    found = written_out({**given, **lists})
    return {
        name: one.get("value", 0.0) if isinstance(one, dict) and one.keys() <= {"value"} else one
        for name, one in found.items()
    }


Output = Annotated[Value, BeforeValidator(_named, json_schema_input_type=Value | str)]


class _External(ModelSpec):
    """A map from d numbers to m outputs, without a mesh.

    Parameters
    ----------
    parameters
        Values of all d parameters by name, in the order in which the model takes them; the random parameters of a
        study replace them. A vector is x = [0, 0, 0] or x = { size = 3, value = 0 }: x.0, x.1, x.2.
    outputs
        The m outputs in order: names, or blocks with `name`, `unit`, and `size` if it is a vector.
    solve_seconds
        Time limit (s, wall clock) for one evaluation, after which it counts as failed; None by default.
    """

    kind: str
    solve_seconds: Annotated[float, Field(gt=0)] | None = None
    parameters: Annotated[
        dict[Annotated[str, Field(pattern=r"^\S+$")], float],
        Field(min_length=1),
        BeforeValidator(_values, json_schema_input_type=dict[str, float | tuple[float, ...] | Sized]),
    ]
    outputs: Annotated[
        tuple[Output, ...],
        Field(min_length=1),
        BeforeValidator(written_out, json_schema_input_type=tuple[Value | str | Sized, ...]),
    ]

    @property
    def scalars(self) -> dict[str, Scalar]:
        return {name: Scalar(value) for name, value in self.parameters.items()}

    @abstractmethod
    def functions(self) -> tuple[Callable[[FloatArray], Any], Callable[[FloatArray], Any] | None]:
        """Return the map from all parameters (d,) to outputs (m,), and its Jacobian (m, d) if there is one.

        Raises
        ------
        ModelError
            If the model cannot be found.
        """

    def described(self, ranges: Ranges) -> Iterator[tuple[str, str]]:
        """Find the model and describe it; the time of a solve is unknown."""
        _, jacobian = self.functions()
        yield "model", f"{self.description}; {'with' if jacobian else 'without'} derivatives"

    def build(self, comm: Any, parameters: tuple[str, ...]) -> FunctionModel:
        """Find the model and make it a function of some of its parameters; the others keep their values."""
        function, jacobian = self.functions()
        names, nominal = list(self.parameters), np.array(list(self.parameters.values()))
        places = [names.index(name) for name in parameters]
        m = len(self.outputs)

        def whole(point: FloatArray) -> FloatArray:
            vector = nominal.copy()
            vector[places] = point
            return vector

        def slopes(point: FloatArray) -> FloatArray:
            assert jacobian is not None
            found = real(jacobian(whole(point)), "jacobian")
            if found.size != m * len(names) or (found.shape != (m, len(names)) and 1 not in {m, len(names)}):
                raise ModelError(f"model.jacobian: returned shape {found.shape}, expected ({m}, {len(names)})")
            return found.reshape(m, len(names))[:, places]

        return FunctionModel(
            lambda point: function(whole(point)),
            parameters,
            tuple(output.name for output in self.outputs),
            None if jacobian is None else slopes,
        )

    @model_validator(mode="after")
    def _check_names(self) -> _External:
        for name, count in Counter(output.name for output in self.outputs).items():
            if count > 1:
                raise ValueError(f"{count} outputs have the name '{name}', expected different names")
        return self


Dotted = Annotated[str, Field(pattern=r"^[^\W\d]\w*(\.[^\W\d]\w*)+$")]


class PythonModel(_External):
    """A Python function of a vector of parameters (d,) that returns the outputs (m,).

    If it raises an exception, or returns values that are not finite, the solve has failed. Modules are looked up on
    Python's path, beside the study, and in the working directory; one that is found in several of these is refused.
    All modules that they import and that are not installed count as the model's source: results are not continued once
    one has changed. Data files that they read are not tracked: when these change, change a module too.

    Parameters
    ----------
    function
        Dotted path, such as ``beam.tip``.
    jacobian
        Dotted path of the derivatives: (d,) → (m, d). Without it, methods that need derivatives refuse the model.
    parameters, outputs
        Names, as in every external model.
    solve_seconds
        Time limit (s) for one call; code that does not return to Python is not interrupted.
    """

    kind: Literal["python"] = "python"
    function: Dotted
    jacobian: Dotted | None = None

    @property
    def description(self) -> str:
        return f"Python function {self.function}{f', derivatives {self.jacobian}' if self.jacobian else ''}"

    @property
    def modules(self) -> tuple[str, ...]:
        return tuple(path.rpartition(".")[0] for path in (self.function, self.jacobian) if path)

    def functions(self) -> tuple[Callable[[FloatArray], Any], Callable[[FloatArray], Any] | None]:
        names, seconds = tuple(self.parameters), self.solve_seconds
        function = _guarded(self.function, "function", names, seconds)
        return function, _guarded(self.jacobian, "jacobian", names, seconds) if self.jacobian else None


def _function(path: str, key: str) -> Callable[[FloatArray], Any]:
    """Import the function that a study names, or say what is wrong with the name."""
    module, _, name = path.rpartition(".")
    try:
        function: Callable[[FloatArray], Any] = getattr(imported(module), name)
    except AttributeError:
        known = tuple(word for word in dir(imported(module)) if not word.startswith("_"))
        raise ModelError(f"model.{key}: '{module}' has no '{name}'; {nearest(name, known)}") from None
    except (Exception, SystemExit) as error:
        if out_of_memory(error):
            raise
        raise ModelError(f"model.{key}: '{module}' cannot be imported: {_said(error)}") from None
    if not callable(function):
        raise ModelError(f"model.{key}: '{path}' is {type(function).__name__}, expected a function")
    return function


def _guarded(path: str, key: str, names: Sequence[str], seconds: float | None) -> Callable[[FloatArray], Any]:
    """Import a function; exceptions that it raises, and calls beyond the time limit, become failed solves.

    If it ends the process or runs out of memory, which says nothing about the model, the run ends and names the
    parameters.
    """
    function = _function(path, key)

    def at(point: FloatArray) -> str:
        return ", ".join(f"{name} = {value:.6g}" for name, value in zip(names, point, strict=True))

    def guarded(point: FloatArray) -> Any:
        try:
            with time_limit(seconds):
                return function(point)
        except SolveError:
            raise
        except TimeLimitError:
            raise SolveError(f"{path} took longer than solve_seconds = {seconds:g}") from None
        except SystemExit as error:
            raise StopError(f"{path} ended the process: {_said(error)} at {at(point)}") from None
        except Exception as error:
            if out_of_memory(error):
                have = headroom()
                left = f"; {have}" if have.size < LITTLE else ""  # there may be plenty, but not for what it asked for
                raise StopError(f"memory ran out: {path} raised {_said(error)} at {at(point)}{left}") from None
            if reason_to_stop(error) is not None:
                raise
            raise SolveError(f"{path} raised {_said(error)}") from error

    return guarded


def _said(error: BaseException) -> str:
    """Name and first line of an exception."""
    lines = str(error).splitlines()
    return f"{type(error).__name__}{f': {lines[0]}' if lines else ''}"


class UmBridgeModel(_External):
    """A model behind a server of the UM-Bridge protocol.

    If the server has several vectors, they follow one another in `parameters` and `outputs`. Derivatives come from
    ApplyJacobian or Gradient, whichever the server has (of both, the one that takes fewer calls). A solve that the
    server reports as failed is a failed solve; a server that is gone ends the study, and the same command continues it.

    Parameters
    ----------
    url
        Address of the server, such as ``http://localhost:4242``.
    name
        One of its models; may be left out if it has only one.
    config
        Options of the model, as the server documents them.
    parameters, outputs
        Names, as in every external model.
    """

    kind: Literal["um-bridge"] = "um-bridge"
    url: Annotated[str, Field(pattern=r"^https?://\S+$")]
    name: str | None = None
    config: dict[str, Any] = Field(default={})

    @property
    def description(self) -> str:
        options = ", ".join(f"{key} = {value}" for key, value in self.config.items())
        return f"UM-Bridge model{f' {self.name}' if self.name else ''} at {self.url}{f', {options}' if options else ''}"

    def functions(self) -> tuple[Callable[[FloatArray], Any], Callable[[FloatArray], Any] | None]:
        """Ask the server what it has."""
        client = Client(self.url, self.name, self.config, self.solve_seconds)
        for what, sizes, given in (
            ("parameters", client.inputs, len(self.parameters)),
            ("outputs", client.outputs, len(self.outputs)),
        ):
            if sum(sizes) != given:
                message = f"model.{what}: {given} are named, but {self.url} has {sum(sizes)} (in vectors of {sizes})"
                raise ModelError(message)
        return client.evaluate, client.jacobian if client.differentiable else None


class Client:
    """A model of an UM-Bridge server, by its name, or the only one; answers have a time limit, None to wait forever.

    Attributes
    ----------
    inputs, outputs
        Lengths of the vectors of parameters and of outputs.
    differentiable
        Whether the server gives derivatives.

    Raises
    ------
    ModelError
        If the server does not answer, or has no such model.
    """

    def __init__(self, url: str, name: str | None, config: dict[str, Any], seconds: float | None = None) -> None:
        self._url = url.rstrip("/")
        self._seconds = seconds
        info = self._ask("Info", None)
        models = info.get("models", [])
        if name is None and len(models) != 1:
            raise ModelError(f"model.name: missing, expected one of the models of {url}: {', '.join(models)}")
        self._model = models[0] if name is None else name
        if self._model not in models:
            raise ModelError(f"model.name: '{name}' is not a model of {url}; {nearest(str(name), tuple(models))}")
        if info.get("protocolVersion") != PROTOCOL:
            message = f"model.url: {url} speaks version {info.get('protocolVersion')} of UM-Bridge, expected {PROTOCOL}"
            raise ModelError(message)
        self._config = config
        self.inputs: list[int] = self._ask("InputSizes", {"config": config})["inputSizes"]
        self.outputs: list[int] = self._ask("OutputSizes", {"config": config})["outputSizes"]
        support = self._ask("ModelInfo", {})["support"]
        self._forward, self._reverse = (bool(support.get(word)) for word in ("ApplyJacobian", "Gradient"))
        if not support.get("Evaluate"):
            raise ModelError(f"model.url: the model '{self._model}' of {url} cannot be evaluated")
        self.differentiable = self._forward or self._reverse

    def evaluate(self, point: FloatArray) -> FloatArray:
        """Return the outputs (m,) at parameters (d,)."""
        vectors = self._solve("Evaluate", point, {})
        return np.concatenate([np.asarray(vector, dtype=float) for vector in vectors])

    def jacobian(self, point: FloatArray) -> FloatArray:
        """Return the derivatives (m, d), by one call for each parameter or for each output."""
        blocks = [
            [self._block(point, o, i, m, d) for i, d in enumerate(self.inputs)] for o, m in enumerate(self.outputs)
        ]
        return np.block(blocks)

    def _block(self, point: FloatArray, o: int, i: int, m: int, d: int) -> FloatArray:
        """Derivatives (m, d) of one vector of outputs by one vector of parameters."""
        which = {"outWrt": o, "inWrt": i}
        if self._forward and (d <= m or not self._reverse):
            columns = [self._solve("ApplyJacobian", point, which | {"vec": unit.tolist()}) for unit in np.eye(d)]
            return np.array(columns, dtype=float).reshape(d, m).T
        rows = [self._solve("Gradient", point, which | {"sens": unit.tolist()}) for unit in np.eye(m)]
        return np.array(rows, dtype=float).reshape(m, d)

    def _solve(self, what: str, point: FloatArray, more: dict[str, Any]) -> Any:
        ends = np.cumsum(self.inputs)[:-1]
        vectors = [part.tolist() for part in np.split(point, ends)]
        return self._ask(what, {"input": vectors, "config": self._config} | more, self._seconds)["output"]

    def _ask(self, what: str, question: dict[str, Any] | None, timeout: float | None = SECONDS_TO_ANSWER) -> Any:
        from urllib.error import HTTPError, URLError
        from urllib.request import Request, urlopen

        data = None if question is None else json.dumps({"name": self._model} | question).encode()
        request = Request(f"{self._url}/{what}", data, {"Content-Type": "application/json"})
        try:
            # The timeout of urlopen limits silence only: a server that keeps sending may take forever.
            with time_limit(timeout):
                try:
                    with urlopen(request, timeout=timeout) as answer:
                        return json.loads(answer.read())
                except HTTPError as error:
                    self._refuse(what, error.code, error.read())
        except (TimeoutError, TimeLimitError):
            self._refuse_slowness(what, timeout)
        except URLError as error:
            if isinstance(error.reason, TimeoutError):
                self._refuse_slowness(what, timeout)
            message = f"model.url: {self._url} does not answer ({error.reason}), expected an UM-Bridge server"
            raise ModelError(message) from None
        except json.JSONDecodeError:
            message = f"model.url: {self._url} is not an UM-Bridge server: its answer to {what} is not JSON"
            raise ModelError(message) from None
        except OSError as error:
            raise ModelError(f"model.url: {self._url} broke off the connection ({_said(error)})") from None

    def _refuse_slowness(self, what: str, timeout: float | None) -> NoReturn:
        if what in {"Evaluate", "Gradient", "ApplyJacobian"}:
            raise SolveError(f"{self._url} took longer than solve_seconds = {timeout:g}")
        raise ModelError(f"model.url: {self._url} does not answer within {timeout:g} s, expected an UM-Bridge server")

    def _refuse(self, what: str, code: int, body: bytes) -> None:
        """Say what a server's error means: a failed solve, or a model that cannot be used."""
        try:
            said = json.loads(body)["error"]
            kind, message = str(said["type"]), str(said["message"])
        except (ValueError, KeyError, TypeError):
            kind, message = "", f"status {code}"
        if code == 404 or kind in MISUSED:
            raise ModelError(f"model.url: {self._url} refuses {what}: {message}")
        raise SolveError(f"{self._url}: {message}")


class TimeLimitError(BaseException):
    """Code took too long. It is not an Exception, so that `except Exception` in that code does not swallow it."""


@contextmanager
def time_limit(seconds: float | None) -> Iterator[None]:
    """Interrupt the code in this context after so many seconds; code outside Python, when it returns.

    There is no limit if `seconds` is None, or outside the main thread, since only that can be interrupted.

    Raises
    ------
    TimeLimitError
        If the time has passed.
    """
    if seconds is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    waiting = True

    def interrupt(*_: Any) -> None:
        if waiting:
            raise TimeLimitError

    previous = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, seconds, AGAIN)
    try:
        yield
    finally:
        waiting = False
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous)
