"""UM-Bridge both ways: the server as its protocol and its own client see it, and models behind servers in studies."""

import json
import signal
import socket
import struct
import subprocess
import sys
import tomllib
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from threading import Barrier
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import jsonschema
import numpy as np
import pytest
import umbridge
import xarray as xr
from scipy.optimize import minimize

from forward.conformance import check_derivatives
from forward.external.models import UmBridgeModel
from forward.model import ModelError, SolveError
from tests import launch
from tests.launch import ROOT, TISSUQ, environment
from tissuq.model import Model
from uq.evaluation.evaluate import SerialEvaluate
from workflows.config.study import load, parse
from workflows.run.run import run
from workflows.serve import RefusalError, Service

POINT = [750.0, 2e5]
FUNCTION = """
[model]
kind = "python"
function = "tests.functions.{0}"
jacobian = "tests.functions.slopes"
parameters = {{ E = 1.0, load = 1.0, length = 1.0 }}
outputs = ["tip", "weight"]

[parameters]
E = {{ kind = "uniform", lower = 0.5, upper = 1.5 }}
load = {{ kind = "uniform", lower = 0.5, upper = 1.5 }}
[method]
kind = "monte-carlo"
samples = 8
"""


@contextmanager
def command(*arguments):
    """A server as a process of its own, that says on its first line where it listens."""
    process = subprocess.Popen(
        # Where the tests run in the background, children ignore interrupts unless told otherwise.
        ["env", "--default-signal=INT", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(),
        cwd=ROOT,
    )
    try:
        first = process.stdout.readline()
        assert "http://" in first, process.stderr.read()
        yield "http://" + first.split("http://")[1].split(",")[0].strip(), process
    finally:
        if process.poll() is None:
            process.terminate()
        process.wait(timeout=20)
        process.stdout.close()
        process.stderr.close()


@pytest.fixture(scope="module")
def beam():
    """The tiny beam: density and bulk stiffness in, two deflections out."""
    with command(TISSUQ, "serve", "configs/tiny.toml", "--port", 0) as (url, _):
        yield url


@pytest.fixture(scope="module")
def function(tmp_path_factory):
    path = tmp_path_factory.mktemp("serve") / "function.toml"
    path.write_text(FUNCTION.format("beam"))
    with command(TISSUQ, "serve", path, "--port", 0) as (url, _):
        yield url


def ask(url, what, question=None):
    data = None if question is None else json.dumps(question).encode()
    try:
        with urlopen(Request(f"{url}/{what}", data)) as answer:
            return answer.status, json.load(answer)
    except HTTPError as error:
        return error.code, json.loads(error.read())


ERROR = {
    "type": "object",
    "required": ["error"],
    "additionalProperties": False,
    "properties": {
        "error": {
            "type": "object",
            "required": ["type", "message"],
            "additionalProperties": False,
            "properties": {"type": {"type": "string"}, "message": {"type": "string"}},
        }
    },
}
NUMBERS = {"type": "array", "minItems": 1, "items": {"type": "number"}}


def schema(key, of):
    return {"type": "object", "required": [key], "additionalProperties": False, "properties": {key: of}}


@pytest.mark.fem
def test_answers_are_those_of_the_protocol(beam):
    integers = {"type": "array", "minItems": 1, "items": {"type": "integer"}}
    assert ask(beam, "Info") == (200, {"protocolVersion": 1.0, "models": ["forward"]})
    status, support = ask(beam, "ModelInfo", {"name": "forward"})
    assert (status, set(support["support"])) == (200, {"Evaluate", "Gradient", "ApplyJacobian", "ApplyHessian"})
    assert all(value is True for value in support["support"].values())
    for what, key in (("InputSizes", "inputSizes"), ("OutputSizes", "outputSizes")):
        status, sizes = ask(beam, what, {"name": "forward"})
        jsonschema.validate(sizes, schema(key, integers))
        assert (status, sizes[key]) == (200, [2])
    asked = {"name": "forward", "input": [POINT], "config": {}, "outWrt": 0, "inWrt": 0, "inWrt1": 0, "inWrt2": 0}
    asked |= {"sens": [0, 0], "vec": [0, 0]}
    for what, of in (
        ("Evaluate", {"type": "array", "minItems": 1, "items": NUMBERS}),
        *((what, NUMBERS) for what in ("Gradient", "ApplyJacobian", "ApplyHessian")),
    ):
        status, answer = ask(beam, what, asked)
        jsonschema.validate(answer, schema("output", of))
        assert status == 200
        assert len(answer["output"][0] if what == "Evaluate" else answer["output"]) == 2


@pytest.mark.fem
@pytest.mark.parametrize("what", ["Evaluate", "Gradient", "ApplyJacobian", "ApplyHessian"])
@pytest.mark.parametrize(
    ("change", "kind"),
    [
        ({"name": "wrong_model_name"}, "ModelNotFound"),
        ({"input": [[1.0, 2.0, 3.0]]}, "InvalidInput"),
        ({"input": [[1.0, "2"]]}, "InvalidInput"),
        ({"input": [POINT, POINT]}, "InvalidInput"),
        ({"outWrt": 1}, "InvalidInput"),
        ({"inWrt": 1, "inWrt1": 1}, "InvalidInput"),
        ({"inWrt": -1, "inWrt2": -1}, "InvalidInput"),
        ({"sens": [1.0], "vec": [1.0]}, "InvalidInput"),
        ({"config": {"lewel": 1}}, "InvalidInput"),
        ({"config": {"level": -1}}, "InvalidInput"),
        ({"config": {"level": True}}, "InvalidInput"),
        ({"config": {"level": 6}}, "InvalidInput"),
        ({"config": {"level": 10**9}}, "InvalidInput"),
        ({"config": {"tolerance": "x" * 5000}}, "InvalidInput"),
        ({"name": ["x" * 5000]}, "ModelNotFound"),
        ({"input": [[10**400, 1.0]]}, "InvalidInput"),
    ],
)
def test_what_is_wrong_is_refused(beam, what, change, kind):
    asked = {"name": "forward", "input": [POINT], "config": {}, "outWrt": 0, "inWrt": 0, "inWrt1": 0, "inWrt2": 0}
    asked |= {"sens": [1.0, 0.0], "vec": [1.0, 0.0]}
    status, answer = ask(beam, what, asked | change)
    if what == "Evaluate" and change.keys() & {"outWrt", "inWrt", "sens"}:
        assert status == 200
        return
    jsonschema.validate(answer, ERROR)
    assert (status, answer["error"]["type"]) == (400, kind)
    assert len(answer["error"]["message"]) < 300
    assert "\n" not in answer["error"]["message"]


def raw(url, text, *, wait=10.0):
    """Send bytes as they are, and return the status and the answer."""
    host, port = url.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port)), timeout=wait) as connection:
        with suppress(ConnectionError):
            connection.sendall(text)
        answer = b""
        while part := connection.recv(65536):
            answer += part
    head, _, body = answer.partition(b"\r\n\r\n")
    return int(head.split()[1]), json.loads(body)


def post(body, *headers, length=None, what="Evaluate"):
    lines = [f"POST /{what} HTTP/1.1", f"Content-Length: {len(body) if length is None else length}", *headers, "", ""]
    return "\r\n".join(lines).encode() + body


@pytest.mark.parametrize(
    ("text", "status", "words"),
    [
        (post(b"[" * 100_000), 400, "nested too deeply, expected at most 32 levels"),
        (post(b'{"a":' * 5000 + b"1" + b"}" * 5000), 400, "nested too deeply"),
        (post(b'{"a": [NaN, Infinity]}'), 400, "NaN is not a number of JSON"),
        (post(b'{"a": ' + b"9" * 6000 + b"}"), 400, "not a JSON object"),
        (post(b"\xff\xfe"), 400, "not a JSON object"),
        (post(b"[]"), 400, "not a JSON object"),
        (post(b"{}", length=10**12), 413, "too long, expected at most 16777216 bytes"),
        (post(b"x" * (17 * 2**20)), 413, "too long"),
        (post(b"{}", length="9" * 5000), 413, "too long"),
        (post(b"{}", length=-1), 400, "Content-Length: expected a number of bytes"),
        (post(b"{}", length="two"), 400, "Content-Length: expected a number of bytes"),
        (post(b"", "Transfer-Encoding: chunked"), 411, "has no length"),
        (post(b"{}", "Host: evil.example:4242"), 403, "this server answers only this machine"),
        (post(b"{}", "Host: 192.168.0.7"), 403, "this server answers only this machine"),
        (post(b"{}", "Host: localhost", "Origin: http://evil.example"), 403, "does not answer browser pages"),
        (post(b"{}", "Host: localhost", "Origin: null"), 403, "does not answer browser pages"),
        (b"GET /Info HTTP/1.1\r\nHost: rebound.example\r\n\r\n", 403, "only this machine"),
        (b"PUT /Evaluate HTTP/1.1\r\n\r\n", 501, "Unsupported method"),
        (b"POST /" + b"x" * 70_000 + b" HTTP/1.1\r\n\r\n", 414, "Too Long"),
        (b"POST /" + b"x" * 5000 + b" HTTP/1.1\r\n\r\n", 404, "is not of the protocol"),
        (post(b"{}", *(f"A{i}: b" for i in range(300))), 431, "headers"),
    ],
    ids=lambda value: "" if isinstance(value, bytes) else value,
)
def test_bounds_of_requests(function, text, status, words):
    found, answer = raw(function, text)
    jsonschema.validate(answer, ERROR)
    assert (found, words in answer["error"]["message"]) == (status, True), answer
    assert len(answer["error"]["message"]) < 300
    assert ask(function, "Info")[0] == 200


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:80", "127.0.0.1:4242", "[::1]:4242"])
def test_hosts_that_are_this_machine(function, host):
    body = json.dumps({"name": "forward", "input": [[1.0, 1.0]]}).encode()
    assert raw(function, post(body, f"Host: {host}"))[0] == 200
    assert raw(function, post(body, f"Host: {host}", f"Origin: http://{host}"))[0] == 200


@pytest.mark.slow
def test_fifty_clients_at_once_clients_that_leave_and_one_that_dawdles(tmp_path):
    path = tmp_path / "function.toml"
    path.write_text(FUNCTION.format("beam"))
    impatient = "import sys, workflows.http; workflows.http.SECONDS_TO_SEND = 1.0; "
    script = impatient + "from workflows.__main__ import main; sys.exit(main(sys.argv[1:]))"
    body = json.dumps({"name": "forward", "input": [[1.0, 1.0]]}).encode()
    with command(sys.executable, "-c", script, "serve", path, "--port", 0) as (url, process):
        port = int(url.split(":")[-1])
        everyone = Barrier(50)

        def client(_):
            everyone.wait()
            return [raw(url, post(body), wait=60) for _ in range(10)]

        def leaves(i):
            everyone.wait()
            for _ in range(10):
                with socket.create_connection(("127.0.0.1", port)) as connection:
                    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", i % 2, 0))
                    connection.sendall(post(body) if i % 3 else post(body)[:40])

        with ThreadPoolExecutor(50) as pool:
            answers = [answer for each in pool.map(client, range(50)) for answer in each]
            assert {status for status, _ in answers} == {200}
            assert len({json.dumps(answer) for _, answer in answers}) == 1
            list(pool.map(leaves, range(50)))
        assert raw(url, post(body[:-1], length=len(body)), wait=60)[0] == 408
        assert ask(url, "Info")[0] == 200
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=20) == 0
        assert process.stderr.read() == ""


def test_a_model_that_returns_what_is_none_is_one_line(tmp_path):
    path = tmp_path / "function.toml"
    path.write_text(FUNCTION.format("short"))
    with command(TISSUQ, "serve", path, "--port", 0) as (url, process):
        status, answer = ask(url, "Evaluate", {"name": "forward", "input": [[1.0, 1.0]]})
        assert (status, answer["error"]["type"]) == (500, "ModelError")
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=20) == 0
        assert process.stderr.read() == ""


@pytest.mark.fem
@pytest.mark.parametrize("what", ["ModelInfo", "InputSizes", "OutputSizes", "Evaluate"])
def test_models_that_are_not_there(beam, what):
    status, answer = ask(beam, what, {"name": "wrong_model_name"})
    jsonschema.validate(answer, ERROR)
    assert (status, answer["error"]["type"]) == (400, "ModelNotFound")


def test_derivatives_that_are_not_there():
    service = Service(parse(tomllib.loads(FUNCTION.format("beam").replace("jacobian", "# jacobian"))).sampled)
    support = service.answer("ModelInfo", {"name": "forward"})["support"]
    assert support == {"Evaluate": True, "Gradient": False, "ApplyJacobian": False, "ApplyHessian": False}
    for what in ("Gradient", "ApplyJacobian", "ApplyHessian"):
        with pytest.raises(RefusalError) as caught:
            service.answer(what, {"name": "forward"})
        assert (caught.value.kind, caught.value.status) == ("UnsupportedFeature", 400)


@pytest.mark.fem
def test_vectors_of_one_number_as_the_conformance_suite_sends_them(beam):
    """UM-Bridge's testing/protocol_conformity_1.0 asks for no other point; ``--input_value=1000`` is one for a beam."""
    with urlopen(Request(beam, method="HEAD")) as answer:
        assert (answer.status, answer.read()) == (200, b"")
    asked = {"name": "forward", "config": {}, "input": [[1000.0, 1000.0]], "outWrt": 0}
    sens, vec = {"sens": [0, 0]}, {"vec": [1000.0, 1000.0]}
    for what, more in (
        ("Evaluate", {}),
        ("Gradient", {"inWrt": 0} | sens),
        ("ApplyJacobian", {"inWrt": 0} | vec),
        ("ApplyHessian", {"inWrt1": 0, "inWrt2": 0, "vec": [0, 0]} | sens),
    ):
        status, answer = ask(beam, what, asked | more)
        jsonschema.validate(answer, schema("output", {"type": "array"}))
        assert (status, np.size(answer["output"])) == (200, 2)


@pytest.mark.fem
def test_requests_that_are_none(beam):
    assert ask(beam, "Fly", {"name": "forward"})[0] == 404
    with pytest.raises(HTTPError, match="400"):
        urlopen(Request(f"{beam}/Evaluate", b"{not json"))


@pytest.mark.fem
def test_a_solve_without_answer_says_why(beam):
    status, answer = ask(beam, "Evaluate", {"name": "forward", "input": [[750.0, -1.0]]})
    jsonschema.validate(answer, ERROR)
    assert (status, answer["error"]["type"]) == (500, "SolveError")
    assert "not stable at rest: κ = 2 D1 = -2 Pa" in answer["error"]["message"]
    model = um_bridge(beam).build(None, ("density", "D1"))
    with pytest.raises(SolveError, match="not stable at rest: κ = 2 D1 = -2 Pa"):
        model.solve(np.array([750.0, -1.0]))


@pytest.mark.fem
def test_derivatives_by_the_package_of_the_protocol(beam):
    model = umbridge.HTTPModel(beam, "forward")
    sens, vec, h = [1.0, 2.0], np.array([30.0, 2e4]), 1e-3
    ahead, behind = (np.array(model([list(POINT + s * h * vec)])[0]) for s in (1, -1))
    jacobian = np.array(model.apply_jacobian(0, 0, [POINT], list(vec)))
    np.testing.assert_allclose(jacobian, (ahead - behind) / (2 * h), rtol=1e-5)
    gradient = np.array(model.gradient(0, 0, [POINT], sens))
    assert gradient @ vec == pytest.approx(np.array(sens) @ jacobian, rel=1e-5)
    hessian = np.array(model.apply_hessian(0, 0, 0, [POINT], sens, list(vec)))
    assert hessian[0] * vec[0] + hessian[1] * vec[1] == pytest.approx(vec @ hessian)
    H = np.array([model.apply_hessian(0, 0, 0, [POINT], sens, list(unit)) for unit in np.diag(vec)]) * vec
    np.testing.assert_allclose(H, H.T, rtol=1e-4)  # as second derivatives are
    nominal = np.array(model([POINT])[0])
    second = np.array(sens) @ (ahead - 2 * nominal + behind) / h**2
    assert vec @ hessian == pytest.approx(second, rel=2e-2)  # whose digits have cancelled


@pytest.mark.fem
def test_options_select_mesh_and_tolerance(beam):
    model = umbridge.HTTPModel(beam, "forward")
    coarse = np.array(model([POINT])[0])
    fine = np.array(model([POINT], {"level": 1})[0])
    tight = np.array(model([POINT], {"tolerance": 1e-12})[0])
    assert 1e-4 < np.abs(fine / coarse - 1).max() < 0.1
    np.testing.assert_allclose(tight, coarse, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.fem
def test_inversion_with_gradients_of_the_server(beam):
    """Density and stiffness from both deflections, by a program that knows nothing but the protocol."""
    model = umbridge.HTTPModel(beam, "forward")
    truth = np.array([820.0, 2.6e5])
    scale, start = np.array(POINT), np.ones(2)
    measured = np.array(model([list(truth)])[0])

    def misfit(x):
        residual = np.array(model([list(x * scale)])[0]) / measured - 1
        slope = np.array(model.gradient(0, 0, [list(x * scale)], list(residual / measured)))
        return 1e6 * residual @ residual / 2, 1e6 * slope * scale

    found = minimize(misfit, start, jac=True, method="L-BFGS-B", options={"ftol": 1e-15, "gtol": 1e-10, "maxiter": 200})
    np.testing.assert_allclose(found.x * scale, truth, rtol=2e-3)
    assert found.fun < 1e-3


def um_bridge(url, **changes):
    blocks = {"url": url, "parameters": {"density": 750.0, "D1": 3e5}, "outputs": ("uy_max", "ux_max")}
    return UmBridgeModel.model_validate(blocks | changes)


@pytest.mark.fem
def test_a_study_of_the_server_gives_the_moments_of_the_study_served(beam):
    served = load(ROOT / "configs" / "tiny.toml", ["method.samples=8"])
    blocks = tomllib.loads((ROOT / "configs" / "tiny.toml").read_text())
    blocks["model"] = um_bridge(beam).model_dump(exclude_none=True) | {"outputs": ["uy_max", "ux_max"]}
    laws = blocks["parameters"]
    blocks["parameters"] = {"density": laws["loads.gravity.density"], "D1": laws["material.D1"]}
    client = parse(blocks, ["method.samples=8"])
    from mpi4py import MPI

    results = [
        study.method.run(study.inputs, SerialEvaluate(study.model.build(MPI.COMM_SELF, study.inputs.names)))
        for study in (served, client)
    ]
    for name in ("mean", "std", "mean_error"):
        np.testing.assert_allclose(results[1][name], results[0][name], rtol=1e-6)


def test_a_tolerance_for_a_model_behind_a_server(function, tmp_path):
    laws = {name: {"kind": "uniform", "lower": 0.8, "upper": 1.2} for name in ("a", "b")}
    blocks = {"kind": "um-bridge", "url": function, "parameters": {"a": 1.0, "b": 1.0}, "outputs": ["u", "v"]}
    study = parse({"model": blocks, "parameters": laws, "accuracy": {"tolerance": 1e-2}})
    found = study.run(tmp_path / "out")
    told = json.loads(found.attrs["accuracy"])
    assert told["kept"]
    assert told["mesh"] is None
    places, weights = np.polynomial.legendre.leggauss(4)
    model = umbridge.HTTPModel(function, "forward")
    values = np.array([[model([[1 + 0.2 * x, 1 + 0.2 * y]])[0] for y in places] for x in places])
    mean, square = (np.einsum("xyo,x,y->o", of, weights, weights) / 4 for of in (values, values**2))
    np.testing.assert_allclose(found["mean"], mean, rtol=1e-2)
    np.testing.assert_allclose(found["std"], np.sqrt(square - mean**2), rtol=1e-2)


@pytest.mark.fem
def test_outputs_measured_at_a_server_are_inverted(beam, tmp_path):
    """The most probable parameters explain what was measured; there is no mesh to look at."""
    truth = np.array([780.0, 3.1e5])
    model = um_bridge(beam).build(None, ("density", "D1"))
    measured = dict(zip(model.outputs, model.solve(truth).outputs.tolist(), strict=True))
    blocks = {
        "model": um_bridge(beam).model_dump(exclude_none=True) | {"outputs": ["uy_max", "ux_max"]},
        "parameters": {
            "density": {"kind": "normal", "mean": 750.0, "std": 50.0},
            "D1": {"kind": "log-normal", "mean": 3e5, "std": 3e4},
        },
        "data": {"outputs": measured, "noise": {"relative": 1e-3}},
        "method": {"kind": "invert", "samples": 32, "starts": 1, "draws": 50},
    }
    assert run(parse(blocks), "server", tmp_path / "out", quiet=True, report=False) in (0, 3)
    one = xr.load_dataset(tmp_path / "out" / "results.nc", engine="h5netcdf").isel(data_set=0)
    np.testing.assert_allclose(one["predicted"], one["measured"], rtol=1e-3)
    assert (np.abs(one["mode"] - truth) < 3 * one["std"]).all()
    assert "mesh_checked" not in one


@contextmanager
def other_server(tmp_path):
    """A model served by the package of the protocol: two vectors of parameters, two of outputs."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    script = tmp_path / "server.py"
    script.write_text(
        "import sys, umbridge\n"
        "class Model(umbridge.Model):\n"
        "    def get_input_sizes(self, config={}): return [2, 1]\n"
        "    def get_output_sizes(self, config={}): return [1, 2]\n"
        "    def __call__(self, p, config={}):\n"
        "        (a, b), (c,) = p\n"
        "        f = config.get('factor', 1)\n"
        "        return [[f * a * b], [b * c, c ** 2]]\n"
        "    def gradient(self, o, i, p, sens, config={}):\n"
        "        (a, b), (c,) = p\n"
        "        f = config.get('factor', 1)\n"
        "        J = [[[[f * b, f * a]], [[0.0]]], [[[0.0, c], [0.0, 0.0]], [[b], [2 * c]]]][o][i]\n"
        "        return [sum(s * row[k] for s, row in zip(sens, J)) for k in range(len(J[0]))]\n"
        "    def supports_evaluate(self): return True\n"
        "    def supports_gradient(self): return True\n"
        "print('http://127.0.0.1:' + sys.argv[1], flush=True)\n"
        "umbridge.serve_models([Model('others')], int(sys.argv[1]))\n"
    )
    with command(sys.executable, script, port) as (url, _):
        yield url


def test_a_server_of_the_package_is_a_model(tmp_path):
    with other_server(tmp_path) as url:
        spec = UmBridgeModel(
            url=url, parameters={"a": 1.0, "b": 2.0, "c": 3.0}, outputs=("ab", "bc", "cc"), config={"factor": 10}
        )
        model = _when_it_answers(spec, ("c", "a"))
        point = np.array([5.0, 7.0])
        np.testing.assert_allclose(model.solve(point).outputs, [10 * 7 * 2, 2 * 5, 25])
        np.testing.assert_allclose(model.solve(point).tangent(np.eye(2)).T, [[0, 20], [2, 0], [10, 0]])
        check_derivatives(model, point, np.ones(2)).require()
        for changes, message in (
            ({"name": "other"}, r"model.name: 'other' is not a model of .*; did you mean 'others'"),
            ({"outputs": ("ab",)}, r"model.outputs: 1 are named, but .* has 3 \(in vectors of \[1, 2\]\)"),
        ):
            wrong = UmBridgeModel.model_validate(spec.model_dump(exclude_none=True) | changes)
            with pytest.raises(ModelError, match=message):
                wrong.build(None, ("a",))


def _when_it_answers(spec, names):
    import time

    for _ in range(100):
        try:
            return spec.build(None, names)
        except ModelError:
            time.sleep(0.1)
    return spec.build(None, names)


def test_a_server_that_is_down_is_one_line(tmp_path, capsys):
    from workflows.__main__ import main

    path = tmp_path / "study.toml"
    path.write_text(
        '[model]\nkind = "um-bridge"\nurl = "http://127.0.0.1:9"\nparameters = { a = 1.0 }\noutputs = ["f"]\n'
        '[parameters]\na = { kind = "uniform", lower = 0, upper = 1 }\n[method]\nkind = "monte-carlo"\nsamples = 8\n'
    )
    assert main(["check", str(path)]) == 2
    said = capsys.readouterr().err
    assert said.startswith("model.url: http://127.0.0.1:9 does not answer (")
    assert said.count("\n") == 1


def test_the_server_of_a_function(function):
    model = umbridge.HTTPModel(function, "forward")
    assert model([[1.0, 1.0]])[0] == pytest.approx([1 / (8 * 0.02 * 0.01**3 / 12), 1.0])
    with pytest.raises(Exception, match="has no options"):
        model([[1.0, 1.0]], {"level": 1})


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_an_interrupt_ends_the_server(tmp_path, number, capsys):
    from workflows.__main__ import main

    path = tmp_path / "study.toml"
    path.write_text(FUNCTION.format("beam"))
    with command(TISSUQ, "serve", path, "--port", 0) as (url, process):
        assert ask(url, "Info")[0] == 200
        port = url.split(":")[-1]
        assert main(["serve", str(path), "--port", port]) == 2
        assert capsys.readouterr().err == f"--port {port}: cannot be used on 127.0.0.1: Address already in use\n"
        process.send_signal(number)
        assert process.wait(timeout=10) == 0
        assert "interrupted after 1 requests" in process.stdout.read()
        assert process.stderr.read() == ""


@pytest.mark.parametrize(("name", "kind"), [("treloar", "select"), ("inclusion", "invert")])
def test_studies_of_other_kinds_are_not_served(capsys, name, kind):
    from workflows.__main__ import main

    assert main(["serve", str(ROOT / "configs" / f"{name}.toml")]) == 2
    assert f"is of kind '{kind}', expected a study of one model" in capsys.readouterr().err


SPECIMEN = """
[model]
kind = "specimen"
body = { kind = "box", size = [0.05, 0.05, 0.05], cells = [2, 2, 2], cell = "hexahedron", degree = 1 }
material = { kind = "neo-hookean-coupled", mu = 1e3, lmbda = 4e3 }
cases = [
    { name = "shear", clamp = ["z-min"], displacements = [{ on = "z-max", x = 0.005, y = 0, z = 0 }] },
    { name = "up", clamp = ["z-min"], loads = [{ kind = "traction", on = "z-max", direction = [0, 0, 1], size = 9 }] },
]
observed = [{ at = [[0.05, 0.05, 0.05]], components = "xz" }]

[parameters]
"material.mu" = { kind = "uniform", lower = 800, upper = 1200 }
[method]
kind = "monte-carlo"
samples = 8
"""


@pytest.mark.fem
def test_a_specimen_is_served():
    """All load cases in one vector of outputs, with their gradient."""
    model = Model(parse(tomllib.loads(SPECIMEN)).spec, ["material.mu"])
    expected = model.solve({"material.mu": 900.0})
    service = Service(parse(tomllib.loads(SPECIMEN)).sampled)
    answer = service.answer("Evaluate", {"name": "forward", "input": [[900.0]]})["output"][0]
    assert answer == pytest.approx([*expected.values()], rel=1e-7)
    question = {"name": "forward", "outWrt": 0, "inWrt": 0, "input": [[900.0]], "sens": [0.0, 0.0, 0.0, 1.0]}
    slope = service.answer("Gradient", question)["output"]
    assert slope == pytest.approx([expected.gradient("up.points.0.z")["material.mu"]], rel=1e-5)


@pytest.mark.slow
def test_the_model_of_an_inversion_is_served_and_that_of_a_comparison_is_not(tmp_path):
    data = "[data]\noutputs = { tip = 0.3 }\nsigma = { tip = 0.01 }\n"
    blocks, _, _ = FUNCTION.format("beam").partition("[method]")
    (tmp_path / "inverse.toml").write_text(f'{blocks}{data}[method]\nkind = "invert"\n')
    with command(TISSUQ, "serve", tmp_path / "inverse.toml", "--port", 0) as (url, _):
        assert ask(url, "InputSizes", {"name": "forward"})[1] == {"inputSizes": [2]}
    refused = launch.in_process("serve", ROOT / "configs" / "treloar.toml", "--port", 0)
    assert refused.returncode == 2
    assert "of kind 'select', expected a study of one model" in refused.stderr
