"""`tissuq live`: a socket and a page."""

import contextlib
import json
import socket
import subprocess
import time
import urllib.error
import urllib.request

import numpy as np
import pytest

from forward.reduced.data import save
from forward.reduced.model import ReducedModel
from tests.browser import browser, executable
from tests.forward.reduced.test_model import (  # noqa: F401 - fixtures
    full,
    reduction,
    small,
    snapshots,
)
from tests.launch import TISSUQ, environment
from workflows.live.mail import pair
from workflows.live.page import surface

pytestmark = pytest.mark.fem


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as one:
        return one.getsockname()[1]


def test_the_surface_of_hexahedra_and_tetrahedra():
    cube = np.array([[0, 1, 2, 3, 4, 5, 6, 7], [4, 5, 6, 7, 8, 9, 10, 11]])
    assert len(surface(cube, 12)) == 2 * 10
    assert len(surface(np.array([[0, 1, 2, 3], [1, 2, 3, 4]]), 10)) == 6


def test_frames_over_a_socket_and_the_body_on_a_page(small, tmp_path):  # noqa: F811
    save(small, tmp_path / "model.npz")
    port, page = free_port(), free_port()
    command = [TISSUQ, "live", tmp_path / "model.npz", "--port", str(port), "--page", str(page)]
    served = subprocess.Popen(list(map(str, command)), env=environment(), stdout=subprocess.PIPE, text=True)
    try:
        assert f"127.0.0.1:{port}" in served.stdout.readline()
        with socket.create_connection(("127.0.0.1", port), timeout=60) as client:
            lines = client.makefile("rb")
            told = json.loads(lines.readline())
            assert told["parameters"]["loads.pressure.size"] == 200
            client.sendall(b'{"loads.pressure.size": 230}\n')
            answer = json.loads(lines.readline())
            whole = small.nominal.copy()
            whole[2] = 230
            exact = ReducedModel(small, small.parameters).reduced(whole).outputs
            each_frame = [i for i, name in enumerate(told["outputs"]) if name not in told["local"]]
            np.testing.assert_allclose(np.array(answer["outputs"])[each_frame], exact[each_frame], rtol=1e-3)
            # Lines that wait: only the last is solved for.
            client.sendall(b'{"loads.pressure.size": 231}\n{"loads.pressure.size": 232}\n')
            first, last = json.loads(lines.readline()), json.loads(lines.readline())
            assert (first["late"], last["late"]) in {(True, False), (False, False)}
            _rude(port, client, lines)
        base = f"http://127.0.0.1:{page}"
        scene = json.loads(_patiently(f"{base}/scene"))
        size = 4 * (3 * len(small.outputs) + len(scene["places"]))
        for _ in range(100):
            frame = _patiently(f"{base}/frame")
            if len(frame) == size:
                break
            time.sleep(0.1)
        assert len(frame) == size
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(urllib.request.Request(f"{base}/frame", headers={"Host": "elsewhere"}), timeout=10)
        with pytest.raises(urllib.error.HTTPError, match="400"):
            urllib.request.urlopen(f"{base}/move", data=b'{"loads.pressure.size": 1}', timeout=10)
        for wrong in (b'{"x": 1}', b"[" * 9999, b'{"loads.pressure.size": %s}' % (b"1" * 400)):
            asked = urllib.request.Request(f"{base}/move", wrong, {"Content-Type": "application/json"})
            with pytest.raises(urllib.error.HTTPError, match="400"):
                urllib.request.urlopen(asked, timeout=10)
        assert b"<canvas" in _patiently(base)
        _taken(tmp_path / "model.npz", port, page)
    finally:
        served.terminate()
        served.wait(20)


def _rude(port, client, lines):
    """One that asks and never reads keeps nobody waiting, and a line too long is refused in words."""
    with socket.create_connection(("127.0.0.1", port), timeout=60) as other:
        other.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            for _ in range(20_000):
                other.send(b"{}\n" * 20)
        client.sendall(b"{}\n")
        assert "outputs" in json.loads(lines.readline())
    client.sendall(b"x" * 200_000 + b"\n{}\n")
    assert "more than 65536 bytes" in json.loads(lines.readline())["error"]
    assert "outputs" in json.loads(lines.readline())


def _taken(file, port, page):
    """Ports that are taken are named in one line."""
    for taken in ("port", "page"):
        again = list(map(str, [TISSUQ, "live", file, "--port", "0", "--page", "0"]))
        again[again.index(f"--{taken}") + 1] = number = str(port if taken == "port" else page)
        found = subprocess.run(again, env=environment(), capture_output=True, text=True, timeout=60, check=False)
        assert found.returncode == 2
        assert found.stderr == f"--{taken} {number}: cannot be used on 127.0.0.1: Address already in use\n"


@pytest.mark.skipif(executable() is None, reason="no Chromium is installed (Debian: chromium)")
def test_the_page_moves_in_a_browser(small, tmp_path):  # noqa: F811
    """No fault on its console, nothing from elsewhere; a slider moves the body and its numbers."""
    save(small, tmp_path / "model.npz")
    port, page = free_port(), free_port()
    command = [TISSUQ, "live", tmp_path / "model.npz", "--port", str(port), "--page", str(page), "--quiet"]
    served = subprocess.Popen(list(map(str, command)), env=environment())
    try:
        _patiently(f"http://127.0.0.1:{page}/scene")
        with browser() as tab:
            tab.open(f"http://127.0.0.1:{page}/")
            tab.wait("/[1-9]\\d* pictures a second/.test(document.getElementById('rate').textContent)")
            number = "document.querySelector('#outputs td:nth-child(2)').textContent"
            before = float(tab.run(number))
            slider = small.parameters.index("loads.gravity.density")
            high = float(small.upper[slider])
            tab.run(
                f"(() => {{ const s = document.querySelectorAll('#sliders input')[{slider}]; s.value = {high};"
                " s.dispatchEvent(new Event('input')); })()"
            )
            whole = small.nominal.copy()
            whole[slider] = high
            exact = ReducedModel(small, small.parameters).reduced(whole).outputs[0]
            assert abs(before - exact) > 1e-3 * abs(exact)
            tab.wait(f"Math.abs({number} - {exact}) < 2e-3 * {abs(exact)}")
            assert tab.errors == []
            assert all(url.startswith((f"http://127.0.0.1:{page}/", "data:")) for url in tab.requests)
            assert tab.run("document.getElementById('body').getContext('webgl') !== null")
    finally:
        served.terminate()
        served.wait(20)


def test_mail_is_whole_or_not_there():
    """A line between processes: what has no room is left out, and nobody waits."""
    one, other = pair()
    assert one.send({"a": np.arange(3)})
    np.testing.assert_array_equal(other.receive()["a"], np.arange(3))
    large, sent = np.zeros(10_000), 0
    while one.send(large):
        sent += 1
        assert sent < 1000
    assert other.receive().shape == large.shape
    assert one.send(large)
    for _ in range(sent):
        other.receive()
    with pytest.raises(OSError, match="too long"):
        one.send(np.zeros(200_000))
    one.close()
    with pytest.raises(EOFError):
        other.receive()
    with pytest.raises(OSError, match="pipe"):
        other.send(1)


def _patiently(address):
    for _ in range(100):
        try:
            return urllib.request.urlopen(address, timeout=10).read()
        except OSError:
            time.sleep(0.1)
    raise AssertionError(address)
