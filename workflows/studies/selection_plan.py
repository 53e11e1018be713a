"""What a comparison of models will cost."""

from __future__ import annotations

from typing import TYPE_CHECKING

from inverse.criticism.assessment import own_seconds
from workflows.studies.predictions import NOT_ASKED, duration

if TYPE_CHECKING:
    from workflows.studies.selection import Comparison

# What data of a quantity are called, and what they are of.
DATA = {
    "stress": ("stresses", "tests"),
    "displacement": ("displacements", "load cases"),
    "output": ("values", "outputs"),
}


def plan(study: Comparison) -> list[str]:
    """Say what is compared, and how long that will take."""
    method = study.method
    evidences = study.evidences
    sizes = {group: one.values.size for group, one in study.data_groups.items()}
    own = sum(
        own_seconds(len(study.candidates[name].parameters), sizes[group], method.samples) for name, group in study.pairs
    )
    seconds = study.seconds_of_solves + own * evidences / len(study.pairs)
    if method.chains == "hmc":
        seconds += len(study.pairs) * own_seconds(0, 0, 0, "hmc")
    meshes = study.mesh_checks
    if study.unchecked and method.treatment is None:
        meshes = [(0.0, NOT_ASKED)]
    seconds += sum(once for once, _ in meshes)
    check = " and nested sampling, which takes minutes" if method.check else ""
    data = study.data_groups.values()
    tests = sum(len(study.tests(group)) for group in study.group_names)
    among = f" in {len(data)} groups" if len(data) > 1 else ""
    kind, parts = DATA[study.data.quantity]
    count = f"{sum(one.values.size for one in data)} {kind} of {tests} {parts}"
    return [
        f"method      {method.kind}",
        f"candidates  {', '.join(f'{name} ({len(c.parameters)})' for name, c in study.candidates.items())}",
        f"data        {count}{among}",
        f"evidences   {evidences}{check}",
        *(f"mesh check  {words}" for words in dict.fromkeys(words for _, words in meshes)),
        f"solves      about {study.planned:,}",
        f"time        about {duration(seconds)} on 1 core (rough)",
    ]
