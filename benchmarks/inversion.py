"""Which channel inverts better without learning, two frames or the events between them, and in which light?

    python benchmarks/inversion.py

A character on the setup "main" (rough aluminium of roughness 0.05, 0.3 m), 30 x 48 pixels in both cameras. The
unknown is the scene's change between two instants 0.8 s apart, 16 mm of travel (paper Eq. event_fm1 and
event_fm3, without the time surface): from the difference of two frames, and from the signed event count times
the threshold, linearised at the mean of the two frames. "exact" is the true change of log light, without noise:
what the linearisation alone costs. All by Tikhonov with the gradient towards a dark border, regularization by
leaving out blocks of the wall; r is Pearson's correlation of the found change with the true one, mean of R, K
and G.
"""

import numpy as np
import torch

from evnlos.cameras import EventCamera, EventPixel, FrameCamera
from evnlos.inverse import Gradient, LogChange, log_change, tikhonov
from evnlos.optics import MatrixTransport
from evnlos.scene import HandwritingGlyphs, Scene
from evnlos.setups import RadiometricSetup

SHAPE = (30, 48)
TIMES_S = (3.6, 4.4)


def correlation(image: torch.Tensor, truth: torch.Tensor) -> float:
    return float(torch.corrcoef(torch.stack([image.flatten(), truth.flatten()]))[0, 1])


def compare(gain: float, ambient: float, character: str, seed: int = 0) -> dict[str, float]:
    """Return r of each channel for one character in one light."""
    scene = Scene(HandwritingGlyphs().target(f"writer03_{character}"))
    setup = RadiometricSetup(cell_m=0.005, strip_m=(0.24, 0.08), gain=gain, ambient=ambient)
    wall = setup.resized(SHAPE).observe(scene)
    operator = MatrixTransport(gain * wall.transport.matrix.double(), wall.transport.source, SHAPE)
    first, last = (torch.from_numpy(scene.truth(wall.transport.source, t)).double() for t in TIMES_S)

    frames = FrameCamera(exposure_s=0.016).capture(wall, np.array(TIMES_S), seed=seed)
    before, after = torch.from_numpy(frames.astype(np.float64) / 255)
    pixel = EventPixel()
    events = EventCamera(pixel).record(wall, *TIMES_S, seed=seed)
    edges_us = [int(1e6 * t) for t in TIMES_S]
    counted = log_change(events, edges_us, pixel)[0].double()
    linear = LogChange(operator, ((before + after) / 2).clamp(min=0.5 / 255))
    dark, bright = (wall.irradiance(t).double() for t in TIMES_S)
    exact = LogChange(operator, (dark + bright) / 2)
    options = {"prior": Gradient("dark"), "rule": "cv"}
    solved = {
        "frames": tikhonov(operator, after - before, **options),
        "events": tikhonov(linear, counted, **options),
        "exact": tikhonov(exact, torch.log(bright / dark), **options),
    }
    row = {name: correlation(solution.image, last - first) for name, solution in solved.items()}
    return row | {"events per pixel": len(events) / (SHAPE[0] * SHAPE[1])}


if __name__ == "__main__":
    names = None
    for gain, ambient in ((0.8, 0.02), (0.8, 0.2), (0.2, 0.02), (0.2, 0.2), (0.2, 0.7), (0.05, 0.02)):
        rows = [compare(gain, ambient, character) for character in "RKG"]
        if names is None:
            names = list(rows[0])
            print("| gain | ambient | " + " | ".join(names) + " |\n|" + "---|" * (2 + len(names)))
        cells = " | ".join(f"{np.mean([row[name] for row in rows]):.2f}" for name in names)
        print(f"| {gain} | {ambient} | {cells} |", flush=True)
