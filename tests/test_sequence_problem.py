"""One target from many positions: the compressed problem is the stacked one; what rests does not disturb it."""

import numpy as np
import pytest
import torch

from evnlos.errors import ConfigError, DataError
from evnlos.inverse import Gradient, SequenceOperator, SequenceProblem, SeveralSequences, total_variation
from evnlos.inverse.operators import normal_matrix
from evnlos.inverse.sequence_problem import matrix_of, position_subsets, strip_gram_of, strip_of
from evnlos.optics import MatrixTransport
from evnlos.scene import Target
from evnlos.setups import RadiometricSetup
from evnlos.types import Plane

TARGET_PLANE = Plane(4, 4, 0.01)
POSITIONS = np.array([(-0.02, 0.0), (0.003, 0.004), (0.021, -0.003)])
STRIP = strip_of(POSITIONS, TARGET_PLANE)
SHAPE = (5, 7)


@pytest.fixture(scope="module")
def sight() -> SequenceOperator:
    generator = torch.Generator().manual_seed(3)
    matrix = torch.rand(35, STRIP.height * STRIP.width, generator=generator, dtype=torch.float64)
    return SequenceOperator(MatrixTransport(matrix, STRIP, SHAPE), TARGET_PLANE, POSITIONS)


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def stacked(sight: SequenceOperator) -> torch.Tensor:
    """The whole sequence as a matrix [N P, n n], column by column."""
    return sight(torch.eye(16, dtype=torch.float64).reshape(16, 4, 4)).flatten(1).mT


def precision(static: float) -> torch.Tensor:
    """C^-1 over three positions: independent noise of variance 1, one offset of variance static^2."""
    eye = torch.eye(3, dtype=torch.float64)
    if static == np.inf:
        return eye - 1 / 3
    return torch.linalg.inv(eye + static**2)


def test_adjoint(sight) -> None:
    x, y = random(2, 4, 4), random(2, 3, *SHAPE, seed=1)
    torch.testing.assert_close((sight(x) * y).sum(), (x * sight.adjoint(y)).sum(), rtol=1e-12, atol=0)


def test_the_strip_is_drawn_as_the_target_draws_itself(sight) -> None:
    mask = random(4, 4).float()
    drawn = Target("target", mask.numpy(), 0.04).rasterise(STRIP, POSITIONS)
    torch.testing.assert_close(sight.drawn(mask.double()).float(), torch.from_numpy(drawn), rtol=0, atol=2e-7)


@pytest.mark.parametrize("static", [0.0, 0.7, np.inf])
def test_gram_and_solution_are_those_of_the_stacked_problem(sight, static) -> None:
    whole = stacked(sight)
    weight = torch.kron(precision(static).contiguous(), torch.eye(35, dtype=torch.float64))
    problem = SequenceProblem(sight, static)
    torch.testing.assert_close(problem.gram, whole.mT @ weight @ whole, rtol=1e-9, atol=1e-9)
    images, regularization = random(3, *SHAPE, seed=2), 0.3
    smooth = normal_matrix(Gradient("dark"), torch.zeros(4, 4, dtype=torch.float64))
    expected = torch.linalg.solve(
        whole.mT @ weight @ whole + regularization * smooth, whole.mT @ weight @ images.flatten()
    )
    found = problem.tikhonov(images, regularization)
    torch.testing.assert_close(found.image.flatten(), expected, rtol=1e-8, atol=1e-8)
    left = images.flatten() - whole @ expected
    assert float(found.residual) == pytest.approx(float(left @ weight @ left) ** 0.5, rel=1e-8)


def test_batch_equals_loop(sight) -> None:
    images, problem = random(2, 3, *SHAPE, seed=4), SequenceProblem(sight, 0.5)
    both = problem.tikhonov(images, 0.1).image
    for k in range(2):
        torch.testing.assert_close(both[k], problem.tikhonov(images[k], 0.1).image)


def test_what_rests_says_nothing(sight) -> None:
    images, still = random(3, *SHAPE, seed=5), random(*SHAPE, seed=6)
    problem = SequenceProblem(sight, np.inf)
    torch.testing.assert_close(
        problem.tikhonov(images, 0.1).image,
        problem.tikhonov(images + 5 * still, 0.1).image,
        rtol=1e-8,
        atol=1e-8,
    )


def test_gcv_finds_the_weight_where_the_noise_is_white(sight) -> None:
    """Against the best weight on a grid, with noise that dominates the small modes."""
    generator = torch.Generator().manual_seed(1)
    target = random(4, 4, seed=7)
    clean = sight(target)
    noisy = clean + 0.3 * torch.randn(clean.shape, generator=generator, dtype=torch.float64)
    problem = SequenceProblem(sight)
    chosen = problem.tikhonov(noisy)

    def risk(regularization: float) -> float:
        return float((sight(problem.tikhonov(noisy, regularization).image) - clean).square().sum())

    assert risk(chosen.regularization) < 1.3 * min(
        risk(float(regularization)) for regularization in np.logspace(-4, 3, 30)
    )
    assert chosen.noise_sigma == pytest.approx(0.3, rel=0.2)


def test_total_variation_is_that_of_one_image(sight) -> None:
    one = SequenceOperator(sight.transport, TARGET_PLANE, POSITIONS[:1])
    images = one(random(4, 4, seed=8)) + 0.1 * random(1, *SHAPE, seed=9)
    operator = MatrixTransport(one(torch.eye(16).double().reshape(16, 4, 4)).flatten(1).mT, TARGET_PLANE, SHAPE)
    expected = total_variation(operator, images[0], 0.05, box=(0.0, 1.0), border="dark", tolerance=1e-4)
    found = SequenceProblem(one).total_variation(images, 0.05, tolerance=1e-4)
    assert found.converged and expected.converged

    def objective(image: torch.Tensor) -> float:
        edges = Gradient("dark")(image).square().sum(dim=0).sqrt().sum()
        return float(0.5 * (operator(image) - images[0]).square().sum() + 0.05 * edges)

    # Each is within the gap of the least value.
    assert abs(objective(found.image) - objective(expected.image)) < 1e-4 * float(images.square().sum())
    assert objective(found.image) < 0.9 * objective(torch.zeros(4, 4, dtype=torch.float64))
    assert float(found.residual) == pytest.approx(float((operator(found.image) - images[0]).norm()), rel=1e-6)


def test_a_sequence_shows_more_than_an_image() -> None:
    setup = RadiometricSetup(roughness=0.05, cell_m=0.01, gain=1.0)
    target_plane = Plane(10, 10, 0.008)
    positions = np.stack([np.linspace(-0.06, 0.06, 8), np.zeros(8)], axis=1)
    transport = matrix_of(setup.resized((16, 24)).operator(strip_of(positions, target_plane), (16, 24)))
    truth = torch.zeros(10, 10, dtype=torch.float64)
    truth[2:8, 2:4] = truth[6:8, 2:8] = 1
    generator = torch.Generator().manual_seed(0)
    gram, error = strip_gram_of(transport), {}
    for count in (1, 8):
        sight = SequenceOperator(transport, target_plane, positions[:count])
        clean = sight(truth)
        noisy = clean + 5e-3 * torch.randn(clean.shape, generator=generator, dtype=torch.float64)
        found = SequenceProblem(sight, 0.0, gram).tikhonov(noisy, 4 * 5e-3**2)
        error[count] = float((found.image - truth).square().mean())
    assert error[8] < 0.9 * error[1]


def test_white_levels_are_the_setups() -> None:
    """A strip of other cells at a smaller size shows a target as bright as the setup's own wall does."""
    setup = RadiometricSetup(roughness=0.08, cell_m=0.008, gain=0.9)
    lit = torch.ones(10, 10, dtype=torch.float64)
    target_plane, place = Plane(10, 10, 0.008), np.array([(0.01, 0.0)])
    small = matrix_of(setup.resized((20, 32)).operator(strip_of(place, target_plane), (10, 16)))
    own = setup.transport((20, 32))
    wall = setup.gain * own(torch.from_numpy(Target("square", np.ones((4, 4))).rasterise(own.source, place[0])))
    wall = wall.unflatten(0, (10, 2)).unflatten(2, (16, 2)).mean(dim=(1, 3))
    torch.testing.assert_close(
        SequenceOperator(small, target_plane, place)(lit)[0].float(), wall, rtol=0.03, atol=0.01
    )


def test_position_subsets_are_equally_spaced() -> None:
    assert [one.tolist() for one in position_subsets(6, 3, 5)] == [[0, 2, 4], [1, 3, 5]]
    assert [one.tolist() for one in position_subsets(4, 4, 3)] == [[0, 1, 2, 3]]


def test_wrong_input_is_named(sight) -> None:
    problem = SequenceProblem(sight)
    with pytest.raises(DataError, match="real"):
        problem.tikhonov(random(2, *SHAPE))
    with pytest.raises(DataError, match="NaN"):
        problem.tikhonov(torch.full((3, *SHAPE), torch.nan))
    with pytest.raises(ConfigError, match="regularization is -1"):
        problem.tikhonov(random(3, *SHAPE), -1.0)
    with pytest.raises(ConfigError, match=r"static is -0\.5"):
        SequenceProblem(sight, -0.5)
    with pytest.raises(DataError, match="off the strip"):
        SequenceOperator(sight.transport, TARGET_PLANE, np.array([(1.0, 0.0)]))
    with pytest.raises(DataError, match="shape"):
        SequenceOperator(sight.transport, TARGET_PLANE, np.zeros(2))
    with pytest.raises(DataError, match="nothing of the target"):
        SequenceProblem(SequenceOperator(sight.transport, TARGET_PLANE, POSITIONS[:1]), np.inf)
    with pytest.raises(ConfigError, match="7 positions of 6"):
        position_subsets(6, 7, 1)


def test_the_dense_map_of_a_sequence_is_the_sequence(sight) -> None:
    target = torch.rand(TARGET_PLANE.shape, dtype=sight.transport.matrix.dtype)
    dense = sight.matrix()
    assert dense.shape == (len(sight), SHAPE[0] * SHAPE[1], TARGET_PLANE.height * TARGET_PLANE.width)
    torch.testing.assert_close((dense @ target.flatten()).unflatten(1, SHAPE), sight(target))


@pytest.mark.parametrize("static", [0.0, 0.7, np.inf])
def test_several_targets_are_solved_for_as_the_stacked_problem_is(sight, static) -> None:
    other = SequenceOperator(
        sight.transport, TARGET_PLANE, np.array([(0.01, 0.004), (0.0, 0.0), (-0.02, -0.004)])
    )
    both = SeveralSequences((sight, other))
    whole = torch.cat([stacked(sight), stacked(other)], dim=1)
    x, images = random(2, 2, 4, 4, seed=5), random(2, 3, *SHAPE, seed=6)
    torch.testing.assert_close(both(x).flatten(1), x.flatten(1) @ whole.mT, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close((both(x) * images).sum(), (x * both.adjoint(images)).sum(), rtol=1e-12, atol=0)
    weight = torch.kron(precision(static).contiguous(), torch.eye(35, dtype=torch.float64))
    problem = SequenceProblem(both, static)
    torch.testing.assert_close(problem.gram, whole.mT @ weight @ whole, rtol=1e-10, atol=1e-10)
    smooth = normal_matrix(Gradient("dark"), torch.zeros(4, 4, dtype=torch.float64))
    normal = problem.gram + 0.3 * torch.block_diag(smooth, smooth)
    expected = torch.linalg.solve(normal, whole.mT @ weight @ images.flatten(1).mT)  # [K n n, B]
    found = problem.tikhonov(images, 0.3)
    torch.testing.assert_close(found.image, expected.mT.reshape(2, 2, 4, 4), rtol=1e-7, atol=1e-9)
    left = images.flatten(1).mT - whole @ expected
    torch.testing.assert_close(
        found.residual.square(), (left * (weight @ left)).sum(dim=0), rtol=1e-6, atol=1e-9
    )
    assert problem.tikhonov(images).regularization > 0  # by generalised cross-validation


def test_several_targets_that_do_not_fit_together_are_refused(sight) -> None:
    short = SequenceOperator(sight.transport, TARGET_PLANE, POSITIONS[:2])
    with pytest.raises(DataError, match="2 targets differ"):
        SeveralSequences((sight, short))
    with pytest.raises(ConfigError, match="2 targets; total variation takes one"):
        SequenceProblem(SeveralSequences((sight, sight))).total_variation(random(3, *SHAPE), 0.1)
