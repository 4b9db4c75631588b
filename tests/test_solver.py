"""The solvers against closed forms, slow references and each other."""

import math

import numpy as np
import pytest
import torch

from evnlos.errors import ConfigError, DataError
from evnlos.inverse import (
    BackgroundModel,
    Gradient,
    LogChange,
    Problem,
    block_folds,
    log_change,
    operator_norm,
    tikhonov,
    total_variation,
)
from evnlos.inverse.tikhonov import Spectrum
from evnlos.optics import LinearTransport, MatrixTransport, dense_matrix
from evnlos.types import Events, Plane
from transports import EXAMPLES

LINEAR = [name for name, make in EXAMPLES.items() if isinstance(make(), LinearTransport)]


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def random_operator(height: int = 5, width: int = 6, rows: tuple[int, int] = (8, 9), seed: int = 0):
    matrix = noise(rows[0] * rows[1], height * width, seed=seed) / 8
    return MatrixTransport(matrix, Plane(height, width, 0.01), rows)


def identity(height: int, width: int) -> MatrixTransport:
    return MatrixTransport(torch.eye(height * width).double(), Plane(height, width, 0.01), (height, width))


@pytest.mark.parametrize("border", ["free", "dark"])
@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (6, 5)])
def test_gradient_and_divergence_are_adjoint(border, shape):
    gradient = Gradient(border)
    x = noise(3, *shape)
    field = noise(*gradient(x).shape, seed=1)
    forward, backward = (gradient(x) * field).sum(), (x * gradient.adjoint(field)).sum()
    assert abs(forward - backward) <= 1e-12 * max(float(gradient(x).norm() * field.norm()), 1e-30)


def test_gradient_borders():
    flat = torch.ones(4, 5, dtype=torch.float64)
    assert Gradient("free")(flat).abs().max() == 0
    assert float(Gradient("dark")(flat).abs().sum()) == 2 * 4 + 2 * 5
    with pytest.raises(ConfigError, match="'free' or 'dark'"):
        Gradient("periodic")  # type: ignore[arg-type]


def test_operator_norm_and_dense_matrix():
    operator = random_operator()
    x = torch.zeros(5, 6, dtype=torch.float64)
    norm = operator_norm(operator, x, tolerance=1e-9, iterations=2000)
    assert norm == pytest.approx(float(torch.linalg.matrix_norm(operator.matrix, 2)), rel=1e-5)
    columns = dense_matrix(Gradient(), x) @ noise(30)
    torch.testing.assert_close(columns, Gradient()(noise(30).reshape(5, 6)).flatten())
    assert operator_norm(lambda v: 0 * v, x) == 0  # type: ignore[arg-type]


@pytest.mark.parametrize("name", LINEAR)
def test_tikhonov_solves_the_normal_equations_of_every_operator(name):
    operator = EXAMPLES[name]()
    assert isinstance(operator, LinearTransport)
    y = noise(2, *operator.shape)
    regularization = (
        1e-3 * operator_norm(operator, torch.zeros(operator.source.shape, dtype=torch.float64)) ** 2
    )
    x = tikhonov(operator, y, regularization).image
    left = operator.adjoint(operator(x) - y) + regularization * x
    assert left.norm() <= 1e-9 * operator.adjoint(y).norm()
    by_products = tikhonov(operator, y, regularization, method="cg", tolerance=1e-12)
    assert by_products.converged
    torch.testing.assert_close(by_products.image, x, rtol=1e-7, atol=1e-8 * float(x.abs().max()))


@pytest.mark.parametrize("prior", [None, Gradient("dark")])
def test_tikhonov_with_everything_equals_the_stacked_least_squares(prior):
    """Weights, background and prior at once, against one big least-squares solve with the polynomials in it."""
    operator, y = random_operator(), noise(3, 8, 9, seed=1)
    weight = torch.rand(8, 9, generator=torch.Generator().manual_seed(2), dtype=torch.float64) + 0.1
    weight[0, :4] = 0
    background_model, regularization = BackgroundModel(2), 0.05
    found = tikhonov(operator, y, regularization, prior=prior, background_model=background_model, weight=weight)
    steps = torch.eye(30).double() if prior is None else dense_matrix(prior, y.new_zeros(5, 6))
    extra = background_model.polynomials((8, 9)).flatten(1).mT
    top = weight.flatten()[:, None] * torch.cat([operator.matrix, extra], 1)
    stacked = torch.cat(
        [top, math.sqrt(regularization) * torch.cat([steps, steps.new_zeros(len(steps), 6)], 1)]
    )
    right = torch.cat([(weight * y).flatten(1).mT, y.new_zeros(len(steps), 3)])
    expected = torch.linalg.lstsq(stacked, right).solution[:30].mT.reshape(3, 5, 6)
    torch.testing.assert_close(found.image, expected, rtol=1e-9, atol=1e-10)
    again = tikhonov(
        operator,
        y,
        regularization,
        prior=prior,
        background_model=background_model,
        weight=weight,
        method="cg",
        tolerance=1e-12,
    )
    torch.testing.assert_close(again.image, expected, rtol=1e-7, atol=1e-9)
    problem = Problem(operator, y, background_model, weight)
    torch.testing.assert_close(found.residual, (problem(expected) - problem.target).flatten(1).norm(dim=1))


def test_batch_equals_loop_and_inputs_stay():
    operator, y = random_operator(), noise(4, 8, 9)
    before = y.clone()
    together = tikhonov(operator, y, 0.1, background_model=BackgroundModel(1)).image
    for k in range(4):
        torch.testing.assert_close(
            together[k], tikhonov(operator, y[k], 0.1, background_model=BackgroundModel(1)).image
        )
    assert torch.equal(y, before)


def test_a_smooth_background_changes_nothing_once_projected_out():
    operator, y = random_operator(), noise(8, 9)
    v, u = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) / 8 for n in (8, 9)), indexing="ij")
    light = 5 + 2 * u - v + u * v + 3 * v**2
    for solve in (tikhonov, total_variation):
        plain, lit = (
            solve(operator, one, 0.1, background_model=BackgroundModel(2)).image for one in (y, y + light)
        )
        torch.testing.assert_close(plain, lit, rtol=1e-8, atol=1e-9)


def test_problem_is_an_operator_with_an_adjoint():
    weight = torch.rand(8, 9, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    problem = Problem(random_operator(), noise(8, 9), BackgroundModel(3), weight)
    x, y = noise(5, 6, seed=3), noise(8, 9, seed=4)
    assert float((problem(x) * y).sum()) == pytest.approx(float((x * problem.adjoint(y)).sum()), rel=1e-12)
    torch.testing.assert_close((problem.matrix @ x.flatten()).reshape(8, 9), problem(x))
    assert problem.samples == 72 - 10


def blurred_scene(sigma: float = 0.01):
    """A Gaussian blur of a square, with noise of known strength."""
    i = torch.arange(12, dtype=torch.float64)
    row = torch.exp(-((i[:, None] - i) ** 2) / 4)
    matrix = torch.kron(row / row.sum(1, keepdim=True), row / row.sum(1, keepdim=True))
    truth = torch.zeros(12, 12, dtype=torch.float64)
    truth[3:8, 4:9] = 1
    operator = MatrixTransport(matrix, Plane(12, 12, 0.01), (12, 12))
    return operator, truth, operator(truth) + sigma * noise(12, 12, seed=7)


def test_gcv_is_leave_one_out_in_spirit_and_near_the_best():
    """GCV's own definition by the influence matrix, and regularization within the reach of the best one by the
    truth.
    """
    operator, truth, y = blurred_scene()
    spectrum, regularization = Spectrum(Problem(operator, y)), 1e-3
    normal = operator.matrix.mT @ operator.matrix + regularization * torch.eye(144).double()
    influence = operator.matrix @ torch.linalg.solve(normal, operator.matrix.mT)
    left = (y.flatten() - influence @ y.flatten()).square().sum()
    assert spectrum.gcv(regularization) == pytest.approx(
        float(144 * left / (144 - influence.trace()) ** 2), rel=1e-9
    )
    assert spectrum.dof(regularization) == pytest.approx(float(influence.trace()), rel=1e-9)
    found = tikhonov(operator, y)
    assert all(
        spectrum.gcv(found.regularization) <= spectrum.gcv(found.regularization * f)
        for f in (0.8, 1.25, 10, 0.1)
    )
    best = min(float((spectrum.image(x) - truth).norm()) for x in np.logspace(-8, 1, 91))
    assert float((found.image - truth).norm()) < 1.15 * best
    assert found.noise_sigma == pytest.approx(0.01, rel=0.25)


def test_discrepancy_meets_the_noise():
    operator, _, y = blurred_scene()
    for method in ("svd", "cg"):
        found = tikhonov(operator, y, rule="discrepancy", noise_sigma=0.01, method=method)
        assert float(found.residual) == pytest.approx(0.01 * 12, rel=2e-3)
    with pytest.raises(DataError, match="another noise_sigma"):
        tikhonov(operator, y, rule="discrepancy", noise_sigma=100.0)


def test_stochastic_gcv_is_near_the_exact_one_and_repeats():
    operator, truth, y = blurred_scene()
    exact, guess = tikhonov(operator, y), tikhonov(operator, y, method="cg", seed=3)
    assert guess.regularization == tikhonov(operator, y, method="cg", seed=3).regularization
    assert float((guess.image - truth).norm()) < 1.1 * float((exact.image - truth).norm())


def test_cross_validation_resists_errors_that_neighbours_share():
    """GCV takes a noise that is alike over 3 x 3 samples for signal; leaving out blocks does not."""
    fine, cell = torch.arange(30, dtype=torch.float64)[:, None], torch.arange(10, dtype=torch.float64)
    row = torch.exp(-((fine - 3 * cell - 1) ** 2) / 18)
    operator = MatrixTransport(torch.kron(row, row) / 19, Plane(10, 10, 0.01), (30, 30))
    truth = torch.zeros(10, 10, dtype=torch.float64)
    truth[3:7, 3:8] = 1
    rough = torch.nn.functional.avg_pool2d(noise(1, 32, 32, seed=9), 3, stride=1)[0]
    y = operator(truth) + 0.02 * rough / rough.std()
    gcv, cv = tikhonov(operator, y), tikhonov(operator, y, rule="cv")
    assert cv.regularization > 3 * gcv.regularization
    assert float((cv.image - truth).norm()) < 0.9 * float((gcv.image - truth).norm())


def test_block_folds_are_even():
    folds = block_folds((42, 42))
    assert folds.shape == (42, 42)
    assert torch.bincount(folds.flatten()).tolist() == [441] * 4
    with pytest.raises(ConfigError, match="blocks"):
        block_folds((3, 3))


# --- total variation ------------------------------------------------------------------------------


def taut_string(y: np.ndarray, regularization: float) -> np.ndarray:
    """Return the exact minimiser of |x - y|^2 / 2 + regularization sum |x[i+1] - x[i]| through its dual, by
    brute force.

    The dual is a box-constrained least-squares problem; active sets are tried until the conditions hold.
    """
    n = len(y)
    d = np.diff(np.eye(n), axis=0)
    p = np.zeros(n - 1)
    step = 1 / 4
    for _ in range(200_000):  # projected gradient on the dual, to machine precision
        new = np.clip(p + step * d @ (y - d.T @ p), -regularization, regularization)
        if np.abs(new - p).max() < 1e-15:
            break
        p = new
    return y - d.T @ p


@pytest.mark.parametrize("method", ["splitting", "primal-dual"])
def test_total_variation_of_a_line_equals_the_exact_answer(method):
    y = noise(1, 12, seed=5)
    expected = taut_string(y[0].numpy(), 0.4)
    found = total_variation(
        identity(1, 12), y, 0.4, box=(-math.inf, math.inf), tolerance=1e-9, method=method, max_iterations=20_000
    )
    assert found.converged
    assert np.abs(found.image[0].numpy() - expected).max() < 1e-4


def test_bounds_equal_the_active_set_answer():
    """With next to no variation term it is bounded least squares: active sets find it too."""
    from scipy.optimize import lsq_linear

    operator, y = random_operator(3, 3, (4, 5)), 2 * noise(4, 5, seed=1)
    expected = lsq_linear(operator.matrix.numpy(), y.flatten().numpy(), (0, 1), method="bvls", tol=1e-14).x
    assert ((expected == 0) | (expected == 1)).any()
    for method in ("splitting", "primal-dual"):
        found = total_variation(
            operator, y, 1e-9, box=(0.0, 1.0), tolerance=1e-10, method=method, max_iterations=50_000
        )
        assert found.converged
        assert np.abs(found.image.flatten().numpy() - expected).max() < 1e-3


@pytest.mark.parametrize("border", ["free", "dark"])
@pytest.mark.parametrize("box", [(0.0, 1.0), (0.0, math.inf), (-math.inf, math.inf)])
def test_the_two_methods_agree(border, box):
    operator, _, y = blurred_scene()
    batch = torch.stack([y, y.mT])
    options = {
        "border": border,
        "box": box,
        "tolerance": 1e-6,
        "background_model": BackgroundModel(0),
        "max_iterations": 50_000,
    }
    one, two = (
        total_variation(operator, batch, 0.005, method=m, **options) for m in ("splitting", "primal-dual")
    )
    assert one.converged
    assert two.converged

    def objective(x):
        problem = Problem(operator, batch, BackgroundModel(0))
        edges = Gradient(border)(x).square().sum(-3).sqrt().sum()
        return 0.5 * float((problem(x) - problem.target).square().sum()) + 0.005 * float(edges)

    assert objective(one.image) == pytest.approx(objective(two.image), rel=1e-4)
    assert float(one.image.min()) >= box[0]
    assert float(two.image.max()) <= box[1]
    assert one.history[-1] <= 1e-6
    assert min(one.history) >= -1e-9  # a gap is never negative


def test_total_variation_beats_tikhonov_on_a_square():
    operator, truth, y = blurred_scene()
    smooth = tikhonov(operator, y, prior=Gradient("dark"))
    sharp = total_variation(operator, y, rule="discrepancy", noise_sigma=smooth.noise_sigma)
    checked = total_variation(operator, y, rule="cv", border="dark")
    assert float((sharp.image - truth).norm()) < 0.8 * float((smooth.image - truth).norm())
    assert float((checked.image - truth).norm()) < 0.8 * float((smooth.image - truth).norm())


# --- the event channel ----------------------------------------------------------------------------


@pytest.mark.parametrize("shift", [None, (1, 0), (-2, 1), (9, 9)])
def test_log_change_has_an_adjoint(shift):
    operator = LogChange(random_operator(), 1 + noise(8, 9).abs(), shift)
    x, y = noise(5, 6, seed=1), noise(8, 9, seed=2)
    forward, backward = float((operator(x) * y).sum()), float((x * operator.adjoint(y)).sum())
    assert forward == pytest.approx(backward, rel=1e-12, abs=1e-15)


def test_log_change_is_the_derivative_of_the_logarithm():
    operator, light = random_operator(), 1 + noise(8, 9).abs()
    dx = noise(5, 6)
    errors = []
    for size in (1e-2, 1e-3):
        exact = torch.log((light + operator(size * dx)) / light)
        errors.append(float((LogChange(operator, light)(size * dx) - exact).abs().max()) / size)
    assert errors[1] == pytest.approx(errors[0] / 10, rel=0.1)  # first order


def test_log_change_counts_thresholds():
    from evnlos.cameras import EventPixel

    events = Events([1, 2, 9], [0, 0, 1], [0, 0, 1], [True, True, False], 2, 2)
    found = log_change(events, [0, 5, 10], EventPixel(threshold_on=0.2, threshold_off=0.1))
    torch.testing.assert_close(found[0], torch.tensor([[0.4, 0.0], [0.0, 0.0]]))
    torch.testing.assert_close(found[1], torch.tensor([[0.0, 0.0], [0.0, -0.1]]))


@pytest.mark.parametrize(
    ("error", "match", "make"),
    [
        (ConfigError, "regularization is -1", lambda: tikhonov(random_operator(), noise(8, 9), -1)),
        (ConfigError, "rule is", lambda: tikhonov(random_operator(), noise(8, 9), rule="lcurve")),
        (ConfigError, "method is", lambda: tikhonov(random_operator(), noise(8, 9), method="qr")),
        (ConfigError, "positive one", lambda: tikhonov(random_operator(), noise(8, 9), rule="discrepancy")),
        (ConfigError, "hundreds", lambda: tikhonov(random_operator(), noise(8, 9), rule="cv", method="cg")),
        (ConfigError, "null space", lambda: tikhonov(random_operator(), noise(8, 9), 1.0, prior=Gradient())),
        (DataError, "NaN", lambda: tikhonov(random_operator(), noise(8, 9) * math.nan, 1.0)),
        (DataError, "real numbers", lambda: tikhonov(random_operator(), torch.zeros(8, 9).long(), 1.0)),
        (DataError, "takes", lambda: tikhonov(random_operator(), noise(8, 8), 1.0)),
        (DataError, "weight is", lambda: tikhonov(random_operator(), noise(8, 9), 1.0, weight=torch.ones(3))),
        (DataError, "samples are left", lambda: Problem(identity(2, 2), noise(2, 2), BackgroundModel(3))),
        (ConfigError, "degree is 13", lambda: BackgroundModel(13)),
        (ConfigError, "regularization is 0", lambda: total_variation(identity(2, 2), noise(2, 2), 0.0)),
        (ConfigError, "box is", lambda: total_variation(identity(2, 2), noise(2, 2), 1.0, box=(1.0, 0.0))),
        (ConfigError, "method is", lambda: total_variation(identity(2, 2), noise(2, 2), 1.0, method="x")),
        (ConfigError, "rule is", lambda: total_variation(identity(2, 2), noise(2, 2), rule="gcv")),
        (ConfigError, "positive one", lambda: total_variation(identity(9, 9), noise(9, 9), rule="discrepancy")),
        (ConfigError, "at rest", lambda: LogChange(identity(2, 2), torch.ones(2, 2), (0, 0))),
        (DataError, "ambient", lambda: LogChange(identity(2, 2), torch.zeros(2, 2))),
    ],
)
def test_bad_input(error, match, make):
    with pytest.raises(error, match=match):
        make()
