"""Latencies of `tissuq live`: a device sends the place of an instrument a thousand times a second, over the socket.

The instrument circles on the slab of configs/slab.toml at 0.1 m/s. Latencies are round trips by the clock, from before
a line is sent until its answer is there; the answer itself is timed by the program. The device and
the loop have a core each, which other programs of the machine want too.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from forward.reduced.data import load
from forward.reduced.model import ReducedModel
from workflows.__main__ import main as command
from workflows.live.serve import real_time
from workflows.live.token import kept

CONFIG = Path(__file__).parent.parent / "configs" / "slab.toml"
FRAMES, PERIOD = 100_000, 1e-3
RADIUS, SPEED = 0.015, 0.1  # m, m/s
EVERY = 997  # frames between those that are compared with the equilibrium


def main(words: Sequence[str] = ()) -> None:
    """Print latencies, or pictures a second of the page in a browser while the instrument moves."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks live")
    parser.add_argument("--modes", type=int, default=20)
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--model", type=Path, help="a reduced slab that is there already")
    parser.add_argument("--pictures", type=float, metavar="SECONDS", help="count pictures of the page instead")
    asked = parser.parse_args(words)
    with tempfile.TemporaryDirectory() as folder:
        model = asked.model or Path(folder) / "slab.npz"
        if asked.model is None:
            places = ["--out", f"{folder}/made", "--output", str(model), "--quiet", "--no-report"]
            sets = ["--set", f"method.modes={asked.modes}", "--set", "method.unseen=0"]
            if command(["reduce", str(CONFIG), *places, *sets]):
                return
        if asked.pictures:
            _pictures(model, asked.pictures)
            return
        served = subprocess.Popen(
            [sys.executable, "-m", "workflows", "live", str(model), "--port", "0", "--no-page"],
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert served.stdout is not None
            port = int(served.stdout.readline().split(":")[2].split(",")[0])
            served.stdout.readline()  # where the token is
            print(served.stdout.readline().strip())
            first, *others = sorted(os.sched_getaffinity(0))
            os.sched_setaffinity(served.pid, {first})
            os.sched_setaffinity(0, others or {first})
            _measure(port, asked.frames, model)
        finally:
            served.terminate()
            served.wait()


def _pictures(model: Path, seconds: float) -> None:
    """Count what a page draws in a real browser, headless and without a graphics card, while a device moves."""
    from tests.browser import browser

    ports = []
    for _ in range(2):
        with socket.create_server(("127.0.0.1", 0)) as free:
            ports.append(free.getsockname()[1])
    words = ["live", str(model), "--port", str(ports[0]), "--page", str(ports[1]), "--quiet"]
    served = subprocess.Popen([sys.executable, "-m", "workflows", *words])
    try:
        with browser() as tab:
            for _ in range(100):
                time.sleep(0.1)
                with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", ports[1])):
                    break
            tab.open(f"http://127.0.0.1:{ports[1]}/#{kept()}")
            shown = "document.getElementById('rate').textContent"
            tab.wait(f"/[1-9]\\d* pictures/.test({shown})")
            device = socket.create_connection(("127.0.0.1", ports[0]))
            device.sendall(json.dumps({"token": kept()}).encode() + b"\n")
            lines = device.makefile("rb")
            x = json.loads(lines.readline())["parameters"]["loads.spot.x"]
            rates, ends, k = [], time.monotonic() + seconds, 0
            while time.monotonic() < ends:
                k += 1
                device.sendall(json.dumps({"loads.spot.x": x + RADIUS * np.sin(k / 100)}).encode() + b"\n")
                lines.readline()
                time.sleep(PERIOD)
                if k % 500 == 0:
                    rates.append(int(str(tab.run(shown)).split()[0]))
            slow = f"median {np.median(rates):.0f}, least {min(rates)}"
            print(f"pictures a second: {slow}; on its console: {tab.errors or 'nothing'}")
    finally:
        served.terminate()
        served.wait()


def _measure(port: int, frames: int, path: Path) -> None:
    """Send and receive; what is late is sent at once."""
    device = socket.create_connection(("127.0.0.1", port))
    device.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    device.sendall(json.dumps({"token": kept()}).encode() + b"\n")
    lines = device.makefile("rb")
    told = json.loads(lines.readline())
    x, y = (told["parameters"][f"loads.spot.{axis}"] for axis in "xy")
    real_time()
    took, inside, corrections = np.empty(frames), np.empty(frames), np.empty(frames)
    answers = []
    begin = time.perf_counter()
    missed = 0
    for k in range(frames):
        wait = begin + k * PERIOD - time.perf_counter()
        if wait > 0:
            time.sleep(wait)  # a loop that waits would keep the system from delivering
        else:
            missed += wait < -PERIOD
        angle = SPEED / RADIUS * k * PERIOD
        at = {"loads.spot.x": x + RADIUS * (np.cos(angle) - 1), "loads.spot.y": y + RADIUS * np.sin(angle)}
        line = json.dumps(at).encode() + b"\n"
        start = time.perf_counter()
        device.sendall(line)
        answer = json.loads(lines.readline())
        took[k] = time.perf_counter() - start
        inside[k], corrections[k] = answer["microseconds"], answer["corrections"]
        if k % EVERY == 0:
            answers.append((at, answer["outputs"]))
    lasted = time.perf_counter() - begin
    device.close()
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    data = load(path)
    model = ReducedModel(data, data.parameters)
    each = [i for i, output in enumerate(data.outputs) if output.kind != "peak"]
    off = np.zeros(len(each))
    for at, outputs in answers:
        whole = data.nominal.copy()
        for name, value in at.items():
            whole[data.parameters.index(name)] = value
        gap = np.abs(np.array(outputs) - model.reduced(whole).outputs) / np.array(data.about["spread"])
        off = np.maximum(off, gap[each])
    level = data.levels[0]
    print(f"{level.modes} modes, {frames:,} frames in {lasted:.1f} s; the device was late in {missed / frames:.3%}")
    for name, values in (("round trip", 1e3 * took), ("answer", 1e-3 * inside)):
        low, high, worst = np.median(values), np.quantile(values, 0.99), values.max()
        over = (values > 1e3 * PERIOD).mean()
        print(f"{name}: median {low:.3f} ms, 99 % {high:.3f} ms, worst {worst:.2f} ms; {over:.3%} over 1 ms")
    print(f"corrections: {corrections.mean():.2f} a frame, none in {(corrections == 0).mean():.2%}")
    print(f"off the equilibrium by at most {100 * off.max():.2g} % of the spread of an output (largest stress apart)")
