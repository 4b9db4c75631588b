"""How much faster, and how much more accurate, is our angular spectrum than torchoptics' on one grid?

Both propagate the Gaussian beam of the tests (w0 0.3 mm, 10 um, 0.4 m, 500 nm) on the same zero-padded grid.
torchoptics makes its transfer function at every call, and in float64 even for float32 data (1.0.2): hence its
float32 errors and times. Install it beside this package; without it only our columns are measured.

    python benchmarks/angular_spectrum.py --sizes 512 1024 --threads 1
"""

from __future__ import annotations

import argparse
import math
import os
import platform
import statistics
import time
from collections.abc import Callable

import torch

from evnlos.optics.angular_spectrum import angular_spectrum, transfer_function

PITCH, WAVELENGTH, DISTANCE, WAIST = 10e-6, 500e-9, 0.4, 0.3e-3
TITLES = (
    "samples",
    "type",
    "ours, cached",
    "rebuilt",
    "torchoptics",
    "ratio, cached",
    "rebuilt",
    "our error",
    "its",
)
KINDS = {"float64": torch.float64, "float32": torch.float32}
Run = Callable[[], torch.Tensor]


def beam(samples: int, distance: float) -> torch.Tensor:
    x = (torch.arange(samples, dtype=torch.float64) - (samples - 1) / 2) * PITCH
    q = complex(1, distance * WAVELENGTH / (math.pi * WAIST**2))
    return torch.exp(-(x[:, None] ** 2 + x**2) / (WAIST**2 * q)) / q


def error(field: torch.Tensor, truth: torch.Tensor) -> float:
    """Relative error after the best constant phase: torchoptics keeps the carrier, we leave it out."""
    field = field.to(truth.dtype)
    phase = torch.vdot(field.flatten(), truth.flatten())
    return float((field * phase / phase.abs() - truth).norm() / truth.norm())


def rival(samples: int, pad: int, dtype: torch.dtype) -> Run | None:
    try:
        from torchoptics import Field
    except ImportError:
        return None
    data = beam(samples, 0.0).to(torch.promote_types(dtype, torch.complex64))
    field = Field(data, wavelength=WAVELENGTH, z=0, spacing=PITCH)
    extra = (pad - 1) * samples // 2  # torchoptics pads by so much on each side
    return lambda: field.propagate_to_z(DISTANCE, propagation_method="ASM", asm_pad=(extra, extra)).data


def seconds(calls: dict[str, Run], rounds: int) -> dict[str, float]:
    """Median time of each call, taken in turns so that a busy machine slows all of them alike."""
    found: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds + 1):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            found[name].append(time.perf_counter() - start)
    return {name: statistics.median(times[1:]) for name, times in found.items()}


def compare(samples: int, kind: str, pad: int, rounds: int) -> list[str]:
    """Return one row of the table."""
    dtype = KINDS[kind]
    start = beam(samples, 0.0).to(torch.promote_types(dtype, torch.complex64))
    truth = beam(samples, DISTANCE)

    def ours() -> torch.Tensor:
        return angular_spectrum(start, PITCH, WAVELENGTH, DISTANCE, pad=pad)

    def rebuilt() -> torch.Tensor:
        transfer_function.cache_clear()
        return ours()

    theirs = rival(samples, pad, dtype)
    other = {"theirs": theirs} if theirs else {}
    cached, fresh = (seconds({"ours": run} | other, rounds) for run in (ours, rebuilt))
    row = [str(samples), kind, f"{cached['ours'] * 1e3:.1f} ms", f"{fresh['ours'] * 1e3:.1f} ms"]
    if not theirs:
        return [*row, "not installed", "", "", f"{error(ours(), truth):.1e}", ""]
    row += [
        f"{cached['theirs'] * 1e3:.1f} ms",
        *(f"{took['theirs'] / took['ours']:.1f} x" for took in (cached, fresh)),
    ]
    return [*row, f"{error(ours(), truth):.1e}", f"{error(theirs(), truth):.1e}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[512, 1024])
    parser.add_argument("--pad", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    print(
        f"torch {torch.__version__}, {options.threads} thread(s), {os.cpu_count()} cores, {platform.machine()}"
    )
    print(f"| {' | '.join(TITLES)} |\n|{'---|' * len(TITLES)}")
    for samples in options.sizes:
        for kind in KINDS:
            print(f"| {' | '.join(compare(samples, kind, options.pad, options.rounds))} |", flush=True)


if __name__ == "__main__":
    main()
