"""Items as a user writes them, in a file beside a study: a cable, and a viscous branch."""

from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Unit

from forward.bodies.geometry import Vector
from forward.terms.acting import Acting, Entries, Kept
from forward.terms.term import Item


class Cable(Item):
    """A cable between two nodes: it pulls where it is longer than at rest, and is slack where it is shorter."""

    kind: str
    start: Vector
    end: Vector
    stiffness: Annotated[float, Ge(0), Unit("N")]  # per strain
    slack: Annotated[float, Gt(0), Unit("1")] = 1.0  # its length at rest, relative to the distance of its ends

    def acting(self, equations):
        return Pull(np.array([self.start, self.end]))

    def holds(self, body):
        along = tuple(np.subtract(self.end, self.start))
        return [(self.start, along), (self.end, tuple(-x for x in along))]


class Pull(Acting):
    def __init__(self, nodes):
        self.nodes = nodes
        self.distance = np.linalg.norm(nodes[1] - nodes[0])

    def now(self, now):
        """Length at rest, length, unit vector along it, strain."""
        rest, (start, end) = self.distance * now.numbers["slack"], self.nodes + now.state
        length = np.linalg.norm(end - start)
        return rest, length, (end - start) / length, max(length / rest - 1, 0.0)

    def forces(self, now):
        _, _, along, strain = self.now(now)
        return now.numbers["stiffness"] * strain * np.array([-along, along])

    def stiffness(self, now):
        rest, length, along, strain = self.now(now)
        pull, lines = now.numbers["stiffness"], np.outer(along, along)
        block = pull * (strain > 0) / rest * lines + pull * strain / length * (np.eye(3) - lines)
        return Entries.of(np.block([[block, -block], [-block, block]]))

    def by_number(self, now):
        rest, length, along, strain = self.now(now)
        apart = np.array([-along, along])
        by_slack = -now.numbers["stiffness"] * (strain > 0) * length / rest**2 * self.distance
        return {"stiffness": strain * apart, "slack": by_slack * apart}


class Branch(Item):
    """A viscous branch beside a box of hexahedra: stress 2G (ε − q) with q' = (ε − q)/tau, ε the means of cells."""

    kind: str
    G: Annotated[float, Ge(0), Unit("Pa")]
    tau: Annotated[float, Gt(0), Unit("s")]
    time: Annotated[float, Ge(0), Unit("s")] = 0.0  # has steps

    @property
    def remembers(self):
        return True

    def acting(self, equations):
        return Viscous(equations.spec.body)


class Viscous(Acting):
    def __init__(self, box):
        n, edges = np.array(box.cells), np.divide(box.size, box.cells)
        grid = np.indices(n + 1).reshape(3, -1).T
        self.nodes, self.volume = grid * edges, edges.prod()
        signs, cells = np.indices((2, 2, 2)).reshape(3, -1).T, np.indices(n).reshape(3, -1).T
        blocks = np.zeros((len(cells), 3, 3, *grid.shape))  # ε_ab of each cell by the displacements of all nodes
        for block, cell in zip(blocks, cells, strict=True):
            for sign in signs:
                slope, node = (2 * sign - 1) / (4 * edges), np.ravel_multi_index(cell + sign, n + 1)
                for a, b in np.ndindex(3, 3):
                    block[a, b, node, a] += slope[b] / 2
                    block[a, b, node, b] += slope[a] / 2
        self.strain = blocks.reshape(9 * len(cells), -1)

    def over(self, now):
        """What 1 + Δt/τ divides by, its derivative by τ, and ε less what was viscous before."""
        before = 0.0 if now.past is None else now.past.kept
        step = 0.0 if now.past is None else now.numbers["time"] - now.past.numbers["time"]
        share = 1 / (1 + step / now.numbers["tau"])
        return share, share**2 * step / now.numbers["tau"] ** 2, self.strain @ now.state.ravel() - before

    def forces(self, now):
        share, _, elastic = self.over(now)
        return (2 * now.numbers["G"] * self.volume * share * elastic @ self.strain).reshape(-1, 3)

    def stiffness(self, now):
        return Entries.of(2 * now.numbers["G"] * self.volume * self.over(now)[0] * self.strain.T @ self.strain)

    def by_number(self, now):
        share, by_tau, _ = self.over(now)
        forces = self.forces(now)
        return {"G": forces / now.numbers["G"], "tau": forces * by_tau / share}

    def by_past(self, now):
        return Entries.of(-2 * now.numbers["G"] * self.volume * self.over(now)[0] * self.strain.T)

    def kept(self, now):
        share, by_tau, elastic = self.over(now)
        strain = self.strain @ now.state.ravel()
        by_past = Entries.of(share * np.eye(len(strain)))
        return Kept(
            strain - share * elastic, Entries.of((1 - share) * self.strain), by_past, {"tau": -by_tau * elastic}
        )
