"""Access control of the page's server: other web pages in the same browser must not be able to use it."""

from __future__ import annotations

import ipaddress
import socket
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

#: The browser loads nothing from other servers, and does not show the page in a frame of another page.
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class Gate:
    """ASGI middleware that refuses requests of other web pages, and those to another host name.

    An attacker's host name can point to this server (DNS rebinding). So the Host header must be an IP address, `host`
    or a name of this machine.
    """

    def __init__(self, app: ASGIApp, host: str) -> None:
        machine = socket.gethostname()
        self._app, self._names = app, {host, "localhost", machine, f"{machine}.local"}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)

        headers = Headers(scope=scope)
        host, origin = headers.get("host", ""), headers.get("origin")
        app = self._app
        if not self._is_this_machine(host):
            app = PlainTextResponse("open this page by the address of its machine", 403)
        elif origin is not None and urlsplit(origin).netloc != host:
            app = PlainTextResponse("this request comes from another page", 403)
        await app(scope, receive, send_with_headers)

    def _is_this_machine(self, host: str) -> bool:
        try:
            name = urlsplit(f"//{host}").hostname or ""
            return name in self._names or bool(ipaddress.ip_address(name))
        except ValueError:
            return False
