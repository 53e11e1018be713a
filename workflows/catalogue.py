"""Words of what studies find, by the codes of findings."""

from forward.findings import Words, register

# Words that several share.
REFINED = (
    "The mesh was refined at the mean of the parameters, from {first:,} to {last:,} unknowns; the errors that it "
    "makes there are estimated to be {left}"
)
NOT_REACHED = (
    "accuracy.tolerance = {tolerance:g} is not reached: the {of} of {about} is known to {reached:.2g} (of the "
    "tolerance: {taken})."
)

TABLE: dict[str, str | Words] = {
    "draws-impossible": "{share:.2g} % of the draws of '{name}' are where the model is impossible ({objection}): "
    "these samples count as failed, and results are over the others.",
    "samples-inadmissible": "{share} of the samples are of materials that are not stable at rest (μ or κ is not "
    "positive): they count as failed, and results are over the others. A bounded distribution leaves them out.",
    "memory": "memory may run out: about {needed:,.0f} MiB are needed, {limit}",
    "memory-of-refinement": "the mesh is refined as far as memory allows: {needed}, {limit}",
    "averaged-without-mesh": "The error of the mesh is not estimated of averaged predictions: a study of one "
    "candidate tells it.",
    "averaged-shares": "Not to know which candidate is right makes up this share of the variance: {shares}.",
    "population-model-error": "The specimens have one model, whose errors, which the source learnt from each, are "
    "likely alike in all: they are taken as independent, and intervals of the mean do not hold what is shared.",
    "population-without": "{lost} of {of} data sets could not be inverted, and are not in the population: {specimens}.",
    "not-inverted": "{name} could not be inverted: {why}",
    "verdict": "{verdict}",
    "only-candidate": "{best} is the only candidate.",
    "best-of-bad": "Best of bad models: the residuals of {best} {wrong}.",
    "left-out-predicted": "Left-out data are predicted best by {other}.",
    "whole-tests-predicted": "Whole tests are predicted best, from the others, by {other}.",
    "specimens-disagree": "Specimens disagree: of {specimens}, {many} are rather {most} and {few} rather {fewer} "
    "({listed}); ln of the Bayes factor over one material for all: {factor}. Probabilities of the candidates are for "
    "one material of all specimens: compare them apart, or in two studies.",
    "evidence-untrusted": "Evidences not to be trusted: {where} ({verdict}).",
    "constants-of-laplace": "Constants are Laplace's, and not to be trusted: {where} ({verdict}).",
    "evidence-untrusted-for-meshes": "Evidences not to be trusted for what meshes do to them: {models}.",
    "order-depends": "With {variant}, {best} stays first but the order changes: {order}.",
    "winner-depends": "It depends: the most probable is {changed}.",
    "most-probable": "{best} is the most probable of the candidates, with {probability}; ln of the Bayes factor over "
    "{second}: {factor}, {grade}.",
    "mixture-predicted": "Left-out data are predicted best by a mixture (stacking): {parts}. Probabilities say which "
    'candidate is true, if one is; model = "stacked" of `from` predicts with the mixture.',
    "locking-measured": Words(
        "At the mean of the inputs, against {form} on the same mesh, which lock less: {about}.", between="; "
    ),
    "passes-through-itself": "{where}, the body passes through itself: at ({place}), before it is deformed, by {deep}. "
    "Parts of a body do not feel each other here, so that answers are those of a body that cannot be.",
    "surface-creases": "{where}, a free surface is {short:.0f} % shorter along itself, at ({place}) before it is "
    "deformed. From 35 % on a flat surface of soft matter folds into creases, which no mesh shows: what is computed is "
    "an equilibrium that is not observed.",
    "solves-inadmissible": "{lost:,} of {solves:,} solves were of parameters for which there is no model, as for the "
    "first of them ({reason}): their likelihood is zero, and they count as answered.",
    "uncertain-in-source": Words(
        "draws of {source} are of its parameters; what was uncertain beside them, {names}, is as stated here: "
        "parameters.from.names takes it too, as uncertain.PATH, as it errs together with them",
        short="",
    ),
    "constants-changed": "Constants are not those with which {source} was calibrated: {changed}.",
    "reduced-estimates-missing": "At {missing} of {samples} unseen samples the larger model that estimates errors is "
    "not stable, though the body is: there are no estimates, and with a tolerance the full model is asked.",
    "reduced-estimates-off": "Estimated errors of the reduced model are not its errors: estimated over true, and what "
    "corrections leave of the errors, on unseen samples, {off}. The sizes of errors on these samples are what can be "
    "trusted; with a larger method.more or more snapshots estimates may come closer.",
    "mesh-of-body": "The error of the mesh is not estimated: {why}; look at it with the body.",
    "no-mesh": "The error of the mesh is not estimated, as accuracy.mesh_error = true asks for: a model of kind "
    "'{kind}' has no mesh of its own.",
    "mesh-estimates-too-large": "The error of the mesh is not estimated: that would take about {memory:,.0f} MiB for "
    "each group of ranks, more than accuracy.memory = {limit:,.0f} MiB.",
    "mesh-estimates-few": "The error of the mesh is estimated at {points} points only: more would take over a fifth "
    "of the study, by prediction. What so few leave open is counted (mesh_error_doubt); more solves pay for more.",
    "mesh-with-memory": "The error of the mesh is not estimated with {what}: compare with a finer mesh.",
    "ratios-only": "No force acts on the specimen or is among the data, so displacements tell ratios of stiffnesses "
    "only: the absolute size of {sought} comes from {source}. Measure a force too (outputs of a load case).",
    "tolerance-without-mesh": "accuracy.tolerance does not count the error of the mesh: {why}.",
    "tolerance-without-mesh-of": "accuracy.tolerance does not count the error of the mesh in {about}, of which there "
    "is no estimate.",
    "tolerance-mesh-fixed": "accuracy.tolerance: the mesh {words}. If its error is too large for the tolerance, that "
    "will be said.",
    "mesh-estimates-contradict": "The estimates of the mesh error of {about} contradict each other: between meshes of "
    "{coarse:,} and {fine:,} unknowns its mean moved by {seen:.2g}, where they foresaw {foreseen:.2g}. The error of "
    "the corrected value may be larger than is said.",
    "tolerance-constants": "accuracy.tolerance = {tolerance:g} is not known to be reached: all samples of {about} are "
    "the same, so that what happens in up to {share:.2g} of all cases may be missed, and with it any part of mean and "
    "standard deviation. Leave a constant out of the outputs; to meet an event, give a [method] with many samples.",
    "tolerance-unseen": "The tolerance is kept as far as {n:,} solves tell: of a jump or a kink that none of them has "
    "met, in up to {share:.2g} of all cases, no error knows.",
    "field-truncated": "The modes of fields.{name} keep {kept} of its variance: what the others would add to the "
    "spread is in no number. More modes keep more, basis = 'noise' all.",
    "prior-inadmissible": "{share} of the prior is of materials that are not stable at rest (μ or κ is not positive): "
    "it has no weight, and the prior is scaled up where there is a material.",
    "mesh-refined": REFINED + ".",
    "mesh-refined-too-little": REFINED + ", above model.adapt.tolerance = {tolerance:g}: {why}.",
    "tolerance-solves": NOT_REACHED + " More solves than {limits} would be needed.",
    "tolerance-mesh-tried": NOT_REACHED + " {why}",
    "tolerance-mesh-unknown": "accuracy.tolerance = {tolerance:g} is not reached. The error of the mesh is not known; "
    "but for it, the {of} of {about} is known to {reached:.2g}.",
    "data-moved": Words("{points}{where} moved to its surface, by up to {farthest} (root mean square {rms})", short=""),
    "registered": Words("registered: {how}", short=""),
    "points-left-out": Words("{points} not belong to the body and are left out: {listed}{more}", short=""),
    "registration-undetermined": Words(
        "the registration does not determine {what}: left as at the start; what the data say then depends on it",
        short="",
    ),
    "prediction-doubtful": Words("{doubts}", short=""),
    "prediction-mesh": Words(
        "the mesh is estimated to move {about} standard deviations, which the intervals do not hold: a finer mesh "
        "helps, or add what is said of it",
        short="",
    ),
    "prediction-rough": Words(
        "the mean is known to {about} standard deviations only: more predict.samples reduce that", short=""
    ),
    "prediction-mesh-failed": Words("estimates of the error of the mesh failed of {about}", short=""),
    "prediction-mesh-unknown": Words("the error of the mesh is not estimated of {about}", short=""),
}
register(TABLE)
