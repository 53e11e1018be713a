"""Words of what inversions find, by the codes of findings."""

from forward.findings import Words, register

# Words that several share.
CORRECTED = (
    "the error of the mesh, {size:.2g} standard deviations of the noise (at most {most:.2g}), was corrected, which "
    "moved the unknowns, in deviations of the posterior, by: {listed}; what is uncertain of it is among the errors "
    "of the data, and makes up to {uncertain:.2g} of these deviations"
)
MOVES = (
    "a finer mesh moves the data by {size:.2g} standard deviations of the noise (at most {most:.2g}) and the "
    "unknowns, in deviations of the posterior, by: {listed}"
)
REDUCED = "by {solves} full solves, draws of it have weights worth {share:.0f} % of their number, and"
DESIGN = (
    "The mesh is estimated to err by more than the noise at {off:,} of {size:,} candidates, {off_chosen} of the "
    "{chosen} chosen ones among them; at {worst} it errs by {times:.2g} times the noise"
)
FINER = "take a finer one, or thinner cells at held faces (body.grading)"

TABLE: dict[str, str | Words] = {
    "design-rank": "The chosen observations tell up to {missed:.2g} nat in directions beyond the {rank} that are "
    "kept, of {known:.3g}. Take a larger method.rank.",
    "design-no-answer-of-models": "There is no answer at some of {draws} draws, which are left out: {lost}.",
    "design-few-draws": "What {models} predict is known by few draws for so many unknowns: take more method.draws, at "
    "least {least}.",
    "design-no-answer": "The model has no answer at {lost} of {draws} draws, which are left out.",
    "design-repeats": "From observation {first} of {n} on, each adds less than {least:.2g} nat: they repeat what is "
    "known.",
    "design-depends": "What is best depends on the unknowns: at one of {draws} draws the chosen observations tell "
    "{shared:.3g} nat, those that are best there {own:.3g}. Measure some of them first, and choose the others with "
    "that posterior (parameters.from).",
    "population-redrawn": "Few draws of {specimens} lay where the population has its specimens, so they were drawn "
    "again under a prior like the population{often}.",
    "population-few-draws": "Few draws of {specimens} lie where the population has its specimens (effective sizes in "
    "parentheses): their estimates, and what they say of the population, are rough. {why}More samples in their own "
    "study, or a prior like the population there, help.",
    "population-worth": "The draws of the population are worth {worth}: its ends are rough.",
    "population-shared": "What the source states as uncertain is taken to err alike in all specimens: one deviation of "
    "{listed} of a specimen's posterior deviations. Intervals of the mean, the typical and a new specimen hold that; "
    "the spread is as if each erred by itself, and may be larger. What does so belongs in method.own.",
    "population-beyond": "New specimens would lie beyond the ends of the prior of {listed}, where none can be found: "
    "the population is not as normal there as it is taken to be, and its mean and spread err by more than they say. "
    "Widen the prior of the source; a number that is never negative is log-normal rather than normal.",
    "population-small": "{specimens} specimens say little on how wide the population is: its prior does.",
    "far-from-prior": Words(
        "the posterior of {name} ({value}) lies {distance:.1f} prior deviations from the prior ({centre}): the "
        "prior, the data or the model is wrong",
        short="{name} is {distance:.1f} prior deviations from its prior",
    ),
    "far-from-prior-together": Words(
        "all unknowns together lie farther from the prior than it allows: a squared distance of {square:.3g} in "
        "{degrees:.0f} directions that the data tell (probability {chance:.1g})",
        short="the prior does not allow it",
    ),
    "heavy-tail": Words(
        "{share:.0f} % of the variance of {name} come from the outermost 1 % of its probability (of a normal quantity "
        "8 %), which few points tell: take its interval, not its standard deviation",
        short="{name} has a heavy tail",
    ),
    "tails-cut": Words(
        "the polynomial that tells the posterior ends where solved points do, and {share:.1f} % of the posterior is "
        "next to an end: about as much is missing beyond, and intervals are too short; more points reach farther "
        "(method.samples)",
        short="too few points for its tails",
    ),
    "model-error-learnt": "errors of the model, learnt from {solves} solves of another one, are {size:.2g} standard "
    "deviations of the noise in the mean and uncertain by {spread:.2g} (root mean squares); they are among the errors "
    "of the data{same}",
    "little-seen": Words(
        "at {share:.0f} % of the vertices the data say next to nothing: there the standard deviation is above "
        "{unseen:g} of the prior's, and the value follows from prior and neighbours (smallest: {best}; largest: "
        "{least})",
        short="",
    ),
    "at-an-end": Words(
        "{name} is at the {end} end of its range ({value}): the data want it beyond, and its interval is cut off "
        "there; widen the range, or explain it",
        short="{name} is at the {end} end of its range",
    ),
    "model-explains-nothing": Words(
        "the inferred errors are {size:.0f} % of the data ({factor:.3g} times the stated ones): the model does not "
        "explain these data",
        short="the model explains no data",
    ),
    "noise-far": Words(
        "the inferred errors are {factor:.3g} times the stated ones: {cause}",
        short="the inferred errors are {factor:.3g} times the stated ones",
    ),
    "errors-too-large": Words(
        "residuals are {factor:.2g} times the stated errors: those are too large, and intervals too wide",
        short="the stated errors are too large",
    ),
    "strangers": Words(
        "{data} not belong to the other {others}, by residuals in standard deviations: {listed}{more}{advice}",
        short="{data} not belong to the others",
    ),
    "shared-expansion-off": Words(
        "the expansion that the data sets share, of {solves} solves, misses a datum by {off:.2g} of its error, to "
        "which that is added: intervals are wider than need be; raise method.expansion, or let every data set have "
        "solves of its own",
        short="the expansion that the data sets share is not accurate",
    ),
    "reduced-alike": Words(
        "the posterior by the reduced model is that of the body: "
        + REDUCED
        + " no mean moves by more than {shift:.2g} standard deviations ({name})",
        short="",
    ),
    "reduced-off": Words(
        "the posterior by the reduced model is not quite that of the body: "
        + REDUCED
        + (
            " the mean of {name} moves by {shift:.2g} standard deviations; reduce the body with more modes and "
            "snapshots, or leave method.reduced out"
        ),
        short="the reduced model does not give the posterior of the body",
    ),
    "mesh-not-checked": Words("not checked for the mesh: {why}", short="not checked for the mesh"),
    "mesh-moves-little": Words(MOVES, short=""),
    "mesh-too-coarse": Words(
        MOVES + ". The mesh is too coarse for the noise: " + FINER,
        short="its mesh is too coarse: unknowns move by {worst:.2g} deviations",
    ),
    "mesh-not-estimable": Words(
        "what the mesh does to {names} is not known: largest stresses and pressures and areas of contact follow "
        "single cells, and finer meshes show no limit of them; leave them out, or give them larger errors",
        short="the error of the mesh in {names} is not known",
    ),
    "mesh-corrected": Words(CORRECTED, short=""),
    "mesh-correction-unsettled": Words(
        CORRECTED + ". The correction has not settled: " + FINER,
        short="its mesh error has not settled",
    ),
    "mesh-correction-decides": Words(
        CORRECTED + ". It decides on the result: " + FINER,
        short="the correction of its mesh decides",
    ),
    "mesh-correction-of-field": Words(
        CORRECTED
        + (
            ". But that is more than was tested of fields on such meshes: what the data determine best may be off, "
            "single vertices less so; "
        )
        + FINER,
        short="its mesh is too coarse for what the data determine best",
    ),
    "mesh-correction-of-file": Words(
        CORRECTED
        + (
            ". But that is more than corrections of meshes from files were found to hold for: unknowns may be off "
            "by several of their deviations; take a finer one"
        ),
        short="the error of its mesh is larger than corrections of files hold for",
    ),
    "evidence-decided-by-meshes": Words(
        (
            "finer meshes move ln Z by: {listed}. On these {other} is the most probable, and not {best}: the "
            "meshes are too coarse to tell; "
        )
        + FINER,
        short="meshes decide",
    ),
    "evidence-settled": Words("finer meshes move ln Z by: {listed}; {best} stays the most probable", short=""),
    "evidence-moves": Words(
        (
            "finer meshes move ln Z by: {listed}; {best} stays the most probable. An evidence that moves by more "
            "than {limit:g} is not to be trusted: "
        )
        + FINER,
        short="meshes too coarse",
    ),
    "meshes-of-files": Words(
        "the corrected errors of the meshes of {models} are more than {limit:g} standard deviations of the noise, "
        "which is more than corrections of meshes from files were found to hold for: a mesh alone may make a "
        "candidate win or lose; take finer ones",
        short="meshes of files too coarse",
    ),
    "meshes-not-alike": Words(
        "the meshes of {corrected} are corrected, and those of {unknown} could not be looked at: their evidences "
        "do not compare, since a mesh alone may make a candidate win or lose",
        short="meshes are not corrected alike",
    ),
    "design-mesh-as-noise": DESIGN + ". This is counted as noise.",
    "design-mesh": DESIGN
    + (
        ": what they are said to tell needs a finer mesh, or an inversion that corrects the error as invert "
        "does; method.mesh_error = 'noise' counts it as noise."
    ),
    "taken-for-granted": Words("taken for granted: {listed}", short=""),
    "not-random": Words("taken for granted, at the mean and to first order: {listed}", short=""),
    "uncertain-bent": Words(
        "{name} is too uncertain for its first order: second order moves {answer} by {size:.2g} deviations; make it a "
        "parameter, with a normal prior",
        short="{name} is too uncertain for its first order",
    ),
    "uncertain-sampled": Words(
        "{listed}: sampled together with the parameters, since first order is not enough", short=""
    ),
    "called-for": Words(
        "the data call for {question} ({form}): ln Z is {gain} larger with it{also}, and {answer} {size:.2g} "
        "deviations {way}; a right model looks so with a probability of {probability:.2g}. Make it part of the model, "
        "or a candidate in select",
        short="the data call for {question}",
    ),
    "left-open": Words("what the data do not tell of may move answers: {listed}", short=""),
    "unexplained": Words(
        "what the model does not explain is taken to be a process among the errors, of {size} that vary over {length}",
        short="",
    ),
    "uncertain-off": Words(
        "the data say that {name} is {way} than stated by {size:.2g} of its deviations: it is known less well, or "
        "something else is wrong",
        short="{name} is not as stated",
    ),
    "motions": Words(
        "of {count} rigid motions that are uncertain, the data determine {seen} better than was known before{lost}",
        short="",
    ),
}
register(TABLE)
