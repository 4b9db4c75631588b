"""What is done around Gradio: foreign names refused, a policy for the browser, our scripts in the page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from evnlos.hosts import names_this_machine

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
