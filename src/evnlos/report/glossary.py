"""The words of a report for readers from elsewhere: explained at its end, linked where they first stand."""

from __future__ import annotations

import html

_WORDS = {
    "epnp": (
        "EPNP",
        "the paper's training: first on simulation, then fine-tuned on a few real captures. Short for "
        "Event-enhanced Passive Non-line-of-sight imaging with Physical embedding.",
    ),
    "e2e": ("E2E", "end to end: trained on the real captures alone, from random weights."),
    "simulation": ("simulation only", "trained on simulation, and never shown a real capture."),
    "frame": ("frame", "the network sees pictures of the wall, as an ordinary camera takes them."),
    "event": (
        "event",
        "the network sees what an event camera sends: each of its pixels reports when its light has grown or "
        "fallen by a set share. It comes as a time surface, a map of how lately each pixel last reported.",
    ),
    "fusion": ("fusion", "the network sees both, frames and events, and joins them."),
    "sequence": (
        "sequence",
        "the network sees all time steps of one pass of the object together and draws the object once; without "
        "the word it sees a single time step. The motion of the object must be known.",
    ),
    "psnr_db": (
        "PSNR",
        "peak signal-to-noise ratio, in dB: how small the mean squared error is beside full white. 10 dB more "
        "are a tenth of the error. Mostly black pictures score high even where nothing is seen.",
    ),
    "psnr_box_db": (
        "PSNR in the box",
        "PSNR on the smallest box that holds the true object, grown by 2 pixels, without the black around it.",
    ),
    "ssim": (
        "SSIM",
        "structural similarity: compares brightness, contrast and structure in small windows; 1 is the same.",
    ),
    "ms_ssim": (
        "MS-SSIM",
        "SSIM at several scales, from fine detail to coarse shape; 1 is the same.",
    ),
    "haarpsi": (
        "HaarPSI",
        "compares edges at several scales by Haar wavelets, close to how people judge; 1 is the same.",
    ),
    "gmsd": (
        "GMSD",
        "gradient magnitude similarity deviation: how unevenly edges are kept. Lower is better; 0 is the same.",
    ),
    "lpips": (
        "LPIPS",
        "how far apart a network for photographs finds the two pictures. Lower is better; 0 is the same.",
    ),
}


class Glossary:
    """Words of one page; each is linked where it is first asked for, and explained once at the end."""

    def __init__(self) -> None:
        self._linked: set[str] = set()

    def link(self, key: str, words: str | None = None) -> str:
        """Return a word as HTML: a link to its explanation the first time, afterwards the word alone.

        Args:
            key: Which word; one that is not explained stays as it is.
            words: How it is written here; None: as in the glossary.
        """
        shown = html.escape(words or _WORDS.get(key, (key, ""))[0])
        if key in self._linked or key not in _WORDS:
            return shown
        self._linked.add(key)
        return f"<a href='#word-{key}'>{shown}</a>"

    def label(self, words: str) -> str:
        """Return a run's heading, such as "EPNP sequence frame", with each word linked at its first use."""
        rest = words.replace("simulation only", "simulation", 1).split(" ")
        long = {"simulation": "simulation only"}
        return " ".join(self.link(one.lower(), long.get(one, one)) for one in rest)

    def section(self, metrics: list[str]) -> str:
        """Return the explanations: of the kinds of networks and trainings, and of the metrics shown."""
        other = [key for key in _METRIC_KEYS if key not in metrics]
        rows = "".join(
            f"<dt id='word-{key}'>{html.escape(word)}</dt><dd>{html.escape(said)}</dd>"
            for key, (word, said) in _WORDS.items()
            if key not in other
        )
        return f"<h2>Words</h2><dl>{rows}</dl>"


_METRIC_KEYS = ("psnr_db", "psnr_box_db", "ssim", "ms_ssim", "haarpsi", "gmsd", "lpips")
