"""Rigs side by side, as a table in Markdown."""

from __future__ import annotations

from collections.abc import Sequence

from evnlos.evaluation.identify import AtNoise, Identification

_HEAD = (
    "| rig | modes > 1e-2 | patterns above noise: camera / 1 % | bars, upright x lying, mm: camera / 1 % "
    "| best linear picture, dB: camera / 1 % |\n|---|---|---|---|---|"
)


def rig_table(found: Sequence[Identification]) -> str:
    """Return one row a rig, and a line that says what holds for all of them.

    Args:
        found: The rigs, all on the same bench.
    """
    rows = [_HEAD]
    for one in found:
        camera, fixed = one.at_camera, one.at_fixed
        rows.append(
            f"| {one.name} | {one.modes} | {camera.patterns} / {fixed.patterns} "
            f"| {_bars(camera)} / {_bars(fixed)} | {camera.psnr_db:.2f} / {fixed.psnr_db:.2f} |"
        )
    first, bench = found[0], found[0].bench
    rows.append(
        f"\nOn the plate of {1e3 * bench.plate_m:g} mm: all-black {first.zero_db:.2f} dB, mean training plate "
        f"{first.mean_db:.2f} dB; typical stroke {1e3 * first.stroke_m:.1f} mm; "
        f"{bench.cells} x {bench.cells} cells, {bench.height} x {bench.width} pixels."
    )
    return "\n".join(rows)


def _bars(one: AtNoise) -> str:
    return " x ".join("none" if width is None else f"{1e3 * width:.1f}" for width in one.stroke_m)
