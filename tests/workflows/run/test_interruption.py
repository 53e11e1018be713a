"""Runs that die: no memory, no room on disk, signals, models that end the process or never end."""

import fcntl
import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
from contextlib import suppress
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread

import pytest

from forward import machine
from tests.launch import (
    HANGS,
    NOT_KEPT,
    ROOT,
    TISSUQ,
    environment,
    in_process,
    on_ranks,
    run_script,
    tissuq_on_two_ranks,
)
from workflows.__main__ import main
from workflows.run.run import ENDING

MODEL = """
import os
import sys
import time

def value(p):
    case = os.environ.get("CASE")
    if case == "exit" and p[0] > 0.5:
        sys.exit(0)
    if case == "memory" and p[0] > 0.5:
        raise MemoryError
    if case == "converts" and p[0] > 0.5:
        try:
            os.kill(os.getpid(), 15)
            time.sleep(1)
        except BaseException:
            raise ValueError("cannot build it") from None
    while case == "loop" and p[0] > 0.7:
        try:
            while True:
                pass
        except Exception:
            pass
    time.sleep(0.05 if case == "slow" else 0)
    return [p[0], p[0] ** 2]
"""
STUDY = """
[model]
kind = "python"
function = "endless.value"
parameters = { a = 0.5 }
outputs = ["y", "z"]

[parameters]
a = { kind = "uniform", lower = 0.0, upper = 1.0 }

[method]
kind = "monte-carlo"
samples = 100
seed = 1
"""
FACTORED = (
    "configs/beam-chaos.toml",
    *("--set", "model.body.cells=[28,6,6]", "--set", 'model.body.cell="tetrahedron"', "--set", "mesh_error=false"),
)
FEW = ("--set", "method.samples=4", "--set", "method.max_order=1")


@pytest.fixture
def study(tmp_path):
    (tmp_path / "endless.py").write_text(MODEL)
    (tmp_path / "study.toml").write_text(STUDY)
    yield tmp_path / "study.toml"
    sys.modules.pop("endless", None)


def tissuq(*arguments, ranks=None, case="", limits=()):
    """Run with limits (kind, size) of the process."""

    def limit():
        for kind, size in limits:
            resource.setrlimit(kind, (size, resource.getrlimit(kind)[1]))

    return subprocess.run(
        on_ranks(ranks, TISSUQ, *arguments),
        capture_output=True,
        text=True,
        timeout=HANGS,
        # Of compiled modules too Python keeps what it could write, and stumbles over it later.
        env=environment() | {"CASE": case} | ({NOT_KEPT: "1"} if limits else {}),
        check=False,
        cwd=ROOT,
        preexec_fn=limit,
    )


def in_case(case, ranks, *arguments):
    """Run with a case of the model: in this process, or on ranks of their own, which end with it."""
    if ranks:
        return tissuq(*arguments, ranks=ranks, case=case)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CASE", case)
        return in_process(*arguments)


def test_results_are_printed_and_kept_before_the_report_is_drawn(study, tmp_path, undrawn):
    out = tmp_path / "out"
    command = [TISSUQ, "run", study, "--out", out]
    begun = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment())
    assert begun.stdout is not None
    said = []
    while not (said and said[-1].startswith("101 solves in")):
        said.append(begun.stdout.readline())
        assert said[-1], said
    begun.kill()
    begun.wait()
    begun.stdout.close()
    assert said[1] == "y\n"
    assert said[2].split()[:2] == ["mean", "0.513"]
    assert not (out / "report.html").exists()
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["status"], summary["evaluations"]) == ("complete", 101)
    assert in_process("report", out).returncode == 0
    assert (out / "report.html").exists()
    again = in_process("run", study, "--out", out)
    assert (again.returncode, again.stdout) == (0, f"{out}: finished before, nothing to do\n")


def reasons(done):
    """The lines that say why, without progress and what mpirun adds; and no traceback."""
    assert "Traceback" not in done.stderr, done.stderr
    return [line for line in done.stderr.splitlines() if line.startswith(("failed:", "interrupted"))]


@pytest.mark.parametrize("kind", ["monte-carlo", "quasi-monte-carlo"])
def test_more_samples_than_memory_holds_are_a_line(study, tmp_path, kind):
    done = in_process("run", study, "--out", tmp_path / "out", "--set", f"method={{kind='{kind}', samples={2**40}}}")
    assert done.returncode == 1
    assert reasons(done)[0].startswith("failed: memory ran out: to hold 1,099,511,627,77")


@pytest.mark.parametrize("mebibytes", [100, 250, pytest.param(500, marks=pytest.mark.slow)])
def test_a_program_without_memory_says_so(study, tmp_path, mebibytes):
    done = tissuq("run", study, "--out", tmp_path / "out", limits=[(resource.RLIMIT_AS, mebibytes * 2**20)])
    if done.returncode == 0:  # enough for this model
        assert mebibytes == 500
        return
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert reasons(done)[0].startswith("failed: memory ran out: ")
    assert "MiB are available (limit of the address space, ulimit -v)" in done.stderr


@pytest.mark.fem
@pytest.mark.slow
def test_a_study_that_runs_out_of_memory_keeps_nothing_of_it(tmp_path):
    """In the mesh, the first factor, that of the reference, the first solves; then, with memory, the same bits."""
    out, whole, stopped = tmp_path / "out", tmp_path / "whole", 0
    for kibibytes in (650_000, 750_000, 900_000, 1_000_000):  # the last may be enough
        done = tissuq("run", *FACTORED, *FEW, "--out", out, limits=[(resource.RLIMIT_AS, kibibytes * 1024)])
        if done.returncode == 0:
            break
        stopped += 1
        assert done.returncode == 1, kibibytes
        (reason,) = reasons(done)
        assert reason.startswith("failed: memory ran out: "), reason
        assert "available (limit of the address space, ulimit -v)" in reason
        assert any(line.startswith("warning: memory may run out: about 1,6") for line in done.stderr.splitlines())
    assert stopped > 1
    assert tissuq("run", *FACTORED, *FEW, "--out", out).returncode == 0
    assert tissuq("run", *FACTORED, *FEW, "--out", whole).returncode == 0
    assert (out / "results.nc").read_bytes() == (whole / "results.nc").read_bytes()


@pytest.mark.fem
def test_a_factor_without_memory_is_no_failed_sample(tmp_path):
    """What a process maps before the factor differs between machines, so the limit grows until that fits."""
    out = tmp_path / "out"
    for kibibytes in range(650_000, 1_100_000, 50_000):
        done = tissuq("run", *FACTORED, *FEW, "--out", out, limits=[(resource.RLIMIT_AS, kibibytes * 1024)])
        assert done.returncode == 1
        (reason,) = reasons(done)
        assert reason.startswith("failed: memory ran out: "), reason
        assert not list(out.glob("evaluations/*"))
        if "the factor of the stiffness of 28,899 unknowns needs" in reason:
            return
    pytest.fail(f"no limit stopped the factor; the last reason was: {reason}")


def test_check_foresees_that_memory_runs_out():
    done = tissuq("check", *FACTORED, limits=[(resource.RLIMIT_AS, 1_100_000 * 1024)])
    assert done.returncode == 0
    (line,) = (line for line in done.stdout.splitlines() if line.startswith("warning"))
    assert "memory may run out: about 1,6" in line
    assert "MiB are available (limit of the address space, ulimit -v)" in line
    assert "warning" not in in_process("check", *FACTORED).stdout


@pytest.mark.few(2)
@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [None, 2])
@pytest.mark.parametrize(
    ("case", "reason"),
    [
        ("memory", "failed: memory ran out: endless.value raised MemoryError"),
        ("exit", "failed: endless.value ended the process: SystemExit: 0"),
    ],
)
def test_a_model_that_ends_the_run(study, tmp_path, ranks, case, reason):
    done = in_case(case, ranks, "run", study, "--out", tmp_path / "out", "--no-report")
    assert done.returncode == 1
    (said,) = reasons(done)
    assert re.fullmatch(re.escape(reason) + r" at a = 0\.\d+", said)  # of a machine that has plenty, no figures
    again = in_process("run", study, "--out", tmp_path / "out", "--no-report")
    assert again.returncode == 0, again.stderr
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["failed"] == 0


@pytest.mark.few(1)
@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [None, 2])
def test_a_model_that_never_ends_is_a_failed_solve(study, tmp_path, ranks):
    limited = ("--set", "model.solve_seconds=0.4", "--set", "method.samples=4")
    done = in_case("loop", ranks, "run", study, "--out", tmp_path / "out", "--no-report", *limited)
    assert done.returncode == 3, done.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert 0 < summary["failed"] < 4
    assert {one["reason"] for one in summary["failures"]} == {"endless.value took longer than solve_seconds = 0.4"}
    assert all(one["parameters"]["a"] > 0.7 for one in summary["failures"])


class Hanging(BaseHTTPRequestHandler):
    """A server of the UM-Bridge protocol that never ends its answers beyond 0.7: it is silent, or goes on sending."""

    trickles = False

    def do_GET(self):
        self.send({"protocolVersion": 1.0, "models": ["forward"]})

    def do_POST(self):
        asked = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        if "input" in asked:
            ((value,),) = asked["input"]
            if value > 0.7:
                self.hang()
            else:
                self.send({"output": [[value, value**2]]})
        else:
            self.send({"inputSizes": [1], "outputSizes": [2], "support": {"Evaluate": True}})

    def send(self, answer):
        body = json.dumps(answer).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def hang(self):
        end = time.monotonic() + 20
        with suppress(OSError):  # once the client has left
            if self.trickles:
                self.send_response(200)
                self.end_headers()
            while time.monotonic() < end:
                time.sleep(0.02)
                if self.trickles:
                    self.wfile.write(b" ")

    def log_message(self, *_):
        pass


@pytest.mark.slow
@pytest.mark.mpi
@pytest.mark.parametrize(("ranks", "trickles"), [(2, False), (None, True)])
def test_a_server_that_never_ends_is_a_failed_solve(study, tmp_path, monkeypatch, ranks, trickles):
    monkeypatch.setattr(Hanging, "trickles", trickles)
    with ThreadingHTTPServer(("127.0.0.1", 0), Hanging) as server:
        server.daemon_threads = True
        Thread(target=server.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{server.server_port}"
        there = STUDY.replace('"python"', '"um-bridge"').replace('function = "endless.value"', f'url = "{url}"')
        study.write_text(there)
        limited = ("--set", "model.solve_seconds=0.4", "--set", "method.samples=4")
        done = in_case("", ranks, "run", study, "--out", tmp_path / "out", "--no-report", *limited)
        server.shutdown()
    assert done.returncode == 3, done.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert 0 < summary["failed"] < 4
    assert {one["reason"] for one in summary["failures"]} == {f"{url} took longer than solve_seconds = 0.4"}
    assert all(one["parameters"]["a"] > 0.7 for one in summary["failures"])


@pytest.mark.fem
@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [None, 2])
def test_a_body_that_takes_too_long_is_a_failed_solve(tmp_path, ranks):
    """No solve is so fast; the ranks that share a model agree."""
    limited = ("--set", "model.solver.solve_seconds=1e-9", "--set", "method.kind=monte-carlo")
    few = ("--set", "method.samples=6", "--set", f"parallel.ranks_per_model={ranks or 1}")
    words = ("run", ROOT / "configs" / "tiny.toml", "--out", tmp_path / "out", *limited, *few)
    done = tissuq_on_two_ranks(*words) if ranks else in_process(*words)
    assert done.returncode == 1, done.stderr
    (reason,) = reasons(done)
    assert "the solve took longer than solve_seconds = 1e-09" in reason


def test_an_interruption_that_a_library_turns_into_its_own_exception_is_one(study, tmp_path, monkeypatch):
    """As pydantic does where a signal comes while it builds a class: neither a traceback nor a failed solve."""
    monkeypatch.setattr(machine, "_INTERRUPTIONS", [])
    before = [signal.getsignal(number) for number in ENDING]
    done = in_case("converts", None, "run", study, "--out", tmp_path / "out", "--no-report")
    assert (done.returncode, done.stderr) == (1, f"{machine.INTERRUPTED}\n")
    again = in_process("run", study, "--out", tmp_path / "out", "--no-report")
    assert again.returncode == 0, again.stderr
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["failed"] == 0
    for number, handler in zip(ENDING, before, strict=True):
        signal.signal(number, handler)


@pytest.mark.few(2)
@pytest.mark.mpi
@pytest.mark.parametrize(
    ("ranks", "number"),
    [
        (None, signal.SIGINT),
        (None, signal.SIGTERM),
        (2, signal.SIGTERM),
        pytest.param(2, signal.SIGINT, marks=pytest.mark.slow),
    ],
)
def test_an_interrupted_study_says_one_line(study, tmp_path, ranks, number):
    out = tmp_path / "out"
    process = subprocess.Popen(
        on_ranks(ranks, TISSUQ, "run", study, "--out", out, "--no-report"),
        env=environment() | {"CASE": "slow"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Shells have what they start in the background ignore it.
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
    )
    begin = time.monotonic()
    while not list(out.glob("evaluations/*.block")):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() - begin < 100
        time.sleep(0.05)
    process.send_signal(number)
    printed, said = process.communicate(timeout=60)
    assert process.returncode == 1
    assert printed == ""
    assert said.splitlines() == ["interrupted; the same command continues"]
    assert in_process("run", study, "--out", out, "--no-report").returncode == 0


ON_A_SMALL_DISK = """
import resource, sys
from pathlib import Path
from mpi4py import MPI  # whose own files may be large
from workflows.__main__ import main
from workflows.report import blocks
sys.dont_write_bytecode = True  # or else parts of modules are kept
blocks.svg = lambda ax: bytes(size)  # pictures for which there is no room
for size in (100, 2_000, 10_000, 50_000):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    print(main(["run", *sys.argv[1:]]), list(Path(sys.argv[-1]).glob("**/.*")))
"""


def test_a_full_disk_stops_a_study_that_the_same_command_continues(study, tmp_path, undrawn):
    """No larger file is allowed: study.toml, a block, results, the report."""
    out = tmp_path / "out"
    done = run_script(None, ON_A_SMALL_DISK, study, "--quiet", "--out", out)
    assert done.stdout.splitlines() == ["1 []"] * 4, done.stderr
    for reason in reasons(done):
        assert "cannot be written: File too large; the same command continues once there is room" in reason
    assert len(reasons(done)) == 4
    again = in_process("run", study, "--out", out)
    assert again.returncode == 0, again.stderr
    assert (out / "report.html").exists()


def test_limits_of_files_that_mpi_cannot_bear_are_said(study, tmp_path):
    done = tissuq("run", study, "--out", tmp_path / "out", limits=[(resource.RLIMIT_FSIZE, 10_000)])
    assert done.returncode == 1
    assert done.stderr == "failed: MPI needs files of 4 MiB, 0.00954 MiB are allowed (ulimit -f)\n"


@pytest.mark.fem
@pytest.mark.skipif(os.geteuid() != 0, reason="mounts a file system")
@pytest.mark.slow
def test_a_file_system_that_is_full(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=80k", "tmpfs", disk], check=False, capture_output=True
    )
    if mounted.returncode:
        pytest.skip("cannot mount")
    try:
        done = tissuq("run", "configs/tiny.toml", "--out", disk / "out", "--no-report")
        assert done.returncode == 1, done.stderr
        (reason,) = reasons(done)
        assert "cannot be written: No space left on device" in reason
        subprocess.run(["mount", "-o", "remount,size=20m", disk], check=True)
        again = tissuq("run", "configs/tiny.toml", "--out", disk / "out", "--no-report")
        assert again.returncode == 0, again.stderr
        whole = tissuq("run", "configs/tiny.toml", "--out", tmp_path / "whole", "--no-report")
        assert whole.returncode == 0
        assert (disk / "out" / "results.nc").read_bytes() == (tmp_path / "whole" / "results.nc").read_bytes()
    finally:
        subprocess.run(["umount", disk], check=True)


@pytest.mark.parametrize("harm", ["missing", "flipped", "cut"])
def test_lost_results_are_computed_again(study, tmp_path, harm):
    out = tmp_path / "out"
    assert in_process("run", study, "--out", out, "--no-report").returncode == 0
    whole = (out / "results.nc").read_bytes()
    if harm == "missing":
        (out / "results.nc").unlink()
    else:
        spoilt = bytearray(whole if harm == "flipped" else whole[:2000])
        spoilt[len(spoilt) // 2] ^= 4
        (out / "results.nc").write_bytes(spoilt)
    if harm != "flipped":
        said = in_process("report", out)
        assert said.returncode == 1
        assert len(said.stderr.splitlines()) == 1
        assert "`tissuq run` with the same study and --out makes it again" in said.stderr
    done = in_process("run", study, "--out", out, "--no-report")
    assert done.returncode == 0, done.stderr
    assert "missing or damaged, the study is computed again" in done.stderr
    assert (out / "results.nc").read_bytes() == whole


@pytest.mark.few(3)
@pytest.mark.parametrize(
    "name", ["summary.json", "results.nc", "report.html", "evaluations.h5", "sources.json", "evaluations"]
)
@pytest.mark.parametrize("harm", ["folder", "file", "loop"])
def test_what_stands_in_the_way_is_said_and_the_rest_continues(study, tmp_path, capsys, name, harm, undrawn):
    """In one line, and when it is gone the same command ends well."""
    if harm == "file" and name != "evaluations":
        pytest.skip("is a file")
    study.write_text(STUDY.replace("endless.value", "tests.functions.cube").replace('["y", "z"]', '["y"]'))
    out = tmp_path / "out"
    command = ["run", str(study), "--out", str(out), "--quiet", *([] if name == "report.html" else ["--no-report"])]
    assert main(command) == 0
    (out / "summary.json").unlink()
    thing = out / name
    thing.unlink(missing_ok=True)
    {"folder": thing.mkdir, "file": thing.touch, "loop": lambda: thing.symlink_to(thing)}[harm]()
    capsys.readouterr()
    code, said = main(command), capsys.readouterr().err
    if code:
        assert code in (1, 2)
        assert len(said.splitlines()) == 1
        assert "Traceback" not in said
        assert str(out) in said
        thing.rmdir() if harm == "folder" else thing.unlink()
        assert main(command) == 0
    assert json.loads((out / "summary.json").read_text())["status"] == "complete"


def test_a_directory_in_which_another_run_is_at_work_is_left_to_it(study, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    command = ["run", str(study), "--out", str(out), "--quiet", "--no-report"]
    monkeypatch.setattr("workflows.run.run.SECONDS_TO_END", 0.1)
    out.mkdir()
    other = os.open(out, os.O_RDONLY)
    fcntl.flock(other, fcntl.LOCK_EX)
    assert main(command) == 2
    assert (
        capsys.readouterr().err == f"{out}: another run is at work there; wait for its end, or choose another --out\n"
    )
    assert not list(out.iterdir())
    os.close(other)
    assert main(command) == 0
    assert json.loads((out / "summary.json").read_text())["evaluations"] == 101
