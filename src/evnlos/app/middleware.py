"""What is done to Gradio's answers on their way out: a policy for the browser, our scripts in the page."""

from __future__ import annotations

from typing import Any

# The browser itself refuses what would leave this server.
_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; worker-src 'self' blob:; "
    "form-action 'self'; base-uri 'self'; object-src 'none'"
)
_END = b"</body>"


def middleware(scripts: str) -> list[Any]:
    """Return the middleware of the page.

    Args:
        scripts: HTML for the end of the page's body. Gradio's own way puts scripts into the page after all of
            its own have run, seconds later.
    """
    from starlette.middleware import Middleware

    return [Middleware(_Policy), Middleware(_Scripts, scripts=scripts)]


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

        is_page = scope["type"] == "http" and scope["path"] == "/"
        await self.app(scope, receive, send_with_scripts if is_page else send)
