"""The server of the page: static files, and an address that turns pixels into meshes. It stores no visitor's data.

Other web pages in the same browser cannot use it.
"""

import asyncio
import contextlib
import ipaddress
import json
import logging
import socket
import threading
import webbrowser
from collections import deque
from collections.abc import AsyncIterator, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from learn3d.studio.demo.picture import EXAMPLES, SIDE, Picture, example, make_meshes, unpack
from learn3d.studio.picture_to_mesh.reconstruction import Model, load_model
from learn3d.terminal import plain, say

MOST_BYTES = 5 * SIDE**2  # largest body of a request
VISITORS = 200  # simultaneous requests, 260 MB in all; the browser of a later one tries again
PATIENCE = 30  # seconds in which a picture must arrive
_TICK = 0.05  # seconds
#: The browser loads nothing from other servers, and does not show the page in a frame of another page.
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class JobQueue:
    """Runs one job at a time, in the order of arrival, in a thread."""

    def __init__(self) -> None:
        self.closed: Callable[[], bool] = lambda: False  # whether the server stops
        self._thread, self._line = ThreadPoolExecutor(1), deque()

    async def run(self, job: Callable[[Callable[[dict], None]], None]) -> AsyncIterator[bytes]:
        """Run a job and yield the messages that it sends, each a line of JSON; before them {"place": jobs ahead of it}.

        A waiting job is dropped if the iteration ends early, because the visitor has left.
        """
        messages, ticket, place = deque(), object(), 0

        def send(message: dict) -> None:
            if self.closed():
                raise asyncio.CancelledError  # ends the job
            messages.append(message)

        def run_job() -> None:
            with contextlib.suppress(asyncio.CancelledError):
                job(send)

        self._line.append(ticket)
        work = asyncio.get_running_loop().run_in_executor(self._thread, run_job)
        try:
            while not (self.closed() or (work.done() and not messages)):
                ahead = self._line.index(ticket)
                if ahead and ahead != place:
                    yield _json_line({"place": ahead})
                place = ahead
                while messages:
                    yield _json_line(messages.popleft())
                await asyncio.wait([work], timeout=_TICK)
            if not self.closed():
                await work  # raises the job's error
        finally:
            self._line.remove(ticket)
            work.cancel()


def _json_line(message: dict) -> bytes:
    return json.dumps(message).encode() + b"\n"


def application(models: dict[str, Model], host: str, jobs: JobQueue) -> Starlette:
    """The page for these models, by their displayed names, served under the name `host`."""
    pictures = {category: example(category) for category in EXAMPLES}
    kinds = [kind for model in models.values() for kind in model.categories]

    def about(_: Request) -> Response:
        return JSONResponse({"kinds": list(dict.fromkeys(kinds)), "examples": list(pictures), "side": SIDE})

    def show_example(request: Request) -> Response:
        if (png := pictures.get(request.path_params["category"])) is None:
            raise HTTPException(404)
        return Response(png, media_type="image/png")

    async def mesh(request: Request) -> Response:
        try:
            picture = await asyncio.wait_for(_receive(request), PATIENCE)
        except (ValueError, KeyError) as error:
            raise HTTPException(400, f"this is no picture as the page sends it: {error}") from None
        except (asyncio.TimeoutError, ClientDisconnect):
            raise HTTPException(408, "the picture did not arrive in time") from None
        return StreamingResponse(jobs.run(partial(make_meshes, models, picture)), media_type="application/x-ndjson")

    routes = [
        Route("/about", about),
        Route("/examples/{category}.png", show_example),
        Route("/mesh", mesh, methods=["POST"]),
        Mount("/", StaticFiles(directory=Path(__file__).with_name("page"), html=True)),
    ]
    return Starlette(routes=routes, middleware=[Middleware(Gate, host=host)])


async def _receive(request: Request) -> Picture:
    """The picture in a request to /mesh?width=W&height=H (and &box=x,y,width,height), with its bytes in the body."""
    query = request.query_params
    box = tuple(map(int, query["box"].split(","))) if "box" in query else None
    if box is not None and len(box) != 4:
        raise ValueError("a box has four numbers")
    content = bytearray()
    async for chunk in request.stream():
        content += chunk
        if len(content) > MOST_BYTES:
            raise HTTPException(413, f"a picture has at most {MOST_BYTES} bytes")
    return unpack(bytes(content), int(query["width"]), int(query["height"]), box)


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


def serve(runs: Sequence[Path], *, host: str, port: int, browser: bool) -> None:
    """Load the models of `runs` (if empty, the small model of the package) and serve the page until a signal comes.

    Raises ValueError or OSError if a model cannot be loaded or the address is in use.
    """
    names = [Path(run).resolve().name for run in runs]
    names = [f"{name} {i + 1}" if names.count(name) > 1 else name for i, name in enumerate(names)]
    models = dict(zip(names, map(load_model, runs), strict=True)) or {"small model": load_model(None)}
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        listening = socket.create_server((host, port), family=family, backlog=VISITORS)
    except (OSError, OverflowError) as error:
        raise OSError(f"cannot open a page at {host}:{port}; give another --port or --host") from error
    errors = logging.StreamHandler()
    errors.format = lambda record: plain(logging.Handler.format(errors, record))  # it may contain a visitor's text
    logging.getLogger("uvicorn").addHandler(errors)
    jobs = JobQueue()
    limits = {"limit_concurrency": VISITORS, "timeout_graceful_shutdown": 5, "h11_max_incomplete_event_size": 2**14}
    off = dict.fromkeys(("access_log", "server_header", "proxy_headers"), False)
    options = {"http": "h11", "ws": "none", "lifespan": "off", "log_config": None, "log_level": "error"}
    server = uvicorn.Server(uvicorn.Config(application(models, host, jobs), **limits, **options, **off))
    jobs.closed = lambda: server.should_exit
    name = "localhost" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    url = f"http://{name}:{listening.getsockname()[1]}/"
    say(f"the page is at {url} (Ctrl-C ends it)")
    if browser:
        threading.Thread(target=webbrowser.open, args=[url], daemon=True).start()
    server.run(sockets=[listening])
