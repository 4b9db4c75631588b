"""Starting the page: on this machine alone unless told otherwise, asking nobody, leaving nothing behind."""

from __future__ import annotations

import logging
import os
import re
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from evnlos.errors import ConfigError, MissingDependencyError
from evnlos.hosts import is_local, listening_address

_HERE = Path(__file__).parent
# Every switch that Gradio and what it brings have for talking to somebody else.
_QUIET = {
    "GRADIO_ANALYTICS_ENABLED": "False",
    "GRADIO_SHARE": "False",
    "GRADIO_MCP_SERVER": "False",
    "GRADIO_SSR_MODE": "False",
    "GRADIO_RUN_HISTORY": "False",
    "HF_HUB_DISABLE_TELEMETRY": "1",
    "HF_HUB_OFFLINE": "1",
    "DO_NOT_TRACK": "1",
}
_ADDRESS = re.compile(r"https?://[A-Za-z0-9.-]+(:[0-9]{1,5})?(/[A-Za-z0-9._/-]*)?")


@dataclass(frozen=True)
class Server:
    """Where and with what the page runs.

    Raises:
        ConfigError: The port or the limit is out of range, or the proxy is no address.
    """

    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 lets every machine of the network in."""
    port: int = 7860
    """Port to listen on; 0 takes a free one."""
    upload_mb: float = 200.0
    """Largest upload, and largest content of an uploaded zip, MB."""
    columns: int = 48
    """Columns of the simulated camera, pixels; time and memory grow with its square."""
    open: bool = False
    """Open the page in the browser."""
    proxy: str = ""
    """Address under which a proxy shows the page to others: https://nlos.example.org."""

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65_535:
            raise ConfigError(f"port is {self.port}; give 0 (a free one) to 65535")
        if not 0 < self.upload_mb <= 100_000:
            raise ConfigError(f"upload_mb is {self.upload_mb}; give more than 0 and at most 100000 MB")
        if self.proxy and not _ADDRESS.fullmatch(self.proxy):
            raise ConfigError(f"proxy is {self.proxy!r}; give an address such as https://nlos.example.org")


def serve(server: Server, weights: tuple[Path, ...] = (), ready: Callable[[str], None] | None = None) -> None:
    """Run the page until it is interrupted; uploads live in a folder that is deleted then.

    Args:
        server: Where.
        weights: Weights files, or folders of runs.
        ready: Called with the page's address once it can be opened.

    Raises:
        MissingDependencyError: Gradio is not installed.
        ConfigError: Host or port cannot be had.
        DataError: Weights are missing or damaged.
    """
    ended = threading.Event()

    def end(*_: object) -> None:
        if not ended.is_set():  # a second signal does not stop the tidying
            ended.set()
            raise KeyboardInterrupt

    previous = signal.signal(signal.SIGTERM, end)
    try:
        with running(server, weights) as address:
            if ready is not None:
                ready(address)
            with suppress(KeyboardInterrupt):
                if not ended.is_set():  # the interruption may have been lost in somebody's clean-up
                    threading.Event().wait()
    except KeyboardInterrupt:
        if not ended.is_set():
            raise
    finally:
        signal.signal(signal.SIGTERM, previous)


@contextmanager
def running(server: Server, weights: tuple[Path, ...] = ()) -> Iterator[str]:
    """Yield the address of the running page, and stop it afterwards. Arguments and errors as in `serve`."""
    os.environ.update(_QUIET)
    own = server.host if is_local(listening_address(server.host, server.port)) else None
    if own is None:
        logging.getLogger("evnlos").warning(
            "warning: --host %s opens the page to the network, and it asks for no password: whoever reaches it "
            "may upload files and use this machine's time; put it behind a proxy that asks, or use ssh -L",
            server.host,
        )
    try:
        import gradio
    except ImportError:
        raise MissingDependencyError("the page needs Gradio: pip install 'evnlos[app]'") from None
    from evnlos.app.controls import Controls
    from evnlos.app.hidden import picked
    from evnlos.app.middleware import middleware
    from evnlos.app.networks import own_networks
    from evnlos.app.page import build_page, theme
    from evnlos.app.work import simulated

    networks = own_networks(weights)
    controls = Controls(columns=server.columns)
    pieces = simulated(controls, picked("R"), networks)
    first = next(pieces)
    if not networks.own:  # those of the package are small and quick
        first = next(pieces)
    # The verdict on the first rig takes seconds where nothing is compiled yet: it is made while the page loads.
    threading.Thread(target=lambda: list(pieces), daemon=True).start()
    limit = round(1e6 * server.upload_mb)
    with tempfile.TemporaryDirectory(prefix="evnlos-app-", ignore_cleanup_errors=True) as scratch:
        os.environ["GRADIO_TEMP_DIR"] = scratch
        page = build_page(gradio, first, controls, networks, Path(scratch), limit)
        try:
            _, address, _ = page.queue(api_open=False).launch(
                server_name=server.host,
                server_port=server.port or None,
                share=False,
                inbrowser=server.open,
                prevent_thread_lock=True,
                show_error=False,
                quiet=True,
                max_file_size=limit,
                footer_links=[],
                run_history=False,
                enable_monitoring=False,
                ssr_mode=False,
                pwa=False,
                mcp_server=False,
                root_path=server.proxy or None,
                theme=theme(gradio),
                css=(_HERE / "page.css").read_text(encoding="utf-8"),
                app_kwargs={
                    "middleware": middleware(
                        _script("page.js") + _script("opening.js"), own, Path(scratch), limit, server.proxy
                    ),
                    "docs_url": None,
                    "redoc_url": None,
                    "openapi_url": None,
                },
            )
        except OSError:  # taken since it was looked at, or none is free
            raise ConfigError(
                f"cannot listen on {server.host} port {server.port or '7860 to 7959'}; give another --port"
            ) from None
        try:
            yield address
        finally:
            page.close(verbose=False)


def _script(name: str) -> str:
    return f"<script>{(_HERE / name).read_text(encoding='utf-8')}</script>"
