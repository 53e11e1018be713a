"""What of a body cannot be reduced."""

from __future__ import annotations

from collections.abc import Iterator

from forward.loaded import LoadedBody


def mistakes(spec: LoadedBody) -> Iterator[str]:
    """Say what of a body cannot be reduced, one line each."""
    rubbing = [load.label for load in spec.loads if load.contact and not load.symmetric]
    if rubbing:
        yield (
            f"a reduced model has no friction, which depends on the way that a tool went, expected friction = 0 of "
            f"{', '.join(rubbing)}"
        )
    for load in (load for load in spec.loads if not load.written):
        yield f"the load '{load.label}' is no form and cannot be reduced, expected loads that are written as forms"
    known = {"displacement", "mean-displacement", "max-displacement", "reaction", "strain-energy", "volume-change"}
    known |= {"max-von-mises", "force", "contact-area"}
    for output in spec.outputs:
        kind = str(getattr(output, "kind"))  # noqa: B009 - every output has a kind
        if kind not in known and "." not in kind:
            yield f"the output '{output.name}' of kind '{kind}' cannot be reduced"
