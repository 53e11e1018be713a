"""What was computed: the model, and its random parameters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from forward.words import number, settings
from workflows.report.blocks import Block, Heading, Pairs, Table
from workflows.report.section import Results, Section
from workflows.report.words import model_in_words


class Model(Section):
    """The model in words, and its random parameters."""

    def applies(self, results: Results) -> bool:
        """Whether one model was sampled or linearised."""
        return "nominal" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """The model block by block, and a table of distributions."""
        yield Heading("What was computed")
        yield Pairs(list(model_in_words(results.study)))
        yield parameters(results)


def parameters(results: Results) -> Table:
    """The random parameters and their distributions."""
    rows = []
    for name, distribution in results.study.given.items():
        block = distribution.model_dump()
        of_parameter = results.dataset.sel(parameter=name)
        mean, std = (number(float(of_parameter[f"parameter_{which}"])) for which in ("mean", "std"))
        rows.append((name, f"{block['kind']}: {settings(block, 'kind')}", mean, std, results.parameter_unit(name)))
    for field, count in Counter(path.split(".")[1] for path in results.study.model.coefficients).items():
        kept = float(results.dataset["variance_kept"].sel(random_field=field))
        law = f"independent standard normal; {100 * kept:.3g} % of the variance of the field"
        rows.append((f"fields.{field}.0 to {count - 1}", law, "0", "1", "1"))
    rows += [
        (" and ".join(c.between), f"joined by a Gaussian copula with correlation {c.value:g}", "", "", "")
        for c in results.study.correlations
    ]
    head = ("random parameter", "distribution", "mean", "standard deviation", "unit")
    return Table(head, rows, text=frozenset({0, 1, 4}))
