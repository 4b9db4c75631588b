"""The time stamps of v2e lie in layers, one a frame; those of `mode="exact"` are where the light crosses.

python examples/03_layered_time_stamps.py [picture.png]
"""

import sys

import numpy as np

from evnlos import EventPixel, simulate_events
from evnlos.plot.setup import draw_time_stamps, share_on_frame_times

# Two soft spots pass by each other on a wall of 40 DN; a frame every millisecond, the paper's pixel, no noise.
times_s = np.arange(121) * 1e-3
y, x = np.mgrid[:24, :64]
frames = np.empty((len(times_s), 24, 64), np.float32)
for k, time_s in enumerate(times_s):
    right = np.exp(-((x - 8 - 300 * time_s) ** 2 + (y - 12) ** 2) / (2 * 5**2))
    left = np.exp(-((x - 58 + 200 * time_s) ** 2 + (y - 12) ** 2) / (2 * 3**2))
    frames[k] = 40 + 150 * right + 100 * left

pixel = EventPixel(leak_rate_hz=0, shot_noise_rate_hz=0, initial_phase="rest")
streams = {
    'mode="v2e"': simulate_events(frames, times_s, pixel, mode="v2e"),
    'mode="exact"': simulate_events(frames, times_s, pixel, mode="exact"),
}
shares = [share_on_frame_times(events, times_s) for events in streams.values()]
for (name, events), share in zip(streams.items(), shares, strict=True):
    print(f"{name}: {len(events):,} events, {100 * share:.2f} % exactly on frame times")

assert shares[0] == 1.0
assert shares[1] < 0.01
if len(sys.argv) > 1:
    draw_time_stamps(sys.argv[1], streams, times_s, rows=(8, 16), window_s=(0.06, 0.075))
