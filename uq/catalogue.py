"""Words of what estimates and methods find, by the codes of findings."""

from forward.findings import Words, register

# Words that several share.
FEW = (
    " are worth {worth:.0f} independent ones, fewer than {fewest:.0f}: errors count that, but tails of the "
    "distribution are hardly known. More solves in the study that they come from, or a longer chain, help."
)
JUMPS = (
    "At {share} the branch of equilibria from rest ends before the whole load, and the body jumps{where}. The "
    "state taken there is stable, but where a body that jumps comes to rest is decided by its motion, which no "
    "statics know; just before the jump it has both states."
)
COMPARED = "The errors of the means took the work of {spent:,.0f} solves; others are predicted to need: {needed}."
NO_STATE = "{count} of {total} samples have no stable equilibrium, the body buckles there: {where}. "
NO_ANSWER = "{count} of {total} samples have no answer: {where}. "

TABLE: dict[str, str | Words] = {
    "tails-hopeless": "The standard deviation of {about} cannot be trusted: its {n} samples look log-normal, their "
    "logarithms have a standard deviation of {spread:.2g}, and most sets of so few samples miss the large values that "
    "determine it. Take many times more samples, or the logarithm as output.",
    "tails-log-normal": "The {n} samples of {about} look log-normal, their logarithms have a standard deviation of "
    "{spread:.2g}: few of them determine the standard deviation, and its 95 % interval may contain the true value "
    "less often. Take more samples.",
    "tails": "The standard deviation of {about} rests on few of its {n} samples, which count as {worth:.0f} (their "
    "kurtosis is {kurtosis:.3g}). Its 95 % interval may contain the true value less often, since larger values may be "
    "missing. Take more samples.",
    "tails-of-difference": "The standard deviation of {about} rests on few of the {n} samples of the difference "
    "between meshes {coarser} and {level}, which count as {worth:.0f}: its 95 % interval may contain the true value "
    "less often, since larger differences may be missing. Take more samples, or a finer coarsest mesh.",
    "quantiles-endless": "So few solves do not tell the quantiles of {levels} of {about}. Less than one is expected "
    "beyond them, and their intervals have no end on that side. Take more solves, or quantiles less far out.",
    "constant": "All {n} samples of {about} are {value:.6g}. If it is no constant, its mean and standard deviation "
    "leave out what happens in up to {unmet:.2g} of all cases, and so do their errors.",
    "tails-of-field": "The standard deviation of the displacements rests on few of the {n} samples in {share:.0%} of "
    "the body (their kurtosis is up to {kurtosis:.3g}): its 95 % intervals there may hold the truth less often, since "
    "larger values may be missing. More samples tell.",
    "control-dropped": "The {control} control of {about} increases the scatter, or hides more than it explains: its "
    "{dropped} {be} estimated without it.",
    "expansion-explains-nothing": "The expansion of {about} explains nothing: its error at samples left out of the "
    "fit is {error:.3g} of the standard deviation. Mean, standard deviation and quantiles are those of the {samples} "
    "samples; there are no Sobol' indices, and the expansion must not be used. Take more samples, or a method without "
    "an expansion.",
    "expansion-rough": "The error of the expansion of {about} is {error:.3g} of the standard deviation at samples "
    "left out of the fit. Mean, standard deviation and quantiles are those of the {samples} samples, with the "
    "expansion as control where it agrees with them; Sobol' indices and the expansion itself are rough.",
    "gradients-contradict": "The derivatives of {about} contradict its values, which differ from what they say by "
    "{share:.2g} of the standard deviation, more than the errors of the derivatives allow: the output has steps or "
    "jumps, or its derivatives are wrong. Fit values alone (method.gradients = false), or correct the derivatives.",
    "expansion-order": "The expansion of {about} has functions of order {order}, the highest that was tried, and "
    "leaves more than a few percent of the standard deviation: a higher max_order may explain more.",
    "expansion-shape": "According to the expansion, the standard deviation of {about} is decided in a small part of "
    "the range (where the variance counts as if it came from 1 of {kappa:.2g} samples), and its error at samples left "
    "out of the fit is {error:.2g} of the standard deviation: there it may be off by more than its error says. Take "
    "more samples.",
    "expansion-reach": "According to the expansion, {share:.0%} of the variance of {about} comes from parameters "
    "beyond all {samples} samples, and what it leaves out is about {error:.2g} of the standard deviation, which may "
    "be further off than its interval says. Take more samples.",
    "expansion-at-mean": "At the mean parameters, which are not part of the fit, the error of the expansion of "
    "{about} is {error:.2g}, but its leave-one-out error is {left:.2g}. The output may vary more between the samples "
    "than they show: take more.",
    "field-expansion-explains-nothing": "The expansion of the displacement field explains nothing: its error at "
    "samples left out of the fit is {rest:.2g} of the standard deviation. There are no Sobol' indices of the field, "
    "and its moments must not be used. Take more samples, or a method without an expansion.",
    "field-expansion-rough": "The error of the expansion of the displacement field is {rest:.2g} of its standard "
    "deviation: its moments, its Sobol' indices and fields predicted with it are rough. Take more samples.",
    "index-out-of-bounds": "{what} of {parameter} for {about}, {value:.3g}, is {excess} {limit:.3g}, by {times:.0f} "
    "standard errors. It is wrong: do not use it, and report it.",
    "indices-add-up": "The first-order indices for {about} add up to {total:.3g} ± {together:.2g}, more than 1. They "
    "are wrong: do not use them, and report it.",
    "only-rounding": "{about} {be} zero but for rounding, beside outputs of the same unit.",
    "draws-few": "The {n:,} draws of {names}" + FEW,
    "draws-few-of": "The {n:,} draws of {names} of {about}" + FEW,
    "no-stable-state": NO_STATE
    + "Estimates are of the stable branch only, that is, over the samples that have an answer.",
    "no-stable-state-continued": NO_STATE
    + (
        "The expansion continues beyond the end of the stable branch: its moments, quantiles and indices "
        "cannot be trusted. Keep the parameters where all samples have an answer, or give the body the "
        "imperfection or the small load that decides how it buckles."
    ),
    "no-answer": NO_ANSWER + "They are missing from the estimates, or are assumed to follow the control.",
    "no-answer-continued": NO_ANSWER
    + (
        "The expansion continues there smoothly, which neither samples nor errors cover: its moments, "
        "quantiles and indices hold only if the outputs do so too."
    ),
    "answers-missing": Words(
        "What has no answer may be up to {most:.2g} of all cases (95 %). If outputs there lay in the range of the "
        "others, means of all cases would be: {about}. Quantiles nearer to an end than that share are not known.",
        between="; ",
        listed=3,
    ),
    "stopped-on-the-way": "{count} of {total} samples stop on their way: at least the first {least} of {outputs} "
    "outputs of each are known and kept (`values`), but no estimate of any step counts these samples.",
    "screen-missed": "The screen of stability passed {missed} unstable {equilibria} that counting found: of the "
    "{screened} states that were only screened, some may be unstable too. Count all of them with model.solver.kind = "
    '"newton".',
    "jumps": JUMPS,
    "jumps-continued": JUMPS
    + (
        " The expansion is smooth where outputs jump: its moments, quantiles and indices cannot be trusted. "
        'Take plain samples (method.kind = "quasi-monte-carlo", control = "none").'
    ),
    "other-states": "At {share} at least, the body has another stable equilibrium, which was found first. The answers "
    "are those that raising the loads from zero leads to; a body with another history may be in the other one.",
    "fidelities-compared": COMPARED,
    "fidelities-not-worth": COMPARED + " The cheap models are not worth their cost here: take {instead}.",
    "fidelities-expansion-taken": COMPARED + " The expansion was taken in place of the cheap models.",
    "draws-decide": "The draws are worth {worth:,.0f} independent ones, which decides the error of the mean of "
    "{about}: more draws reduce it, more samples hardly.",
    "mesh-decides": Words(
        "The mesh, not the samples, decides how exact the means are: {about}. A finer mesh helps.",
        between="; ",
        listed=8,
    ),
    "mesh-unknown": "The error of the mesh is not known: {why}. What stands after ± does not hold it.",
    "mesh-estimates-disagree": Words(
        "Little more than the size of the error of the mesh is known for {about}: errors of several places cancel, "
        "and what is left of them is not seen well (mesh_error_doubt). A finer mesh makes it smaller.",
        listed=8,
    ),
    "mesh-error-varies": "The error of the mesh does not follow from a few estimates for {about}: it varies with the "
    "parameters, and its doubt is as large as it is. More solves allow more estimates; a finer mesh makes it smaller.",
    "solver-tolerance": "The solver's tolerance of {tolerance:g} may leave larger errors than the mesh in {about}: "
    "the error of the mesh is not known to better than that. Take a smaller model.solver.tolerance.",
    "mesh-estimates-failed": "{lost} of {n} estimates of the error of the mesh failed; {rest}. Why: {reason}.",
    "mesh-never-estimated": "The error of the mesh is not estimated of {about}: such outputs need not converge as "
    "cells become smaller (the largest stress at an edge that is held grows without limit).",
    "mesh-estimates-missing": "There is no estimate of the error of the mesh at some points of {about}, and so none "
    "of its effect: richer elements give no finite value there. Take more cells, or leave these outputs out.",
    "mesh-coarse": Words("The mesh is coarse: by estimate it errs by this much of the {what}: {about}.", listed=8),
    "mesh-error-left-out": "The error of the mesh is not estimated of {what}, which follow from more than outputs; "
    "that of the outputs says how large it may be.",
    "mesh-error-uncalibrated": "What part of the error of the mesh estimates see is not measured on a finer mesh, "
    "which would take too long for so few solves or too much memory, but typical: they are multiplied by "
    "{factor:.2g}, and half of them is doubted, or more where errors of several places cancel (mesh_error_doubt).",
    "facets": "Flat faces of cells on a curved surface change outputs by about this much: {about}. That is so at the "
    "mean parameters; estimates of the error of the mesh do not see it, nor does a mesh that is divided here, so it is "
    "part of their doubt (mesh_error_doubt). Mesh the body again with smaller cells.",
    "facets-unknown": "The surface is curved, and the faces of its cells are flat: the effect of what lies between is "
    "not known, since there is no answer with the surface moved by as much. Compare with smaller cells.",
    "unstable-on-finer-mesh": "The equilibrium at the mean parameters is stable on this mesh, but not on a finer "
    "one: the body buckles in a way that these cells are too large for. Refine the mesh before you use the numbers.",
    "facets-uncounted": "The surface is curved, and the faces of its cells are flat: what lies between is in no error "
    "of methods on several meshes, whose cells are parts of these. Others estimate it; or compare with smaller cells.",
    "solves-chosen": "Full solves were chosen where cheap models differ: {chosen:,} of {points:,} points, with "
    "probabilities from {least:.2g} to {most:.2g} that grow with the difference of '{first}' and '{second}', and "
    "weighted by their inverse. Another choice would change the errors, but not what is estimated.",
    "cheap-model-fails": "The cheap model '{model}' has no answer at {lost} of {asked} samples, and the study's model "
    "was asked at {few} of these: so few tell little of what is missed there, and errors may be too small. Leave it "
    "out, or take more samples.",
    "expansion-instead": "An expansion of the pilot leaves so little that, by prediction, the variance of the worst "
    "mean is {times} smaller than with the cheap models for the same cost: it is taken in their place.",
    "cheap-model-useless": "The cheap model '{model}' does not follow {beside} (squared correlations up to "
    "{square:.2g} in the pilot): it is of no use for these outputs.",
}
register(TABLE)
