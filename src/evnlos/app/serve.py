"""Starting the page, and what is done around Gradio to keep others out.

- What is done around Gradio: foreign names refused, a policy for the browser, our scripts in the page.
- Starting the page: on this machine alone unless told otherwise, asking nobody, leaving nothing behind.
"""

from __future__ import annotations

import logging
import os
import re
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from evnlos.errors import ConfigError, MissingDependencyError
from evnlos.machine import Progress, Step, listening_address, silent
from evnlos.untrusted import is_local, names_this_machine

# The browser itself refuses what would leave this server.
_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; worker-src 'self' blob:; "
    "form-action 'self'; base-uri 'self'; object-src 'none'; frame-ancestors 'none'"
)
_MOST_WORDS = 4_000_000  # bytes of a request that is no upload: settings of controls, a small drawing
_MOST_UPLOADS = 10  # times the largest file, in all files that wait in the scratch folder
_END = b"</body>"
_FORWARDED = (b"x-forwarded-host", b"x-forwarded-proto", b"x-gradio-server", b"forwarded")


def middleware(
    scripts: str, own: str | None, scratch: Path | None = None, limit_bytes: int = 0, proxy: str = ""
) -> list[Any]:
    """Return the middleware of the page.

    Args:
        scripts: HTML for the end of the page's body. Gradio's own way puts scripts into the page after all of
            its own have run, seconds later.
        own: Name of this machine that the page listens under, where nobody else shall reach it: requests under
            foreign names are refused. None: it is open to the network, under whatever name that has for it.
        scratch: Folder of the uploads; None: they are not bounded.
        limit_bytes: Largest upload, bytes; all of them together may be ten times as large.
        proxy: Address under which a proxy shows the page; empty: none does.
    """
    from starlette.middleware import Middleware

    always = [
        Middleware(_Policy),
        Middleware(_Forwarded),
        Middleware(_Senders, proxy=proxy),
        Middleware(_Scripts, scripts=scripts),
    ]
    if scratch is not None:
        always.insert(3, Middleware(_Bounds, scratch=scratch, limit_bytes=limit_bytes))
    return always if own is None else [Middleware(_Names, own=own), *always]


class _Names:
    """Refuses requests under a foreign name: they are of a page from elsewhere whose name leads here."""

    def __init__(self, app: Any, own: str) -> None:
        self.app, self.own = app, own

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        headers = dict(scope.get("headers", ()))
        if scope["type"] == "lifespan" or names_this_machine(
            headers.get(b"host", b"").decode("latin-1"), self.own
        ):
            await self.app(scope, receive, send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            await _refuse(send, 403, b"this page answers to 127.0.0.1 and localhost only")


async def _refuse(send: Any, status: int, text: bytes) -> None:
    about = [(b"content-type", b"text/plain"), (b"content-length", str(len(text)).encode())]
    await send({"type": "http.response.start", "status": status, "headers": about})
    await send({"type": "http.response.body", "body": text})


class _Forwarded:
    """Takes away what a request says of a proxy: anybody can say it, and Gradio writes it into the page."""

    def __init__(self, app: Any) -> None:
        self.app = app

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if "headers" in scope:
            kept = [pair for pair in scope["headers"] if pair[0].lower() not in _FORWARDED]
            scope = {**scope, "headers": kept}
        await self.app(scope, receive, send)


class _Senders:
    """Refuses what the page of another site sends here: browsers let it, though it can't read the answer."""

    def __init__(self, app: Any, proxy: str = "") -> None:
        self.app, self.proxy = app, proxy

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        is_sent = scope["type"] == "http" and scope.get("method") not in (None, "GET", "HEAD", "OPTIONS")
        headers = {name.decode(): value.decode("latin-1") for name, value in scope.get("headers", ())}
        if is_sent and is_foreign(headers, self.proxy):
            await _refuse(send, 403, b"this page takes nothing from other sites")
        else:
            await self.app(scope, receive, send)


def is_foreign(headers: Mapping[str, str], proxy: str = "") -> bool:
    """Return whether a request comes from the page of another site, by what its browser says.

    A program that is no browser says nothing, and is believed.

    Args:
        headers: The request's headers, names in small letters.
        proxy: Address under which a proxy shows the page.

    Example:
        >>> is_foreign({"host": "localhost:7860", "origin": "http://evil.example"})
        True
        >>> is_foreign({"host": "localhost:7860", "origin": "http://localhost:7860"})
        False
    """
    site = headers.get("sec-fetch-site")
    if site is not None:
        return site not in ("same-origin", "none")
    origin = headers.get("origin")
    names = [headers.get("host"), *([urlsplit(proxy).netloc] if proxy else [])]
    return origin is not None and origin.partition("://")[2] not in names


class _Bounds:
    """Refuses requests that are larger than any of the page's own, and uploads where many lie already."""

    def __init__(self, app: Any, scratch: Path, limit_bytes: int) -> None:
        self.app, self.scratch, self.limit_bytes = app, scratch, limit_bytes

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] != "http" or scope.get("method") not in ("POST", "PUT", "PATCH"):
            await self.app(scope, receive, send)
            return
        length = dict(scope["headers"]).get(b"content-length", b"")
        if not length.isdigit():
            await _refuse(send, 411, b"say how long the request is")
            return
        if not scope["path"].rstrip("/").endswith("/upload"):
            is_large, status, text = int(length) > _MOST_WORDS, 413, b"the request is too large"
        else:
            there = sum(path.stat().st_size for path in self.scratch.rglob("*") if path.is_file())
            is_large, status = there + int(length) > _MOST_UPLOADS * self.limit_bytes, 507
            text = b"too many uploads wait here; try again in an hour, or start the page again"
        if is_large:
            await _refuse(send, status, text)
        else:
            await self.app(scope, receive, send)


class _Policy:
    """Tells browsers to fetch nothing from anywhere else."""

    def __init__(self, app: Any) -> None:
        self.app = app

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        async def send_with_policy(message: Any) -> None:
            if message["type"] == "http.response.start":
                extra = [
                    (b"content-security-policy", _POLICY.encode()),
                    (b"referrer-policy", b"no-referrer"),
                    (b"x-content-type-options", b"nosniff"),
                    (b"x-frame-options", b"DENY"),
                ]
                message = {**message, "headers": [*message.get("headers", []), *extra]}
            await send(message)

        await self.app(scope, receive, send_with_policy if scope["type"] == "http" else send)


class _Scripts:
    """Puts scripts at the end of the page that is answered at the root, which comes in one piece."""

    def __init__(self, app: Any, scripts: str) -> None:
        self.app, self.scripts = app, scripts.encode()

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        started: dict[str, Any] = {}

        async def send_with_scripts(message: Any) -> None:
            if message["type"] == "http.response.start":
                started.update(message)
                return
            if not started:
                await send(message)
                return
            body = message.get("body", b"")
            if not message.get("more_body"):
                body = body.replace(_END, self.scripts + _END)
                length = str(len(body)).encode()
                headers = [
                    (name, length if name == b"content-length" else value) for name, value in started["headers"]
                ]
                started["headers"] = headers
            await send({**started})
            started.clear()
            await send({**message, "body": body})

        below = scope.get("root_path", "")
        is_page = scope["type"] == "http" and scope["path"].removeprefix(below) in ("", "/")
        await self.app(scope, receive, send_with_scripts if is_page else send)


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


def serve(
    server: Server,
    weights: tuple[Path, ...] = (),
    ready: Callable[[str], None] | None = None,
    progress: Progress = silent,
) -> None:
    """Run the page until it is interrupted; uploads live in a folder that is deleted then.

    Args:
        server: Where.
        weights: Weights files, or folders of runs.
        ready: Called with the page's address once it can be opened.
        progress: Called with what is at work until then.

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
        with running(server, weights, progress) as address:
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


_OPENING = "open the page"


@contextmanager
def running(server: Server, weights: tuple[Path, ...] = (), progress: Progress = silent) -> Iterator[str]:
    """Yield the address of the running page, and stop it afterwards. Arguments and errors as in `serve`."""
    progress(Step(_OPENING, 0, 3, "stages", within="libraries"))
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
    from evnlos.app.controls import Controls, link_of, picked
    from evnlos.app.page import build_page, simulated, theme
    from evnlos.app.views import own_networks

    progress(Step(_OPENING, 1, 3, "stages", within="the first images"))
    networks = own_networks(weights)
    controls = Controls(columns=server.columns)
    pieces = simulated(controls, picked("R"), networks, link_of(controls, "R"))
    first = next(pieces)
    if not networks.own:  # those of the package are small and quick
        first = next(pieces)
    # The verdict on the first setup takes seconds until all is compiled: it is made while the page loads.
    threading.Thread(target=lambda: list(pieces), daemon=True).start()
    limit = round(1e6 * server.upload_mb)
    progress(Step(_OPENING, 2, 3, "stages", within="its layout"))
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
            progress(Step(_OPENING, 3, 3, "stages"))
            yield address
        finally:
            page.close(verbose=False)


def _script(name: str) -> str:
    return f"<script>{(_HERE / name).read_text(encoding='utf-8')}</script>"
