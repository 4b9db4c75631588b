"""Test-time data consistency: the solution of the equation it states, and a gain where the model is right."""

import pytest
import torch

from evnlos.analysis.confidence import consistent
from evnlos.cameras import FrameCamera
from evnlos.data import Sampling, SensorSize, Simulation
from evnlos.errors import ConfigError, DataError
from evnlos.models import FrameOperator
from evnlos.scene import Scene, Target
from evnlos.setups import PaperSetup, RadiometricSetup

SAMPLING = Sampling(height=16, width=24, pitch_m=0.01, scored_rows=12)
SETUP = Simulation(
    setup=RadiometricSetup(
        roughness=0.05,
        cell_m=0.01,
        gain=1.0,
        ambient=0.05,
        sensor=SensorSize(20, 30),
        frame_camera=FrameCamera(full_well_e=20_000, prnu=0.0, dsnu_e=0.0, bit_depth=12, exposure_s=0.0),
    )
)


@pytest.fixture(scope="module")
def operator() -> FrameOperator:
    return FrameOperator(SETUP.setup, SAMPLING)


def pictures(seed: int, count: int = 3) -> torch.Tensor:
    draw = torch.Generator().manual_seed(seed)
    image = torch.zeros(count, 16, 24)
    image[:, 4:12] = (torch.rand(count, 8, 24, generator=draw) > 0.7).float()
    return image


def test_the_operator_is_the_simulators_wall(operator) -> None:
    mask = torch.zeros(16, 16)
    mask[2:14, 3:6] = 1.0
    scene = Scene(Target("bar", mask.numpy(), 0.08), SETUP.motion, 8.0)
    wall = SETUP.setup.resized((20, 30)).observe(scene)
    light = wall.irradiance([4.0]).numpy()
    from evnlos.data.sampling import reduce_by_area

    truth = torch.from_numpy(scene.target.rasterise(SAMPLING.canvas, scene.motion.position_m([4.0])))
    made = operator(truth)
    seen = torch.from_numpy(reduce_by_area(light, (16, 24)))
    # Cells of canvas and strip are the same size here, so both draw the same target.
    torch.testing.assert_close(made, seen, atol=2e-3, rtol=0)


def test_the_refined_image_solves_its_equation(operator) -> None:
    draw = torch.Generator().manual_seed(0)
    prior = 0.2 + 0.6 * torch.rand(2, 16, 24, generator=draw)
    frames = operator(prior) + 0.3 * operator.sigma * torch.randn(2, 16, 24, generator=draw)
    found = consistent(prior, frames, operator, trust=0.05, floor=0.01)
    matrix = operator.matrix.double() / operator.sigma
    for k in range(2):
        known = prior[k, operator.rows].flatten().double()
        variance = 0.05 * (known * (1 - known) + 0.01)
        away = ((frames - operator(prior))[k].flatten().double()) / operator.sigma
        system = matrix.T @ matrix + torch.diag(1 / variance)
        move = torch.linalg.solve(system, matrix.T @ away)
        expected = (known + move).clamp(0, 1)
        torch.testing.assert_close(found[k, operator.rows].flatten().double(), expected, atol=2e-3, rtol=0)


def test_a_blurred_guess_comes_nearer_to_the_truth(operator) -> None:
    truth = pictures(4)
    draw = torch.Generator().manual_seed(5)
    frames = operator(truth) + operator.sigma * torch.randn(3, 16, 24, generator=draw)
    guess = torch.nn.functional.avg_pool2d(truth[:, None], 3, 1, 1)[:, 0]
    better = consistent(guess, frames, operator)
    assert (better - truth).square().mean() < 0.95 * (guess - truth).square().mean()
    assert (operator(better) - frames).square().mean() < 0.2 * (operator(guess) - frames).square().mean()
    assert better.min() >= 0 and better.max() <= 1


def test_no_trust_changes_nothing_and_wrong_sizes_are_named(operator) -> None:
    guess = pictures(1)
    assert consistent(guess, operator(guess), operator, trust=0.0) is guess
    with pytest.raises(DataError, match="24 x 16"):
        consistent(guess, torch.zeros(3, 5, 6), operator)
    with pytest.raises(DataError, match="do not fit"):
        consistent(guess, torch.zeros(2, 16, 24), operator)
    with pytest.raises(ConfigError, match="radiometric"):
        FrameOperator(PaperSetup(), SAMPLING)
