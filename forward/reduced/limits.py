"""What of a body cannot be reduced."""

from __future__ import annotations

from collections.abc import Iterator

from forward.hyperelastic import Hyperelastic


def mistakes(spec: Hyperelastic) -> Iterator[str]:
    """Say what of a body cannot be reduced, one line each."""
    if spec.mixed:
        yield (
            "a reduced model has no mixed form yet, expected formulation = 'displacement' or a material with a smaller "
            "ratio of bulk to shear modulus"
        )
    tools = [load.label for load in spec.loads if load.contact]
    if tools:
        yield f"a reduced model has no contact yet, expected loads that are no tools: {', '.join(tools)}"
    known = {"displacement", "mean-displacement", "max-displacement", "reaction", "strain-energy", "volume-change"}
    known |= {"max-von-mises"}
    for output in spec.outputs:
        kind = str(getattr(output, "kind"))  # noqa: B009 - every output has a kind
        if kind not in known and "." not in kind:
            yield f"the output '{output.name}' of kind '{kind}' cannot be reduced"
