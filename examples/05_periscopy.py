"""What does a photograph of a plain wall show, once one knows what stands in front of it?

    python examples/05_periscopy.py mushroom_chair.npz docs/figures/periscopy_rules.png

A small chair between screen and wall casts shadows that differ from cell to cell; with the chair in the model
the wall turns into an image. No choice looks at the truth; "best regularization" does, to say what the choices
cost.
"""

import sys

import numpy as np

from evnlos.cli.invert import correlation
from evnlos.inverse import BackgroundModel, Gradient, Problem, prepare_inversion, read_photograph, tikhonov
from evnlos.inverse.tikhonov import Spectrum
from evnlos.plot.results import draw_inversion

if len(sys.argv) < 2:
    print("nothing done: give an NPZ file with a photograph, its geometry and its truth, see docs/inversion.md")
    sys.exit()
photograph = read_photograph(sys.argv[1])
inversion = prepare_inversion(photograph)
truth = photograph.truth
assert truth is not None
print("background degree  " + "  ".join(f"{d:8d}" for d in range(len(inversion.cv_errors))))
print(
    "error, left out    " + "  ".join(f"{e:8.1e}" for e in inversion.cv_errors), "-> degree", inversion.degree
)

panels, found = [("truth", truth)], {}
problem = Problem(inversion.operator, inversion.measurement, BackgroundModel(inversion.degree))
for name, prior in (("identity", None), ("gradient", Gradient("dark"))):
    spectrum = Spectrum(problem, prior)
    for rule in ("gcv", "cv"):
        solution = tikhonov(
            problem.operator,
            problem.measurement,
            rule=rule,
            prior=prior,
            background_model=problem.background_model,
        )
        r = found[name, rule] = correlation(solution.image, truth)
        panels.append((f"{name}, {rule}: r = {r:.3f}", solution.image))
        print(
            f"{name}, {rule}: regularization {solution.regularization:.1e}, {solution.dof:.0f} degrees of "
            f"freedom, r {r:.3f}"
        )
    best = max(correlation(spectrum.image(regularization), truth) for regularization in np.logspace(-7, -1, 61))
    print(f"{name}, best regularization by the truth: r {best:.3f}")

assert found["gradient", "cv"] >= 0.78
if len(sys.argv) > 2:
    print(draw_inversion(sys.argv[2], panels))
