"""From a scan's folder to a measured transport; still images as such a setup sees them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.calibration.scan.folder import ScanInfo, frame_reader, read_scan_frames, read_scan_info
from evnlos.calibration.scan.frames import Agreement, ScanLight, compare_repeats, read_light
from evnlos.calibration.scan.matrix import Denoising, PsfCheck, choose_denoising, denoised, matrix_from_psf
from evnlos.data.frames import read_image
from evnlos.errors import ConfigError, DataError
from evnlos.optics import MatrixTransport
from evnlos.setups import Setup
from evnlos.setups.files import About, Measurement
from evnlos.setups.measured import averaged, image_motion_px_m
from evnlos.types import Plane

_LEAST_SIGNAL = 3.0
_LEAST_DITHER = 0.4  # digital numbers of noise that make rounding harmless
_MOST_BAD = 0.2
_BORDER = 0.1


@dataclass(frozen=True)
class ScanImport:
    """How a scan becomes a matrix."""

    height: int | None = None
    """Rows to which the images are reduced, pixels; none = the camera's."""
    width: int | None = None
    """Columns to which the images are reduced, pixels; none = the camera's."""
    denoise: bool = True
    """Denoise where held-out repeats show that it helps; off keeps the plain mean."""
    psf: bool = False
    """Take the wall as shift-invariant: the middle cell's column, moved, stands for all (points: always)."""
    psf_limit: float = 0.3
    """Largest difference between that and the other measured columns, share of their root mean square."""

    def __post_init__(self) -> None:
        if (self.height is None) != (self.width is None):
            raise ConfigError(f"height is {self.height}, width {self.width}; give both or none")
        if not self.psf_limit > 0:
            raise ConfigError(f"psf_limit is {self.psf_limit}; give a share above 0")


@dataclass(frozen=True, eq=False)
class ScanResult:
    """A measured transport and what its import found.

    Args:
        info: What the folder says.
        measurement: The matrix with its noise.
        raw: The matrix before denoising or moving, float32 [H W, measured cells].
        denoising: What was removed.
        agreement: How the repeats agree; None for one repeat.
        linearity: 1 for a linear camera; None where it was not recorded.
        psf: The check of the shift-invariant wall; None where all cells were measured.
        signal_to_noise: Root mean square entry over the noise of an entry.
        bad_pixels: Number of pixels that can't be used.
        warnings: What to look at.
    """

    info: ScanInfo
    measurement: Measurement
    raw: torch.Tensor
    denoising: Denoising
    agreement: Agreement | None
    linearity: float | None
    psf: PsfCheck | None
    signal_to_noise: float
    bad_pixels: int
    warnings: tuple[str, ...]


def import_scan(folder: str | Path, settings: ScanImport | None = None) -> ScanResult:
    """Read a scan and return its light-transport matrix.

    Dark frames are taken off, repeats compared and averaged, cells distinguished, noise estimated per pixel
    from the repeats, and the matrix denoised where that helps (`choose_denoising`).

    Args:
        folder: A folder with `scan.yaml` and its images.
        settings: What to do; None is the default.

    Raises:
        ConfigError: `scan.yaml` is garbled.
        DataError: Images are missing, saturated, not linear, or the repeats disagree; or the wall is not
            shift-invariant where that is supposed.
    """
    settings = settings or ScanImport()
    folder = Path(folder)
    info = read_scan_info(folder)
    shape = None if settings.height is None or settings.width is None else (settings.height, settings.width)
    light = read_light(info, read_scan_frames(folder, info), frame_reader(folder, info.frames), shape)
    if light.bad.mean() > _MOST_BAD:
        raise DataError(
            f"{100 * light.bad.mean():.0f} % of the pixels saturate somewhere, at most {100 * _MOST_BAD:g} % "
            "may; "
            "shorten the exposure"
        )
    agreement = compare_repeats(light.lit, light.shape)
    warnings = _first_warnings(info, light)
    patterns, repeats = info.patterns, info.repeats
    variance = frame_variance(light)  # [pixels]
    columns = patterns.separate(light.lit.mean(axis=0))  # [cells, pixels]
    # A dark frame's error is shared by all cells: it counts where patterns do not cancel it.
    dark_part = np.nan_to_num(light.dark_variance, nan=0.0) / light.darks * patterns.offset_factor**2
    sigma = np.sqrt(variance / repeats * patterns.noise_factor**2 + dark_part)  # [pixels]
    raw = torch.from_numpy(np.ascontiguousarray(columns.T, dtype=np.float32))  # [pixels, cells]
    good = torch.from_numpy(~light.bad)
    if 0 < float(np.sqrt(np.median(variance))) < _LEAST_DITHER / light.white_dn:
        warnings.append(
            f"a frame's noise is below {_LEAST_DITHER:g} digital numbers: rounding repeats itself instead of "
            "averaging "
            "out, and dim entries are lost; use more bits or gain"
        )
    snr = float(raw[good].double().square().mean().sqrt() / max(float(sigma[~light.bad].mean()), 1e-12))
    if snr < _LEAST_SIGNAL:
        warnings.append(
            f"an entry is {snr:.1f} times its noise; expose longer, repeat more often, or take larger cells"
        )
    how, check, matrix = Denoising(), None, raw
    if settings.psf or info.pattern == "points":
        matrix, check = _from_psf(info, columns, light.shape, settings, warnings)
        how = Denoising(reason="a point-spread function has one column")
    elif not settings.denoise:
        how = Denoising(reason="switched off")
    elif repeats < 2:
        how = Denoising(reason="one repeat leaves none to check it with")
    else:
        how, matrix = _denoise(info, light, raw, sigma)
    plane = info.plane
    matrix = torch.from_numpy(fill_bad(matrix.numpy().T.reshape(-1, *light.shape), light.bad, light.shape))
    matrix = matrix.reshape(plane.height * plane.width, -1).mT.contiguous()
    noise = torch.from_numpy((sigma / how.gain).astype(np.float32))
    noise[~good] = math.inf
    about = About(
        plane,
        *light.shape,
        magnification_px_m=_motion(matrix, plane, light.shape, check),
        exposure_s=info.exposure_s,
        repeats=repeats,
        pattern=info.pattern,
        noise_cells=not how.applied and check is None,
        white_dn=light.white_dn,
        notes={
            "smoothing_cells": how.smoothing_cells,
            "rank": how.rank,
            "denoising_gain": round(how.gain, 3),
            "linearity": None if light.linearity is None else round(light.linearity, 4),
            "scan": info.notes,
        },
    )
    dark = torch.from_numpy(light.dark.reshape(light.shape))
    measurement = Measurement(matrix, noise.reshape(light.shape), dark, about)
    return ScanResult(
        info,
        measurement,
        raw,
        how,
        agreement,
        light.linearity,
        check,
        snr * how.gain,
        int(light.bad.sum()),
        tuple(warnings),
    )


def frame_variance(light: ScanLight) -> NDArray[np.float64]:
    """Return the variance of a frame at each pixel, float64 [pixels]: between repeats, or of the dark frames.

    The patterns of a repeat share its dark frame, so what all of them have in common is no noise of a frame.
    """
    repeats = len(light.lit)
    if repeats >= 2:
        mean, count = light.lit.mean(axis=0), light.lit.shape[1]
        total = np.zeros(light.lit.shape[2])
        for frames in light.lit:
            rest = frames - mean
            if count > 1:
                rest -= rest.mean(axis=0)
            total += (rest**2).sum(axis=0, dtype=np.float64)
        return total / ((repeats - 1) * max(count - 1, 1))
    if np.isfinite(light.dark_variance).all():
        return light.dark_variance
    return np.zeros(light.lit.shape[2])


def fill_bad(
    images: NDArray[np.float32], bad: NDArray[np.bool_], shape: tuple[int, int]
) -> NDArray[np.float32]:
    """Return images [n, H, W] with bad pixels set to the mean of their usable neighbours, ring after ring.

    Example:
        >>> fill_bad(np.array([[[1, 9, 3]]], np.float32), np.array([[False, True, False]]), (1, 3))
        array([[[1., 2., 3.]]], dtype=float32)
    """
    bad = bad.reshape(shape)
    if not bad.any() or bad.all():
        return images
    images, good = images.copy(), ~bad
    while not good.all():
        known = np.pad(np.where(good, images, 0), ((0, 0), (1, 1), (1, 1)))
        count = np.pad(good.astype(np.float32), 1)
        windows = [(slice(i, i + shape[0]), slice(j, j + shape[1])) for i in range(3) for j in range(3)]
        total, number = sum(known[:, y, x] for y, x in windows), sum(count[w] for w in windows)
        ring = ~good & (number > 0)
        images[:, ring] = total[:, ring] / number[ring]  # type: ignore[index]
        good = good | ring
    return images


def _denoise(
    info: ScanInfo, light: ScanLight, raw: torch.Tensor, sigma: NDArray[np.float64]
) -> tuple[Denoising, torch.Tensor]:
    weight = np.where(light.bad, 0.0, 1 / np.maximum(sigma, max(float(np.median(sigma)) * 1e-3, 1e-12)))
    half = info.repeats // 2
    halves = [
        torch.from_numpy(info.patterns.separate(part.mean(axis=0) * weight.astype(np.float32)).T)
        for part in (light.lit[:half], light.lit[half:])
    ]
    how = choose_denoising(halves[0], halves[1], info.plane, (half, info.repeats - half))
    return how, denoised(raw, info.plane, how, torch.from_numpy(weight))


def _from_psf(
    info: ScanInfo,
    columns: NDArray[np.float32],
    shape: tuple[int, int],
    settings: ScanImport,
    warnings: list[str],
) -> tuple[torch.Tensor, PsfCheck]:
    every = [(r, c) for r in range(info.plane.height) for c in range(info.plane.width)]
    cells = list(info.cells) if info.pattern == "points" else every
    matrix, check = matrix_from_psf(columns, cells, info.plane, shape, info.image_px_per_m)
    if check.checked == 0:
        warnings.append(
            "one column only: that the wall is shift-invariant was not checked; measure more points"
        )
    elif check.error > settings.psf_limit:
        raise DataError(
            f"the moved column differs from {check.checked} measured ones by {100 * check.error:.0f} % of "
            "their light, "
            f"at most {100 * settings.psf_limit:g} % may be: this wall is not shift-invariant; scan all "
            "cells, or "
            "raise psf_limit"
        )
    if check.border > _BORDER:
        warnings.append(
            f"the point's light is still {100 * check.border:.0f} % of its peak at the image's border; what a "
            "moved "
            "column has beyond is guessed"
        )
    return matrix, check


def _motion(matrix: torch.Tensor, plane: Plane, shape: tuple[int, int], check: PsfCheck | None) -> float:
    found = image_motion_px_m(matrix, plane, shape)
    return found if check is None else max(found, float(np.linalg.norm(np.array(check.image_px_per_m), 2)))


def _first_warnings(info: ScanInfo, light: ScanLight) -> list[str]:
    found = []
    if info.repeats < 2:
        found.append("one repeat: the noise is that of the dark frames alone, and nothing can be denoised")
    if light.linearity is None:
        found.append(
            "that the camera is linear was not checked: no image at another exposure, or too much noise in it"
        )
    step = 1 / light.white_dn
    brightest = float(light.lit.mean(axis=0).max())
    if brightest < 8 * step:
        found.append(
            f"the brightest pixel of a pattern has {brightest / step:.1f} digital numbers; below about 8 "
            "rounding "
            "distorts the matrix: expose longer, use more bits, or hadamard patterns"
        )
    return found


_FINEST = 48  # pixels a side that a rough wall's light needs


def stills_as_scanned(
    files: Sequence[Path], setup: Setup, dark: Path | None = None, bin: int | None = None
) -> tuple[MatrixTransport, torch.Tensor]:
    """Return a measured setup as an operator of norm 1, and still images of its wall as that sees them.

    The dark frame (the scan's own where none is given) is taken off, unusable pixels are filled in alike in
    the images and in the matrix, and both are reduced.

    Args:
        files: The images.
        setup: The setup, of a scan.
        dark: An image taken without the hidden object.
        bin: Pixels per side to average; None leaves at most 48 a side.

    Returns:
        The operator, and the images over the brightest of their pixels, float64 [files, h, w].

    Raises:
        ConfigError: An image does not have the scan's size or is one that the scan was not.
        DataError: An image can't be read.
    """
    measured = setup.measurement()
    pictures = [read_image(path, measured.shape) for path in files]
    peaks = {float(np.iinfo(picture.dtype).max) for picture in pictures}
    if len(peaks) > 1:
        raise ConfigError("the images have 8 and 16 bits; give images of one camera")
    white = float(measured.about.white_dn or peaks.pop())
    if (brightest := max(int(picture.max()) for picture in pictures)) > white:
        raise ConfigError(f"an image reaches {brightest} DN, the scan's white is {white:g}; save both alike")
    light = torch.from_numpy(np.stack(pictures).astype(np.float32)) / white
    if dark is None:
        light = light - setup.ambient_light(measured.shape)
    else:
        light = light - torch.from_numpy(read_image(dark, measured.shape).astype(np.float32)) / white
    filled = fill_bad(light.numpy(), measured.bad.numpy(), measured.shape)
    shape = _reduced(measured.shape, bin)
    flat = averaged(torch.from_numpy(filled).flatten(1).mT, measured.shape, shape)
    image = flat.mT.unflatten(1, shape).double()
    cells = measured.about.plane
    matrix = setup.operator(cells, shape).dense()
    operator = MatrixTransport(matrix / torch.linalg.matrix_norm(matrix, 2), cells, shape)
    return operator, image / image.abs().max().clamp(min=1e-12)


def _reduced(shape: tuple[int, int], bin: int | None) -> tuple[int, int]:
    """Return the size (h, w) that images are reduced to: pixels binned, by default at most 48 a side."""
    most = max(shape)
    factor = most / min(most, _FINEST) if bin is None else bin
    if not 1 <= factor <= min(shape):
        raise ConfigError(f"the binning is {bin}; give 1 to {min(shape)} pixels")
    return max(1, round(shape[0] / factor)), max(1, round(shape[1] / factor))
