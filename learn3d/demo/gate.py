"""The gate of the page's server: a stranger's web page in the same browser must not be able to use it."""

from __future__ import annotations

import ipaddress
import socket
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

#: The browser itself refuses whatever is not this server's, and shows the page in no other page's frame.
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class Gate:
    """ASGI middleware that refuses requests under another name than this machine's, and those of other pages.

    A stranger's name can lead a browser to this server (DNS rebinding), so the Host must be `host`, an address or a
    name of this machine.
    """

    def __init__(self, app: ASGIApp, host: str) -> None:
        machine = socket.gethostname()
        self._app, self._names = app, {host, "localhost", machine, f"{machine}.local"}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)

        headers = Headers(scope=scope)
        host, origin = headers.get("host", ""), headers.get("origin")
        app = self._app
        if not self._is_here(host):
            app = PlainTextResponse("open this page by the address of its machine", 403)
        elif origin is not None and urlsplit(origin).netloc != host:
            app = PlainTextResponse("this request comes from another page", 403)
        await app(scope, receive, guarded)

    def _is_here(self, host: str) -> bool:
        try:
            name = urlsplit(f"//{host}").hostname or ""
            return name in self._names or bool(ipaddress.ip_address(name))
        except ValueError:
            return False
