"""What each event model does to the same moving edge, in bright and in dim light.

python examples/07_event_models.py [picture.png]
"""

import sys

import numpy as np

from evnlos import EventPixel, simulate_events
from evnlos.cameras import BrownianPixel, CircuitPixel, ReadoutPixel, V2ePixel

# A soft edge of contrast 3 runs over the rows at 400 px/s, then nothing happens; a frame every millisecond.
times_s = np.arange(301) * 1e-3
x = np.arange(48)
edge = 1 + 2 / (1 + np.exp((x - 400 * times_s[:, None]) / 1.5))  # [T, W]
frames = np.repeat(edge[:, None], 24, axis=1).astype(np.float32)
LEVELS = {"bright": 60.0, "dim": 1.0}  # DN ahead of the edge; 255 = white

quiet = {"threshold_sigma": 0.02, "leak_rate_hz": 0.1, "shot_noise_rate_hz": 1.0}
true_log = EventPixel(0.2, 0.2, **quiet, cutoff_hz=1000, logarithm="true", dark_dn=0.1, cutoff_floor_dn=1)
MODELS = {
    "continuous, v2e's logarithm": EventPixel(0.2, 0.2, **quiet, cutoff_hz=1000),
    "continuous, true logarithm": true_log,
    "v2e, frame by frame": V2ePixel(0.2, 0.2, **quiet, cutoff_hz=1000),
    "brownian": BrownianPixel(0.2, 0.2, photon_noise=0.4),
    "circuit": CircuitPixel(0.2, 0.2),
    "true logarithm, slow readout": ReadoutPixel(true_log, "row", setup_s=2e-5, event_s=2e-6),
}

found, streams = {}, {}
print(f"{'':30}{'light':8}{'ON of edge':>11}{'lag':>9}{'noise ON':>10}{'OFF':>6}   (per pixel; ms; Hz)")
for name, model in MODELS.items():
    for light, level in LEVELS.items():
        events = simulate_events(level * frames, times_s, model, seed=1)
        passes_us = 1e6 * events.x / 400
        near = np.abs(events.t_us - passes_us - 20_000) < 40_000  # from 20 ms before to 60 ms after the edge
        lag_ms = float(np.median((events.t_us - passes_us)[near & events.p])) / 1e3 if near.any() else np.nan
        on = np.count_nonzero(near & events.p) / 1152
        noise = [np.count_nonzero(~near & (events.p == sign)) / 1152 / 0.22 for sign in (True, False)]
        found[name, light], streams[name, light] = (on, lag_ms), events
        print(f"{name:30}{light:8}{on:11.2f}{lag_ms:9.2f}{noise[0]:10.2f}{noise[1]:6.2f}")

assert found["continuous, true logarithm", "dim"][0] > 1.5 * found["continuous, v2e's logarithm", "dim"][0]
assert found["circuit", "dim"][1] > found["circuit", "bright"][1]
if len(sys.argv) > 1:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 10), layout="constrained")
    for axes, ((name, light), events) in zip(figure.subplots(6, 2).flat, streams.items(), strict=True):
        axes.scatter(events.t_us / 1e3, events.x, s=1, c=np.where(events.p, "#b2182b", "#2166ac"))
        axes.set(title=f"{name}, {light}", xlabel="time, ms", ylabel="column", ylim=(0, 48), xlim=(0, 300))
    figure.savefig(sys.argv[1], dpi=100)
