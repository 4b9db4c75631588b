"""`evnlos app` and `evnlos live`: a page to play with, and reconstruction while events come in.

- `evnlos app`: a page to play with.
- `evnlos live`: events as they come in, pictures out.
"""

from __future__ import annotations

import json
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from evnlos.app.serve import Server, serve
from evnlos.cli.console import Flat
from evnlos.cli.parsing import say
from evnlos.errors import ConfigError
from evnlos.files import write_atomically
from evnlos.live.run import RateOptions, Run
from evnlos.live.sources import SourceOptions, open_live


@dataclass(frozen=True)
class AppCommand:
    """A page to play with: hide something, choose wall and cameras, watch what can be seen; uploads too."""

    weights: tuple[Path, ...] = ()
    """Weights files, or folders of runs, that reconstruct beside the classical solvers; none takes those of
    the package."""
    server: Flat[Server] = field(default_factory=Server)

    def run(self) -> None:
        """Run the page until it is interrupted."""
        serve(self.server, self.weights, lambda address: print(f"{address}  (Ctrl+C stops it)", flush=True))


@dataclass(frozen=True)
class LiveCommand:
    """Reconstruct while events come in: a replay, a file that grows, or UDP packets."""

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Capture folder or event file (replayed), event file with --follow, or udp://127.0.0.1:7000."""
    weights: Path | None = None
    """Weights file, run's folder, or name of published weights, of single positions; of the modality event
    where SOURCE has no frames. None takes published ones: near-frame for a capture, else near-event."""
    headless: bool = False
    """Show no page; write the video and the latency table to --out."""
    out: Path | None = None
    """Folder for video and latency.json, new or empty; by default live-out where --headless, else none."""
    port: int = 8765
    """Port of the page on 127.0.0.1; 0 = any that is free."""
    pattern: Path | None = None
    """Fixed pattern to take from a capture's frames: the file that `calibrate` wrote, or its folder."""
    threads: int = 1
    """Threads of the network; more are quicker only where cores have nothing else to do."""
    json: bool = False
    """Print one JSON object at the end."""
    listening: Flat[SourceOptions] = field(default_factory=SourceOptions)
    pace: Flat[RateOptions] = field(default_factory=RateOptions)

    def run(self) -> None:
        """Show or record pictures until the source ends, and print how quick they were."""
        import torch

        from evnlos.data import load_pattern
        from evnlos.live.display import Page, Recorder, check_folder
        from evnlos.live.engine import Engine
        from evnlos.live.run import latency_table
        from evnlos.models import load_weights, published_for

        if self.threads < 1:
            raise ConfigError(f"threads is {self.threads}; give at least 1")
        torch.set_num_threads(self.threads)
        out = self.out or (Path("live-out") if self.headless else None)
        if out is not None:
            check_folder(out)
        name = self.weights
        weights = None if name is None else load_weights(name)
        pattern = load_pattern(self.pattern) if self.pattern else None
        source = open_live(self.source, self.listening, pattern)
        recorder = None
        try:
            with ExitStack() as stack:
                if weights is None:
                    modality = "frame" if source.has_frames else "event"
                    name = published_for(None, modality, is_motion_known=False)
                    weights = load_weights(name)
                    say(f"{name} makes the pictures: weights of the package, for its own setup; see --weights")
                engine = Engine(weights)
                run = Run(source, engine, self.pace)
                sinks = []
                if not self.headless:
                    page = stack.enter_context(
                        Page(run.statistics.now, self.port, f"{source.name}, {engine.modality.name}")
                    )
                    sinks.append(page)
                    say(f"{page.url} shows the pictures; Ctrl-C ends")
                    if source.waits:
                        page.wait_for_viewer(lambda: False)
                if out is not None:
                    recorder = stack.enter_context(Recorder(out))
                    sinks.append(recorder)
                run.go(sinks)
        finally:
            source.close()
        summary = run.statistics.summary() | {"weights": str(name), "modality": engine.modality.name}
        if out is not None and recorder is not None:
            summary |= {"recorded": recorder.recorded, "not_recorded": recorder.left_out}
            out.mkdir(parents=True, exist_ok=True)
            write_atomically(out / "latency.json", (json.dumps(summary, indent=1) + "\n").encode())
        if self.json:
            print(json.dumps(summary | {"out": None if out is None else str(out)}))
            return
        print(latency_table(summary))
        if recorder is not None:
            video = f"{recorder.path.name} ({recorder.recorded} pictures) and " if recorder.recorded else ""
            print(f"{out}: {video}latency.json")
