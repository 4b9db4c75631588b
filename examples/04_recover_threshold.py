"""From events alone, find the thresholds and the cutoff of the pixel that sent them.

The wall video is known, the pixel is not. The soft counts of `evnlos.cameras.surrogate` have gradients with
respect to the pixel, so a few steps of L-BFGS fit them to the counted events, from a start that is wrong by a
factor of two.
"""

import numpy as np
import torch

from evnlos.cameras import EventPixel, simulate_events
from evnlos.cameras.surrogate import soft_counts, soft_events

STEP_S, BINS = 6e-3, 6
TRUE = {"threshold_on": 0.17, "threshold_off": 0.13, "cutoff_hz": 25.0}


def wall_video() -> tuple[torch.Tensor, np.ndarray]:
    """Return a bright spot that crosses a dim wall twice, DN [T, H, W], and the instants in seconds."""
    times_s = np.arange(81) * STEP_S
    y, x = torch.meshgrid(torch.arange(20.0), torch.arange(40.0), indexing="ij")
    centre = 20 - 24 * torch.cos(2 * torch.pi * torch.tensor(times_s) / times_s[-1])[:, None, None]
    return 25 + 200 * torch.exp(-((x - centre) ** 2 + (y - 9) ** 2) / 50), times_s


def count(light: torch.Tensor, times_s: np.ndarray, edges_s: np.ndarray) -> torch.Tensor:
    """Return what a real recording gives: hard counts [bins, 2, H, W], channel 0 ON."""
    pixel = EventPixel(**TRUE, threshold_sigma=0, leak_rate_hz=0, shot_noise_rate_hz=0, initial_phase="rest")
    events = simulate_events(light, times_s, pixel)
    counts = np.zeros((BINS, 2, *light.shape[1:]))
    bins = np.searchsorted(edges_s, events.t_us * 1e-6, side="left") - 1
    np.add.at(counts, (bins, 1 - events.p.astype(int), events.y, events.x), 1)
    return torch.from_numpy(counts)


def main() -> None:
    """Fit and check."""
    light, times_s = wall_video()
    edges_s = np.linspace(0, times_s[-1], BINS + 1)
    seen = count(light, times_s, edges_s)
    logs = torch.tensor([0.3, 0.3, 12.0], dtype=torch.float64).log().requires_grad_()
    optimiser = torch.optim.LBFGS([logs], lr=0.5, max_iter=12, line_search_fn="strong_wolfe")

    def misfit() -> torch.Tensor:
        optimiser.zero_grad()
        soft = soft_counts(soft_events(light, times_s, *logs.exp()), times_s, edges_s)
        loss = (soft - seen).square().mean()
        loss.backward()
        return loss

    optimiser.step(misfit)
    found = dict(zip(TRUE, logs.exp().tolist(), strict=True))
    for name, value in found.items():
        print(f"{name}: {value:.4g}, true {TRUE[name]:g}")
    assert max(abs(found[name] / TRUE[name] - 1) for name in TRUE) < 0.02


if __name__ == "__main__":
    main()
