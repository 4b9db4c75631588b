"""The time stamps of v2e lie in layers, one a frame; those of `mode="exact"` are where the light crosses.

python examples/03_layered_time_stamps.py [picture.png]
"""

import sys

import numpy as np

from evnlos import EventPixel, simulate_events
from evnlos.plot.figures import new_figure, save_figure

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
shares = [np.isin(events.t_us, np.round(times_s * 1e6)).mean() for events in streams.values()]
for (name, events), share in zip(streams.items(), shares, strict=True):
    print(f"{name}: {len(events):,} events, {100 * share:.2f} % exactly on frame times")

assert shares[0] == 1.0
assert shares[1] < 0.01
if len(sys.argv) > 1:
    figure = new_figure((10.5, 3.6))
    panels = figure.subplots(1, len(streams), sharex=True, sharey=True)
    for axes, (name, events), share in zip(panels, streams.items(), shares, strict=True):
        for time_s in times_s[60:76]:
            axes.axvline(1e3 * time_s, color="#d8d8d8", linewidth=0.6, zorder=0)
        for sign, colour, word in ((True, "#e27800", "ON"), (False, "#2057e4", "OFF")):
            part = events[(events.y >= 8) & (events.y < 16) & (events.p == sign)]
            axes.scatter(part.t_us / 1e3, part.x, s=7, color=colour, linewidths=0, label=word)
        axes.set_title(f"{name}: {100 * share:.3g} % of all events on frame times", fontsize=10)
        axes.set(xlabel="time, ms", xlim=(60, 75))
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("column, pixels")
    panels[-1].legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0), markerscale=2)
    save_figure(figure, sys.argv[1], dpi=110)
