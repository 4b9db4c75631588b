"""What is done around Gradio: foreign names refused, a policy for the browser, our scripts in the page."""

from __future__ import annotations

from typing import Any

from evnlos.hosts import names_this_machine

# The browser itself refuses what would leave this server.
_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; worker-src 'self' blob:; "
    "form-action 'self'; base-uri 'self'; object-src 'none'"
)
_END = b"</body>"


def middleware(scripts: str, own: str | None) -> list[Any]:
    """Return the middleware of the page.

    Args:
        scripts: HTML for the end of the page's body. Gradio's own way puts scripts into the page after all of
            its own have run, seconds later.
        own: Name of this machine that the page listens under, where nobody else shall reach it: requests under
            foreign names are refused. None: it is open to the network, under whatever name that has for it.
    """
    from starlette.middleware import Middleware

    always = [Middleware(_Policy), Middleware(_Scripts, scripts=scripts)]
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
            text = b"this page answers to 127.0.0.1 and localhost only"
            about = [(b"content-type", b"text/plain"), (b"content-length", str(len(text)).encode())]
            await send({"type": "http.response.start", "status": 403, "headers": about})
            await send({"type": "http.response.body", "body": text})


class _Policy:
    """Tells browsers to fetch nothing from anywhere else."""

    def __init__(self, app: Any) -> None:
        self.app = app

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        async def send_with_policy(message: Any) -> None:
            if message["type"] == "http.response.start":
                extra = [(b"content-security-policy", _POLICY.encode()), (b"referrer-policy", b"no-referrer")]
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
