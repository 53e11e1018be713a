"""Pieces of work that rank groups take: the first rank ends its wait whenever the last result arrives."""

from types import SimpleNamespace

from uq.evaluation import work_queue
from uq.evaluation.work_queue import WorkQueue


class World:
    """Two ranks, of which the other sends its result while the first one counts solves."""

    rank, size = 0, 2

    def __init__(self):
        self.arrived = []

    def iprobe(self, tag):
        return bool(self.arrived)

    def recv(self, tag):
        return self.arrived.pop()

    def barrier(self):
        return None


def test_a_result_that_arrives_while_solves_are_counted(monkeypatch):
    monkeypatch.setattr(work_queue, "SECONDS_BETWEEN_COUNTS", -1.0)
    world, taken = World(), iter([0, 2])

    class Solves:
        def add(self, count):
            if len(received) == 1:
                world.arrived.append((1, "theirs"))
            return 0

    received = []
    one = WorkQueue(
        world,
        SimpleNamespace(rank=0, size=1),
        0,
        lambda done, failed: None,
        (SimpleNamespace(add=lambda _: next(taken), reset=lambda: None), Solves(), SimpleNamespace(add=lambda _: 0)),
    )
    one.lead([0, 1], lambda piece: "own", lambda *result: received.append(result))
    assert received == [(0, "own", False), (1, "theirs", True)]
