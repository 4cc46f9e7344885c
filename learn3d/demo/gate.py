"""The gate of the page's server: a stranger's web page in the same browser must not be able to use it."""

from __future__ import annotations

import contextlib
import ipaddress
import socket
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.requests import ClientDisconnect
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Receive, Scope, Send

MOST_BYTES = 33 * 2**20  # of a request: one picture and its form


class Gate:
    """ASGI middleware that refuses requests for other names than this machine's, from other origins, and large ones.

    A stranger's name can lead a browser to this server (DNS rebinding), so the Host must be `host`, an address or a
    name of this machine. `/file=http...` would fetch a file from elsewhere. A visitor who leaves during an upload is
    no error.
    """

    def __init__(self, app: ASGIApp, host: str) -> None:
        machine = socket.gethostname()
        self._app, self._names = app, {host, "localhost", machine, f"{machine}.local"}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan" or not (refusal := self._refusal(scope)):
            with contextlib.suppress(ClientDisconnect):
                await self._app(scope, receive, send)
            return
        await PlainTextResponse(*refusal)(scope, receive, send)

    def _refusal(self, scope: Scope) -> tuple[str, int] | None:
        headers = Headers(scope=scope)
        host, origin = headers.get("host", ""), headers.get("origin")
        if not self._is_here(host):
            return "open this page by the address of its machine", 403
        if origin is not None and urlsplit(origin).netloc != host:
            return "this request comes from another page", 403
        if "file=http" in scope["path"]:
            return "nothing is fetched from elsewhere", 403
        length = headers.get("content-length", "")
        if "transfer-encoding" in headers or (length and int(length) > MOST_BYTES):
            return f"a request has at most {MOST_BYTES} bytes", 413
        return None

    def _is_here(self, host: str) -> bool:
        try:
            name = urlsplit(f"//{host}").hostname or ""
            return name in self._names or bool(ipaddress.ip_address(name))
        except ValueError:
            return False
