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

from forward.machine import compiled_forms
from forward.reduced.data import save
from forward.reduced.model import ReducedModel
from tests.browser import browser, executable
from tests.forward.reduced.test_model import (  # noqa: F401 - fixtures
    full,
    reduction,
    small,
    snapshots,
)
from tests.launch import TISSUQ, environment, in_process
from workflows.config.mistakes import StudyError
from workflows.live.loop import FIRST
from workflows.live.mail import pair
from workflows.live.token import kept, same
from workflows.results.surfaces import flat, outer

pytestmark = pytest.mark.fem


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as one:
        return one.getsockname()[1]


def test_the_surface_of_hexahedra_and_tetrahedra():
    cube = np.array([[0, 1, 2, 3, 4, 5, 6, 7], [4, 5, 6, 7, 8, 9, 10, 11]])
    assert len(outer(cube, flat(12))[0]) == 2 * 10
    assert len(outer(np.array([[0, 1, 2, 3], [1, 2, 3, 4]]), flat(10))[0]) == 6


@contextlib.contextmanager
def live(small, folder, *words, files=1024):  # noqa: F811
    """A program that serves, with a folder of its own for the token beside compiled forms; its ports and the token."""
    save(small, folder / "model.npz")
    (folder / "tissuq").mkdir(exist_ok=True)
    for compiled in compiled_forms().iterdir():
        if compiled.is_dir():
            (folder / "tissuq" / compiled.name).symlink_to(compiled)
    port, page = free_port(), free_port()
    command = [TISSUQ, "live", folder / "model.npz", "--port", str(port), "--page", str(page), *words]
    served = subprocess.Popen(
        ["/bin/sh", "-c", f'ulimit -n {files}; exec "$@"', "sh", *map(str, command)],
        env=environment() | {"XDG_CACHE_HOME": str(folder)},
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert served.stdout.readline() == f"frames: 127.0.0.1:{port}, a line of JSON each\n"
        address = served.stdout.readline().split()[1]
        file = folder / "tissuq" / "live-token"
        token = file.read_text().strip() if file.exists() else ""
        assert address == f"http://127.0.0.1:{page}/" + (f"#{token}" if token else "")
        yield port, page, token
        assert served.poll() is None
    finally:
        served.terminate()
        served.wait(20)


@contextlib.contextmanager
def device(port, token):
    """A client that is served, and its answers; the first says what there is."""
    with socket.create_connection(("127.0.0.1", port), timeout=60) as client:
        client.sendall(json.dumps({"token": token}).encode() + b"\n")
        yield client, client.makefile("rb")


def test_frames_over_a_socket_and_the_body_on_a_page(small, tmp_path):  # noqa: F811
    with live(small, tmp_path) as (port, page, token):
        with device(port, token) as (client, lines):
            told = json.loads(lines.readline())
            assert told["parameters"]["loads.pressure.size"] == 200
            for _ in range(5):  # a frame takes as many corrections as there is time for, and the next ones go on
                answer = _frame(client, lines, {"loads.pressure.size": 230})
            whole = small.nominal.copy()
            whole[2] = 230
            exact = ReducedModel(small, small.parameters).reduced(whole).outputs
            each_frame = [i for i, name in enumerate(told["outputs"]) if name not in told["local"]]
            np.testing.assert_allclose(np.array(answer["outputs"])[each_frame], exact[each_frame], rtol=1e-3)
            # Lines that wait: only the last is solved for.
            client.sendall(b'{"loads.pressure.size": 231}\n{"loads.pressure.size": 232}\n')
            first, last = json.loads(lines.readline()), json.loads(lines.readline())
            assert (first["late"], last["late"]) in {(True, False), (False, False)}
            _rude(port, token, client, lines)
        base, known = f"http://127.0.0.1:{page}", {"Authorization": f"Bearer {token}"}

        def ask(path, headers=known, body=None):
            return urllib.request.urlopen(urllib.request.Request(base + path, body, headers), timeout=10).read()

        scene = json.loads(_patiently(f"{base}/scene", known))
        size = 4 * (3 * len(small.outputs) + len(scene["places"]))
        for _ in range(100):
            frame = ask("/frame")
            if len(frame) == size:
                break
            time.sleep(0.1)
        assert len(frame) == size
        text = {"Content-Type": "application/json"}
        moved = b'{"loads.pressure.size": 240}'
        for headers in (
            {},
            text,
            {"Authorization": "Bearer x"},
            known | {"Host": "elsewhere"},
            known | {"Origin": "http://elsewhere"},
            known | {"Origin": "null"},
        ):
            for path, body in (("/frame", None), ("/scene", None), ("/move", moved)):
                with pytest.raises(urllib.error.HTTPError, match="403"):
                    ask(path, headers, body)
        for headers, wrong in (
            (known, b'{"loads.pressure.size": 1}'),
            *((known | text, wrong) for wrong in (b'{"x": 1}', b"[" * 9999, b'{"x": %s}' % (b"1" * 400))),
        ):
            with pytest.raises(urllib.error.HTTPError, match="400"):
                ask("/move", headers, wrong)
        assert ask("/move", known | text | {"Origin": base}, moved) == b"{}"
        assert b"<canvas" in ask("/", {})
        _taken(tmp_path / "model.npz", port, page)


def _frame(client, lines, table):
    """The answer of a device's next frame."""
    client.sendall(json.dumps(table).encode() + b"\n")
    return json.loads(lines.readline())


def _said(port, content):
    """What is answered before the connection is closed."""
    with socket.create_connection(("127.0.0.1", port), timeout=30) as other:
        found = b""
        with contextlib.suppress(ConnectionError):
            other.sendall(content)
            while chunk := other.recv(4096):
                found += chunk
        return found


def _request(body):
    return b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: text/plain\r\nContent-Length: %d\r\n\r\n%s" % (
        len(body),
        body,
    )


MOVED = b'{"loads.pressure.size": 900}\n'


@pytest.mark.slow
@pytest.mark.parametrize("secret", [True, False])
def test_others_move_nothing_and_use_nothing_up(small, tmp_path, secret):  # noqa: F811
    with live(small, tmp_path, *([] if secret else ["--no-token"]), files=128) as (port, page, token):
        with device(port, token) as (client, lines):
            assert "parameters" in json.loads(lines.readline())
            _hostile(port, token, client, lines)
            _idle(port, page, token, client, lines)
        if secret:
            assert b"within 5 s" in _said(port, b"")
        else:  # the first line may be a frame
            with socket.create_connection(("127.0.0.1", port), timeout=30) as client:
                lines = client.makefile("rb")
                assert "parameters" in json.loads(lines.readline())
                assert "microseconds" in _frame(client, lines, {"loads.pressure.size": 210})


def _hostile(port, token, client, lines):
    """A page in a browser can send HTTP, or begin a handshake of TLS that holds bytes of its own; others, anything."""
    before = _frame(client, lines, {})["outputs"]
    hostile = [
        _request(MOVED),
        _request(b"\n" + MOVED),
        b"GET /" + MOVED,
        b"\x16\x03\x01\x02\x00\x01" + b"\n" + MOVED,
        b"[1]\n" + MOVED,
        b"null\n" + MOVED,
        b"\n" + MOVED,
        b"{" * 9999 + b"\n" + MOVED,
        b"x" * 200_000 + b"\n" + MOVED,
    ]
    if token:
        tables = ({}, {"token": ""}, {"token": None}, {"token": token[:-1]}, {"token": [token]}, {"token": 1})
        hostile += [MOVED, *(json.dumps(table).encode() + b"\n" + MOVED for table in tables)]
    for content in hostile:
        said = _said(port, content)
        assert b"microseconds" not in said, content
        assert (b"parameters" in said) == (not token), content
    np.testing.assert_allclose(_frame(client, lines, {})["outputs"], before, rtol=1e-6)


def _idle(port, page, token, client, lines):
    """With 128 files there is room for devices and a page beside hundreds who say nothing, or a word of it."""
    address, known = f"http://127.0.0.1:{page}/scene", {"Authorization": f"Bearer {token}"}
    _patiently(address, known)
    with contextlib.ExitStack() as stack:
        greeting = json.dumps({"token": token}).encode() + b"\n"
        for k in range(300):
            for at in (port, page):
                idle = stack.enter_context(socket.create_connection(("127.0.0.1", at), timeout=30))
                idle.sendall((b"", b"{", greeting, b"P")[k % 4])
            if k % 150 == 0:  # in between come more who are known, and ask nothing, than there is room for
                assert "microseconds" in _frame(client, lines, {"loads.pressure.size": 200 + 0.1 * k})
        with device(port, token) as (other, others):
            assert "parameters" in json.loads(others.readline())
            assert "microseconds" in _frame(other, others, {})
        assert json.loads(_patiently(address, known))["places"]
        time.sleep(FIRST + 1)  # one that is known may be silent
        assert "microseconds" in _frame(client, lines, {})


def _rude(port, token, client, lines):
    """One that asks and never reads keeps nobody waiting, and a line too long is refused in words."""
    with socket.create_connection(("127.0.0.1", port), timeout=60) as other:
        other.sendall(json.dumps({"token": token}).encode() + b"\n")
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
        again = ["live", file, "--port", "0", "--page", "0"]
        again[again.index(f"--{taken}") + 1] = number = port if taken == "port" else page
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr("workflows.live.serve.Loop", None)  # nothing is served
            found = in_process(*again)
        assert found.returncode == 2
        assert found.stderr == f"--{taken} {number}: cannot be used on 127.0.0.1: Address already in use\n"


@pytest.mark.slow
@pytest.mark.skipif(executable() is None, reason="no Chromium is installed (Debian: chromium)")
def test_the_page_moves_in_a_browser(small, tmp_path):  # noqa: F811
    """No fault on its console, nothing from elsewhere; a slider moves the body and its numbers."""
    with live(small, tmp_path) as (_, page, token):
        _patiently(f"http://127.0.0.1:{page}/")
        with browser() as tab:
            tab.open(f"http://127.0.0.1:{page}/")
            tab.wait("document.getElementById('rate')?.textContent.includes('needs its token')")
            tab.errors.clear()  # a page without token is refused what it asks for
            tab.run(f"location.hash = '{token}'")
            tab.wait("/[1-9]\\d* pictures a second/.test(document.getElementById('rate')?.textContent)")
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
            assert all(token not in url.partition("#")[0] for url in tab.requests)
            assert tab.run("document.getElementById('body').getContext('webgl') !== null")


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


def _patiently(address, headers=None):
    for _ in range(100):
        try:
            return urllib.request.urlopen(urllib.request.Request(address, headers=headers or {}), timeout=10).read()
        except OSError:
            time.sleep(0.1)
    raise AssertionError(address)


def test_the_token_is_one_for_all_programs_of_a_user_and_for_nobody_else(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    token = kept()
    assert len(token) >= 32
    assert kept() == token
    file = tmp_path / "tissuq" / "live-token"
    assert [*file.parent.iterdir()] == [file]
    assert file.stat().st_mode & 0o777 == 0o600
    assert same(token, token)
    for other in (token[:-1], f"{token} ", "", None, 3, [token], "ü"):
        assert not same(other, token)
    file.chmod(0o640)
    with pytest.raises(StudyError, match="others can read this token"):
        kept()
    file.chmod(0o600)
    file.write_text("short\n")
    with pytest.raises(StudyError, match="is no token"):
        kept()
    monkeypatch.setenv("XDG_CACHE_HOME", str(file))
    with pytest.raises(StudyError, match="cannot be kept there"):
        kept()
