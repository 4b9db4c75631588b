"""The Brownian pixel against closed forms of a drifting walk, a slow reference, and DVS-Voltmeter's law."""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np
import pytest
from scipy.stats import gamma

from evnlos.cameras import BrownianPixel, EventStream, simulate_events
from evnlos.errors import ConfigError
from evnlos.types import Events

NOISY = BrownianPixel.voltmeter(1.0, 20.0, 0.01, 1e-15, 0.0, 0.001)
"""sigma = 1.833e-3 thresholds per sqrt(us) at 100 DN, practically no drift: 3.361 Hz."""


def constant(level: float, seconds: float, frames: int, pixels: int = 1600) -> tuple[np.ndarray, np.ndarray]:
    return np.full((frames + 1, 1, pixels), level), np.linspace(0.0, seconds, frames + 1)


def sent(light: np.ndarray, times, pixel: BrownianPixel, seed: int = 0) -> Events:
    """Return the events of light in single precision, as walls send it: no kernel is compiled for another."""
    return simulate_events(light.astype(np.float32), times, pixel, seed=seed)


def rates(events, seconds: float, pixels: int = 1600) -> tuple[float, float]:
    return float(events.p.sum()) / pixels / seconds, float((~events.p).sum()) / pixels / seconds


def first_exits(events, pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """Return time in seconds and polarity of each pixel's first event."""
    _, first = np.unique(events.x, return_index=True)
    assert len(first) == pixels
    return events.t_us[first] * 1e-6, events.p[first]


def drift_and_noise(pixel: BrownianPixel, light: float) -> tuple[float, float]:
    """Return the leak's drift, log units per s, and the noise, log units per sqrt(s), in constant light, DN."""
    drift = pixel.threshold_on * (pixel.leak_rate_hz + pixel.leak_rate_per_dn_hz * light)
    return drift, pixel.photon_noise * math.sqrt(light) / (light + pixel.dark_dn) + pixel.dark_noise


def reference(pixel: BrownianPixel, level: float, seconds: float, step_s: float, runs: int, seed: int):
    """Return first exit times and polarities of the equation in constant light, by small steps alone."""
    draw = np.random.default_rng(seed)
    drift, noise = drift_and_noise(pixel, level)
    x, time = np.zeros(runs), np.full(runs, np.nan)
    on = np.zeros(runs, bool)
    for k in range(round(seconds / step_s)):
        x += drift * step_s + noise * math.sqrt(step_s) * draw.normal(size=runs)
        out = np.isnan(time) & ((x >= pixel.threshold_on) | (x <= -pixel.threshold_off))
        time[out], on[out] = (k + 1) * step_s, x[out] > 0
    return time, on


@pytest.mark.parametrize(("drift", "seconds"), [(0.0, 40.0), (1.0, 40.0), (-2.0, 10.0)])
@pytest.mark.parametrize("frames", [1, 100])
def test_exit_of_a_drifting_walk_has_its_closed_forms(drift, seconds, frames) -> None:
    """P(ON first) = 1 / (1 + e^-c); E[T] = tanh(c / 2) / mu; E[e^-lT] a ratio of two cosh."""
    sigma, count = 1.0, 20_000  # log units per sqrt(s); thresholds are 1
    pixel = replace(
        NOISY, dark_noise=sigma, photon_noise=0.0, leak_rate_hz=max(drift, 0.0), initial_phase="rest"
    )
    times = np.linspace(0.0, seconds, frames + 1)
    light = 20.0 * np.exp(min(drift, 0.0) * (times - seconds)) - 20.0  # ln(L + k) falls along a line
    events = sent(np.repeat(light[:, None, None], count, axis=2), times, pixel, seed=3)
    when, on = first_exits(events, count)
    c = 2 * drift / sigma**2
    likely = 1 / (1 + math.exp(-c))
    assert abs(on.mean() - likely) < 4 * math.sqrt(likely * (1 - likely) / count)
    mean = math.tanh(c / 2) / drift if drift else 1 / sigma**2
    assert abs(when.mean() - mean) < 4 * when.std() / math.sqrt(count)
    for rate in (0.5, 3.0):
        laplace = math.cosh(drift / sigma**2) / math.cosh(math.sqrt(drift**2 + 2 * rate * sigma**2) / sigma**2)
        found = np.exp(-rate * when)
        assert abs(found.mean() - laplace) < 4 * found.std() / math.sqrt(count)


def test_unequal_thresholds_have_their_closed_form() -> None:
    """P(ON first) = (1 - e^(c b)) / (e^(-c a) - e^(c b)) for thresholds a and -b."""
    a, b, drift, count = 0.3, 0.12, 0.5, 20_000
    pixel = BrownianPixel(a, b, 0.0, 20.0, drift / a, 0.0, 0.0, 0.3, initial_phase="rest")
    frames, times = constant(50.0, 20.0, 7, count)
    _, on = first_exits(sent(frames, times, pixel, seed=9), count)
    c = 2 * drift / 0.3**2
    likely = (1 - math.exp(c * b)) / (math.exp(-c * a) - math.exp(c * b))
    assert abs(on.mean() - likely) < 4 * math.sqrt(likely * (1 - likely) / count)


def test_leak_intervals_are_inverse_gaussian() -> None:
    """Interval 1 / mu, coefficient of variation sigma / sqrt(mu): 0.0137 for a DAVIS346 at 250 DN."""
    frames, times = constant(250.0, 30.0, 300)
    events = sent(frames, times, BrownianPixel(), seed=2)
    drift, noise = (value / 0.18993 for value in drift_and_noise(BrownianPixel(), 250.0))
    order = np.lexsort((events.t_us, events.x))
    gaps = np.diff(events.t_us[order])[np.diff(events.x[order].astype(int)) == 0] * 1e-6
    assert events.p.all()
    assert abs(gaps.mean() * drift - 1) < 1e-3
    assert abs(gaps.std() / gaps.mean() / (noise / math.sqrt(drift)) - 1) < 0.02
    assert abs(gaps.std() / gaps.mean() - 0.0137) < 0.0003


@pytest.mark.parametrize("frames", [1, 16, 4000])
def test_noise_alone_has_its_rate_whatever_the_frame_distance(frames) -> None:
    """The published code gives 1.2 to 2.8 Hz for frames every 1000 to 0.25 ms; the law gives 3.361 Hz."""
    light, times = constant(100.0, 4.0, frames)
    on, off = rates(sent(light, times, NOISY, seed=frames), 4.0)
    count = (on + off) * 1600 * 4.0
    assert abs(on + off - 3.361) < 4 * 3.361 / math.sqrt(count)
    assert abs(on / (on + off) - 0.5) < 2 / math.sqrt(count)


def test_a_slow_reference_finds_the_same_first_exits() -> None:
    """Small steps see a barrier late by 0.583 sigma sqrt(step): 1 ms steps against thresholds moved by that."""
    pixel = BrownianPixel(0.2, 0.3, 0.0, 20.0, 0.4, 0.01, 0.9, 0.05, initial_phase="rest")
    _, noise = drift_and_noise(pixel, 60.0)
    shift = 0.5826 * noise * math.sqrt(1e-3)
    moved = replace(pixel, threshold_on=0.2 - shift, threshold_off=0.3 - shift)
    moved = replace(moved, leak_rate_hz=0.4 * 0.2 / moved.threshold_on)
    moved = replace(moved, leak_rate_per_dn_hz=0.01 * 0.2 / moved.threshold_on)
    time, on = reference(moved, 60.0, 30.0, 1e-3, 3000, 4)
    assert not np.isnan(time).any()
    frames, times = constant(60.0, 30.0, 40, 12_000)
    found, found_on = first_exits(sent(frames, times, pixel, seed=1), 12_000)
    error = math.hypot(time.std() / math.sqrt(3000), found.std() / math.sqrt(12_000))
    assert abs(time.mean() - found.mean()) < 4 * error
    assert abs(on.mean() - found_on.mean()) < 4 * math.sqrt(0.25 / 3000 + 0.25 / 12_000)


@pytest.mark.parametrize("level", [5.0, 100.0])
@pytest.mark.parametrize("noise", [0.002, 0.4])
def test_rest_stays_at_rest(level, noise) -> None:
    """In constant light the first second looks like the last."""
    pixel = BrownianPixel(0.2, 0.15, 0.0, 20.0, 0.3, 0.01, 0.01, noise)
    frames, times = constant(level, 12.0, 240, 6000)
    events = sent(frames, times, pixel, seed=5)
    for on in (True, False):
        counts = np.histogram(events.t_us[events.p == on], np.arange(13) * 1_000_000)[0].astype(float)
        if counts.sum() < 500:
            continue
        assert abs(counts[0] - counts[6:].mean()) < 5 * math.sqrt(counts[6:].mean() * 7 / 6) + 5
    assert len(events) > 1000


def test_on_and_off_swap_when_the_light_is_turned_around() -> None:
    pixel = BrownianPixel(0.2, 0.2, 0.0, 20.0, 0.0, 0.0, 0.0, 0.5, initial_phase="rest")
    times = np.linspace(0.0, 1.0, 51)
    rise = 80.0 * np.exp(1.5 * times) - 20.0
    counts = []
    for light in (rise, rise[::-1]):
        events = sent(np.repeat(light[:, None, None], 4000, axis=2), times, pixel, seed=7)
        counts.append((int(events.p.sum()), int((~events.p).sum())))
    (on, off), (back_on, back_off) = counts
    assert on > 5 * off > 100
    assert abs(on - back_off) < 5 * math.sqrt(2 * on)
    assert abs(off - back_on) < 5 * math.sqrt(2 * off)


@pytest.mark.parametrize("name", ["threshold_on", "dark_dn", "dark_noise", "initial_phase", "increments"])
def test_wrong_settings_are_refused(name) -> None:
    with pytest.raises(ConfigError, match=name):
        BrownianPixel(**{name: -1.0})


def test_without_noise_it_is_an_integrator_of_log_light() -> None:
    pixel = BrownianPixel(0.2, 0.2, 0.0, 20.0, 0.0, 0.0, 0.0, 0.0, initial_phase="rest")
    light = 80.0 * np.exp([0.0, 0.9, 0.9, -0.1]) - 20.0
    events = sent(light[:, None, None], [0.0, 0.9, 2.0, 3.0], pixel)
    assert (events.t_us // 1000).tolist() == [200, 400, 600, 800, 2300, 2500, 2700, 2900]
    assert events.p.tolist() == [True] * 4 + [False] * 4


# DVS-Voltmeter's law, drawn by an independent program: all statistics of `law` in meta.json


@dataclass(frozen=True)
class Compared:
    """A statistic of ours less theirs, the error of the difference, and what the stored digits leave open."""

    group: str  # statistics of one group depend on each other
    name: str
    difference: float
    error: float
    slack: float
    mean: bool = False  # whether it is a mean, for which meta.json allows four standard errors

    @property
    def deviation(self) -> float:
        """Standard errors beyond the slack."""
        beyond = max(abs(self.difference) - self.slack, 0.0)
        return beyond / self.error if self.error > 0 else math.inf if beyond > 0 else 0.0


@dataclass(frozen=True)
class Runs:
    """Events of independent runs by run, pixel and time; a cell is a pixel in a run."""

    runs: int
    region: np.ndarray  # of each pixel
    t: np.ndarray
    on: np.ndarray
    cell: np.ndarray

    @property
    def rank(self) -> np.ndarray:
        """Place of each event among those of its cell, from 0."""
        start = np.flatnonzero(np.diff(self.cell, prepend=-1))
        return np.arange(len(self.t)) - np.repeat(start, np.diff(start, append=len(self.t)))

    def table(self, chosen: np.ndarray, weights=None) -> np.ndarray:
        """Return sums over the chosen events of each cell, [runs, pixels]."""
        size = self.runs * len(self.region)
        return np.bincount(self.cell[chosen], weights, size).reshape(self.runs, len(self.region))

    def error(self, chosen: np.ndarray, weights=None) -> float:
        """Return the standard error of a sum over events: runs are independent, and pixels are.

        Pixels of one region may see different light (`blob`), so each has a mean of its own: what counts is the
        scatter over the runs, and of that the sum over the pixels, which hundreds of them make sharp.
        """
        return math.sqrt(self.runs * self.table(chosen, weights).var(axis=0, ddof=1).sum())


def recorded_runs(clip: str, stored, pixel: BrownianPixel, runs: int, cut: int | None = None) -> Runs:
    """Return runs of ours, the frames of constant light cut anew if `cut` says into how many."""
    times, region = stored["t_us"] * 1e-6, stored["region"].ravel().astype(int)
    if clip == "sine":
        # Four in 64,000 pixels of patch 9 fire a whole cycle early; one of their 1,280 did, which makes the
        # scatter of their times four times that of the others. Only as many tell how such a scatter scatters.
        region = np.append(region, np.full(3500, 9))
        frames = stored["light"].T[:, None, region]
    elif len(stored["frames"]) > 1:
        frames = stored["frames"].reshape(len(times), 1, -1)
    else:
        times = times if cut is None else np.linspace(0.0, times[-1], cut + 1)
        frames = np.broadcast_to(stored["frames"].reshape(1, 1, -1), (len(times), 1, len(region)))
    found = [sent(frames, times, pixel, seed=100 + run) for run in range(runs)]
    run = np.repeat(np.arange(runs), [len(one) for one in found])
    t, x = (np.concatenate([getattr(one, name) for one in found]) for name in ("t_us", "x"))
    order = np.lexsort((t, x, run))
    on = np.concatenate([one.p for one in found])[order]
    return Runs(runs, region, t[order].astype(np.int64), on, (run * len(region) + x)[order])


def compared(ours: Runs, about: dict) -> Iterator[Compared]:
    """Yield the comparison of each statistic that meta.json holds for `law`."""
    law = about["statistics"]["law"]
    pixel, gap, rank = ours.cell % len(ours.region), np.diff(ours.t, prepend=0), ours.rank
    for number, theirs in enumerate(law["regions"]):
        mine = ours.region == number
        inside, few = mine[pixel], (theirs["pixels"] * theirs["runs"], int(mine.sum()) * ours.runs)
        for sign, name in ((True, "on"), (False, "off")):
            chosen = inside & (ours.on == sign)
            yield shared(ours, f"{number} {name}", "count", chosen, theirs[name]["mean_per_pixel"], few)
            counts = ours.table(chosen)[:, mine]
            variance, fourth = cumulants(counts)
            # a variance of n runs has the variance 2 s^4 / (n - 1) + k4 / n: its estimate without bias
            n = ours.runs
            squared = ((2 * n * variance**2 + (n - 1) * fourth) / (n * (n + 1))).sum() / mine.sum() ** 2
            error = math.sqrt(max(squared, 0.0) * (1 + few[1] / few[0]))
            difference = variance.mean() - theirs[name]["var"]
            yield Compared(f"{number} {name}", "variance", difference, error, 4 / few[0])
        if "phase_histogram_24" in theirs:
            phase = np.floor(24 * (ours.t * 1e-6 * about["regions"][number]["hz"] % 1)).astype(int)
            for sign, name in ((True, "on"), (False, "off")):
                where, bins = np.flatnonzero(inside & (ours.on == sign)), theirs["phase_histogram_24"][name]
                yield from histogram(ours, f"{number} phase {name}", where, phase[where], bins, few)
        for first, second in ((True, True), (True, False), (False, True), (False, False)):
            name = "interval_" + "_".join("ON" if one else "OFF" for one in (first, second))
            where = np.flatnonzero(inside & (rank > 0) & (ours.on == second))
            where = where[ours.on[where - 1] == first]
            told = theirs.get(name, {"n": 0})
            yield shared(ours, f"{number} {name}", "n", where, told["n"] / few[0], few)
            if told["n"]:
                place = np.digitize(gap[where], about["interval_edges_us"]) - 1
                yield from histogram(ours, f"{number} {name}", where, place, told["histogram"], few)
                yield from moments(
                    ours, f"{number} {name}", where, gap[where], told["mean_us"], told["sd_us"], few
                )
                yield from deciles(ours, f"{number} {name}", where, gap[where], told, few)
        for k, told in enumerate(theirs["kth_event_us"]):
            where = np.flatnonzero(inside & (rank == k))
            yield shared(ours, f"{number} event {k}", "n", where, told["n"] / few[0], few)
            yield from moments(
                ours, f"{number} event {k}", where, ours.t[where], told["mean"], told["sd"], few, 0.5
            )
    if "time_edges_us" in law:
        yield from bins_of_the_array(ours, law)


def shared(ours: Runs, group: str, name: str, chosen: np.ndarray, theirs: float, few: tuple) -> Compared:
    """Compare numbers of events a pixel: few = their pixels times runs, and ours.

    Their error is ours for as many pixels and runs, in proportion to the root of the number: of rare events,
    ours or theirs may be the ones that had some. Where ours have none, theirs count as Poisson's.
    """
    found = ours.table(chosen).sum() / few[1]
    per_event = ours.error(chosen) ** 2 / few[1] / found if found > 0 else 1.0
    error = math.sqrt(per_event * (found / few[1] + theirs / few[0]))
    return Compared(group, name, found - theirs, error, 4 / few[0], mean=True)


def cumulants(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return variance and fourth cumulant of each pixel's counts [runs, pixels]: Fisher's k-statistics."""
    n = len(counts)
    square, fourth = (((counts - counts.mean(axis=0)) ** power).sum(axis=0) for power in (2, 4))
    k4 = ((n + 1) * n * fourth - 3 * (n - 1) * square**2) / ((n - 1) * (n - 2) * (n - 3))
    return square / (n - 1), k4


def histogram(ours: Runs, group: str, where, place: np.ndarray, theirs: list, few: tuple) -> Iterator[Compared]:
    """Compare bins with more than ten events, as meta.json says, and all others together."""
    many = np.flatnonzero(np.array(theirs) > 10)
    for k in many:
        yield shared(ours, group, f"bin {k}", where[place == k], theirs[k] / few[0], few)
    rest = (sum(theirs) - sum(theirs[k] for k in many)) / few[0]
    others = ~np.isin(place, many) & (place >= 0) & (place < len(theirs))
    yield shared(ours, group, "rare bins", where[others], rest, few)


def moments(
    ours: Runs, group: str, where, values: np.ndarray, mean: float, sd: float, few: tuple, stamp: float = 0.0
) -> Iterator[Compared]:
    """Compare mean and standard deviation; stamp: by what times are apart if cut off instead of rounded, us.

    To first order a mean moves by (x - mean) / n with each x, and a standard deviation by half of
    ((x - mean)^2 - sd^2) / (n sd): sums over events, whose error the runs tell. Both are stored to 0.1 us.
    """
    if len(values) < 30:
        return
    away, spread = values - values.mean(), values.std(ddof=1)  # as theirs
    pooled = math.sqrt(1 + few[1] / few[0]) / len(values)
    error = ours.error(where, away) * pooled
    yield Compared(group, "mean", values.mean() - mean, error, 0.05 + stamp, mean=True)
    error = ours.error(where, (away**2 - spread**2) / (2 * spread)) * pooled
    yield Compared(group, "sd", spread - sd, error, 0.05)


def deciles(ours: Runs, group: str, where, values: np.ndarray, theirs: dict, few: tuple) -> Iterator[Compared]:
    """Compare the share of ours below each decile of theirs: no density is needed for that error.

    A decile is stored as a whole number of us and lies between two such: the share may be that at either end.
    """
    if min(theirs["n"], len(values)) < 100:
        return
    for k, value in enumerate(theirs["deciles_us"]):
        level, below = (k + 1) / 10, values <= value
        low, high = (values <= value - 2).mean(), (values <= value + 1).mean()
        error = ours.error(where, below - below.mean()) * math.sqrt(1 + few[1] / few[0]) / len(values)
        yield Compared(group, f"decile {k + 1}", max(low - level, level - high, 0.0), error, 0.0)


def bins_of_the_array(ours: Runs, law: dict) -> Iterator[Compared]:
    """Compare events of the array per time bin: their mean over the runs, and their scatter from run to run.

    Of independent pixels, variances and fourth cumulants add up: from ours they are sharp. Theirs is a variance
    of n = 20 draws, whose own is 2 s^4 / (n - 1) + k4 / n: a gamma law of that width tells how likely it is,
    and the normal quantile of that is the deviation.
    """
    place, runs = np.digitize(ours.t, law["time_edges_us"]) - 1, law["regions"][0]["runs"]
    for sign, name in ((True, "on"), (False, "off")):
        for k, (theirs, sd) in enumerate(zip(law[f"{name}_per_bin"], law[f"sd_over_runs_{name}"], strict=True)):
            chosen = (ours.on == sign) & (place == k)
            yield shared(ours, f"{name} bin {k}", "count", chosen, theirs, (runs, ours.runs))
            variance, fourth = (float(one.sum()) for one in cumulants(ours.table(chosen)))
            if variance * runs > 10:  # more than ten events that are not in every run
                width = 2 / (runs - 1) + fourth / variance**2 / runs
                likely = float(gamma.cdf(sd**2 / variance, 1 / width, scale=width))
                deviation = NormalDist().inv_cdf(min(max(likely, 1e-15), 1 - 1e-15))
                yield Compared(f"{name} bin {k}", "variance", deviation, 1.0, 0.0)


def objections(found: list[Compared]) -> list[str]:
    """Return what contradicts the same law.

    Means lie within four standard errors, as meta.json says; all others within what one in a hundred sets of so
    many normal draws goes beyond; and of all that scatter, no more lie beyond two than the 4.55 % of normal
    draws and four standard errors of such a share, the statistics of one group counted as one draw.
    """
    most = -NormalDist().inv_cdf(0.005 / len(found))
    far = [
        f"{one.group} {one.name}: {one.difference:.6g} +- {one.error:.3g}, {one.deviation:.2f} standard errors"
        for one in found
        if one.deviation > (4.0 if one.mean else most)
    ]
    scattered = [one for one in found if one.error > 0]
    share, chance = float(np.mean([one.deviation > 2 for one in scattered])), 2 * NormalDist().cdf(-2.0)
    groups = len({one.group for one in scattered})
    if share > chance + 4 * math.sqrt(chance * (1 - chance) / groups):
        far.append(f"{share:.1%} of {len(scattered)} lie beyond two standard errors")
    return far


def voltmeter(shared_data, clip: str) -> tuple[dict, dict, BrownianPixel, int]:
    """Return what meta.json says of a clip, its arrays, its pixel, and how many runs its statistics hold."""
    folder = shared_data / "voltmeter"
    about = json.loads((folder / "meta.json").read_text())["clips"][clip]
    pixel = replace(BrownianPixel.voltmeter(*about["k"]), initial_phase="rest", increments="linear")
    with np.load(folder / f"{clip}.npz") as stored:
        arrays = {name: stored[name] for name in stored.files if not name.startswith(("code", "law"))}
    return about, arrays, pixel, about["statistics"]["law"]["regions"][0]["runs"]


@pytest.mark.parametrize(
    ("clip", "cut", "least"),
    [
        ("grey", None, 220), ("grey", 1, 220), ("grey", 100, 220),
        ("strong_noise", None, 1100), ("strong_noise", 1, 1100), ("strong_noise", 100, 1100),
        ("blob", None, 350), ("sine", None, 900),
    ],
)  # fmt: skip
def test_the_law_of_dvs_voltmeter(shared_data, clip, cut, least) -> None:
    """Every statistic of `law`, whatever number of frames says that the light is constant."""
    about, stored, pixel, runs = voltmeter(shared_data, clip)
    found = list(compared(recorded_runs(clip, stored, pixel, runs, cut), about))
    assert sum(one.error > 0 for one in found) >= least
    assert not objections(found)


@pytest.mark.parametrize(
    ("clip", "noise", "threshold"),
    [("grey", 1.05, 1.0), ("blob", 1.4, 1.0), ("blob", 1.0, 1.005), ("sine", 1.0, 1.002)],
)
def test_another_law_is_told(shared_data, clip, noise, threshold) -> None:
    """What the comparison is worth: it sees noise a twentieth stronger, thresholds half a per cent higher."""
    about, stored, pixel, runs = voltmeter(shared_data, clip)
    pixel = replace(
        pixel,
        photon_noise=noise * pixel.photon_noise,
        dark_noise=noise * pixel.dark_noise,
        threshold_on=threshold * pixel.threshold_on,
        threshold_off=threshold * pixel.threshold_off,
    )
    assert objections(list(compared(recorded_runs(clip, stored, pixel, runs), about)))


@pytest.mark.parametrize("clip", ["grey", "strong_noise", "blob", "sine"])
def test_a_clip_sends_the_same_events_in_one_piece_or_in_a_hundred(shared_data, clip) -> None:
    _, stored, pixel, _ = voltmeter(shared_data, clip)
    times = stored["t_us"] * 1e-6
    frames = stored["light"].T[:, stored["patch"]] if clip == "sine" else stored["frames"]
    frames = np.ascontiguousarray(np.broadcast_to(frames, (len(times), *frames.shape[1:])))
    whole, *cut = (EventStream(pixel, frames.shape[1:], seed=100) for _ in range(2))
    whole.push(frames, times)
    for some in np.array_split(np.arange(len(times)), 100):
        cut[0].push(frames[some], times[some])
    one, other = whole.finish(), cut[0].finish()
    assert len(one) > 5000
    for name in ("t_us", "x", "y", "p"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
