"""A refractory period that drops most events: the frame-stepped pixel against v2e's own counts.

The counts and digests were printed by v2e itself (SensorsINI/v2e, v2ecore/emulator.py at commit b0ae3bc and
emulator_utils.py at b7f5027, on the CPU, sigma_thres, leak and shot noise 0) on the flicker that `_flicker`
makes. That code gives the stored events of commit cac6384 byte for byte on every case of the test data. A
digest is SHA-256 over v2e's sorted rows (t in microseconds, x, y, 1 = ON) as little-endian int64.
"""

import hashlib

import numpy as np
import pytest

from evnlos.cameras import EventPixel, simulate_events

# on, off, cutoff in Hz, period in s, v2e's events without a period, its ON and OFF events with it, their digest
CASES = [
    (0.15, 0.15, 0.0, 0.0001, 77711, 10486, 10411, "a11d51763fe0c1da"),
    (0.15, 0.15, 0.0, 0.003, 77711, 1852, 1612, "14cc53cd7bab23b5"),
    (0.15, 0.15, 0.0, 0.005, 77711, 1155, 1053, "aee3dab177fc6390"),
    (0.15, 0.15, 200.0, 0.0005, 21396, 4692, 4110, "653a1a448e97e21c"),
    (0.15, 0.15, 200.0, 0.001, 21396, 4009, 3443, "0c27ea8184839237"),
    (0.15, 0.15, 200.0, 0.003, 21396, 1907, 1395, "3b0b4f7375ce85a4"),
    (0.2, 0.12, 200.0, 0.005, 20901, 1045, 1076, "dd381f50e0a7227f"),
    (0.15, 0.15, 15.0, 0.005, 995, 634, 180, "548bff6faa50c24f"),
    (0.2, 0.12, 15.0, 0.01, 834, 383, 221, "bad2fec43bb3d1c2"),
]


def _flicker():
    """Return 60 frames of 12 x 16 pixels at 1 ms whose light jumps over the whole range, and their times."""
    k = np.arange(60)[:, None, None]
    y, x = np.arange(12)[:, None], np.arange(16)
    light = 37 * k * (1 + (x + y) % 5) + 11 * x + 23 * y + k * k * (x % 3 + 1)
    return (light % 256).astype(np.uint8), np.arange(60) * 1e-3


def _digest(events):
    rows = np.stack([events.t_us, events.x, events.y, events.p], axis=1).astype("<i8")
    return hashlib.sha256(rows[np.lexsort(rows.T[::-1])].tobytes()).hexdigest()[:16]


@pytest.mark.parametrize("dtype", [np.uint8, np.float64])
@pytest.mark.parametrize(("on", "off", "cutoff_hz", "period_s", "free", "ons", "offs", "digest"), CASES)
def test_the_events_that_v2e_lets_through(on, off, cutoff_hz, period_s, free, ons, offs, digest, dtype):
    frames, times = _flicker()

    def run(refractory_s):
        pixel = EventPixel(on, off, 0.0, cutoff_hz, 0.0, 0.0, refractory_s)
        return simulate_events(frames.astype(dtype), times, pixel, mode="v2e")

    assert len(run(0.0)) == free
    held = run(period_s)
    assert len(held) == ons + offs < free  # the period bites
    assert (int(held.p.sum()), int((~held.p).sum())) == (ons, offs)
    assert _digest(held) == digest


def test_no_pixel_sends_two_events_within_the_period():
    """At 200 Hz and 5 ms every step of 1 ms is filtered, so the law holds without exception."""
    frames, times = _flicker()
    held = simulate_events(frames, times, EventPixel(0.15, 0.15, 0.0, 200.0, 0.0, 0.0, 0.005), mode="v2e")
    for y in range(12):
        for x in range(16):
            gaps = np.diff(held.t_us[(held.x == x) & (held.y == y)])
            assert (gaps >= 4999).all()
