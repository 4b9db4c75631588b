"""What rests in a recording: ambient light, smooth over the wall, where the moving light never is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import DataError
from evnlos.solver import Background

_ROUNDS = 20
_ABOVE = 2.5  # standard deviations over the background from which a pixel shows the object
_LEAST_SHARE = 0.1


def temporal_noise(frames: NDArray) -> float:
    """Return the standard deviation of the noise that changes from frame to frame, in the frames' unit.

    Median absolute value of second differences, in time and then over neighbours: a smooth picture that moves
    leaves next to nothing there.

    Args:
        frames: Real [N, H, W], three or more along each axis.
    """
    change = (frames[2:] - 2 * frames[1:-1] + frames[:-2]) / np.sqrt(6)
    around = change[:, :-2, 1:-1] + change[:, 2:, 1:-1] + change[:, 1:-1, :-2] + change[:, 1:-1, 2:]
    return float(1.4826 * np.median(np.abs(4 * change[:, 1:-1, 1:-1] - around)) / np.sqrt(20))


def static_light(frames: NDArray, degree: int = 2) -> NDArray[np.float64]:
    """Return ambient light as a polynomial through the pixels and times that the object's light does not reach.

    A mean over time would take a slow object for background, and so would a minimum where the object never
    leaves. The object adds light, so samples above the polynomial by more than their noise are dropped, again
    and again until the fit rests.

    Args:
        frames: Real [N, H, W].
        degree: Total degree of the polynomial.

    Returns:
        float64 [H, W], in the frames' unit.

    Raises:
        DataError: Fewer than a tenth of the pixels are free of the object.
    """
    shape = (int(frames.shape[1]), int(frames.shape[2]))
    columns = Background(degree).polynomials(shape).numpy().reshape(-1, shape[0] * shape[1]).T  # [P, K]
    middle = np.median(frames, axis=0).ravel().astype(np.float64)
    swing = frames.max(axis=0).ravel() - middle
    used = swing <= np.quantile(swing, 0.5)
    fitted = middle
    for _ in range(_ROUNDS):
        if used.mean() < _LEAST_SHARE:
            raise DataError(
                f"{100 * used.mean():.0f} % of the wall is free of the object's light, "
                f"{100 * _LEAST_SHARE:.0f} % is the least; show more of the wall"
            )
        known = np.linalg.lstsq(columns[used], middle[used], rcond=None)[0]
        fitted = (columns @ known).astype(np.float64)
        rest = middle - fitted
        # Half of the noise lies below the polynomial, where no object adds light.
        sigma = np.sqrt(np.mean(np.minimum(rest[used], 0.0) ** 2) * 2)
        before, used = used, rest <= _ABOVE * sigma
        if (before == used).all():
            break
    return fitted.reshape(shape)
