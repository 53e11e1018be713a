"""Words of what specifications find, by the codes of findings."""

from forward.findings import Words, register

TABLE: dict[str, str | Words] = {
    "points-moved": "{moved} moved to its surface, by up to {far} ('{name}').",
    "inclusion-narrow": "inclusions.{label}.width = {wide} is below a cell ({cell}): few quadrature points see the "
    "transition, and derivatives by place and size are rough.",
    "answers-differ": "The model answers differently when it is asked again {where}: {listed}{more}. What it adds by "
    "chance, or keeps from call to call, counts as an effect of the parameters: fix the seed of its random numbers, "
    "or what it remembers.",
    "derivatives-contradicted": "The derivatives that the model states are not those of its values {where}: "
    "{said}{more}. What follows from derivatives (expansions, controls, local sensitivities, modes) is wrong: correct "
    "the jacobian, or leave it out.",
    "locking": "Displacements alone on {cells} lock at {where}: bodies a few cells across were too stiff by factors of "
    "{times}. These are a cantilever, Cook's membrane and a pressed block; with one cell across it is more. Take "
    "{cure}.",
    "followers": "The load {loads} follows the body, so that its stiffness is not symmetric. Stability is judged by "
    "the symmetric part, in which divergence (buckling) shows; flutter shows in no static test.",
    "reduced-body-fails": "The body had no answer at {lost} of the points at which it was solved for its reduced "
    "model, which may find an equilibrium there all the same{how}: how many samples fail, and whether a state is "
    "stable, can only be told by the body (model.tolerance asks it). Reduce it over a range in which it has answers.",
    "reduced-finds-none": "The reduced model finds no equilibrium at {lost} unseen samples at which the body has one; "
    "its errors are those at the others. More snapshots or modes help.",
    "reduced-extrapolates": "{path} goes from {first:.4g} to {last:.4g}, but the reduced model was trained from "
    "{low:.4g} to {high:.4g}: beyond, it is an extrapolation; reduce the body over the range that is needed.",
    "reduced-unmeasured": "Nobody has measured how far the reduced model is from its body: it was made without unseen "
    "samples, or without any that both could solve. Errors of all numbers are those of sampling alone; make it with "
    "method.unseen, 32 by default.",
    "reduced-errs": "On unseen samples the reduced model errs by {large} of the spread of these outputs (root mean "
    "square): more snapshots or modes help, or model.tolerance: then the full model is asked where estimates are "
    "large.",
    "paths-shared": "Without names, different numbers of several load cases share a path: {paths}. Each keeps its own "
    "value, but none can be a parameter: a name for each tells them apart.",
    "displacement-far": "{path} reaches {far}, more than the length of the body, {long}: is it given in another unit "
    "than metres?",
    "tool-small": "loads.{label} touches '{boundary}' over a radius of about {radius}, which is below the edges of "
    "the cells there ({cell}): its force may be a third too large, its pressure is rough. Refine the mesh "
    "there.",
    "tool-edge": "The edge of loads.{label} is rounded over {over}, less than the distance of the points at which "
    "contact is looked for on '{boundary}' ({apart}): where these pass it there are several equilibria, whose forces "
    "differ by up to 15 % on coarse meshes, and one of them is found. Refine the mesh there, or give it a rounder "
    "edge.",
    "tool-misses": "In some samples loads.{label} {what}: at {where}.",
    "spot-narrow": "loads.{label}.width = {wide} is below half the distance of nodes ({apart}): the mesh hardly sees "
    "the spot.",
    "spot-lost": "Only {share} of the force of loads.{label} acts on '{boundary}'{where}: the rest lies beyond it, and "
    "is lost.",
    "field-short": "fields.{label}.length = {length} is below a cell ({cell}). The field is linear between vertices: "
    "its means over parts of the body, and what follows from them, vary too much. Refine the mesh.",
    "body-size": "model.body.unit = {unit:g} makes the body {extent} long: is that meant? Coordinates in millimetres "
    "have unit = 1e-3",
    "slit": "The mesh has a closed slit of {area}{named}: faces that lie on each other with points of their own, which "
    "part under load, and pass through each other where they are pressed together. If it is meant, name its boundary "
    "in model.body.slits; if not, merge the double points of the file.",
}
register(TABLE)
