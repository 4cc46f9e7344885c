"""The server of the page: static files, and an address that turns pixels into meshes. It stores no visitor's data.

Other web pages in the same browser cannot use it.
"""

import asyncio
import contextlib
import ipaddress
import json
import logging
import re
import socket
import threading
import webbrowser
from collections import Counter, deque
from collections.abc import AsyncIterator, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

import h11
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
from uvicorn.protocols.http.h11_impl import H11Protocol

from learn3d.data.conventions import synset_of
from learn3d.studio.demo.picture import (
    EXAMPLES,
    SIDE,
    Picture,
    example,
    make_meshes,
    unpack,
)
from learn3d.studio.picture_to_mesh.make import Model, load_model
from learn3d.terminal import plain, say

MOST_BYTES = 5 * SIDE**2  # largest body of a request
# pictures that are received or wait, 260 MB in all; the browser of a later one tries again
VISITORS = 200
OF_ADDRESS = 40  # pictures of one address among them
CONNECTIONS = 400  # connections of one address; further ones are closed at once
PATIENCE = 30  # seconds in which a picture must arrive
SILENCE = (
    10  # seconds in which the header of a request must come, and in which an answer must be read
)
CROWD, CROWD_SILENCE = 20, 1  # seconds for the header if an address has so many silent connections
_PIECE = 2**16  # bytes of an answer that are sent at once
_TICK = 0.05  # seconds
#: Headers of each answer. The browser loads nothing from other servers, and no other page shows this one in a frame.
_HEADERS = {
    "Connection": "close",  # a visitor makes few requests, and no connection waits for a further one
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class Connection(H11Protocol):
    """A connection that is closed if no request comes, or if its visitor does not read the answer.

    uvicorn alone waits for both for ever. `Gate` ends each connection with its first answer.
    """

    _limit: asyncio.TimerHandle | None = None  # its end closes the connection

    def connection_made(self, transport: asyncio.Transport) -> None:
        super().connection_made(transport)
        address = self.client and self.client[0]
        near = [each for each in self.connections if each.client and each.client[0] == address]
        if len(near) > CONNECTIONS:
            transport.abort()
            return
        crowded = sum(each.cycle is None for each in near) > CROWD
        self._close_in(CROWD_SILENCE if crowded else SILENCE)

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._limit and self._limit.cancel()

    def handle_events(self) -> None:
        try:
            super().handle_events()
        except h11.LocalProtocolError:  # nonsense behind a request whose answer has begun
            self.transport.abort()
        if self.cycle is not None and not self.flow.write_paused:
            self._limit.cancel()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._close_in(SILENCE)

    def resume_writing(self) -> None:
        super().resume_writing()
        self._limit.cancel()

    def _close_in(self, seconds: float) -> None:
        self._limit and self._limit.cancel()
        self._limit = self.loop.call_later(seconds, self.transport.abort)


class JobQueue:
    """Runs one job at a time in a thread. Addresses take turns, each with its jobs in the order of arrival."""

    def __init__(self) -> None:
        self.closed: Callable[[], bool] = lambda: False  # whether the server stops
        self._thread = ThreadPoolExecutor(1)
        self._line: list[tuple[str, object]] = []  # addresses, each with a ticket of its own

    async def run(
        self, job: Callable[[Callable[[dict], None]], None], address: str
    ) -> AsyncIterator[bytes]:
        """Run a job and yield the messages that it sends, each a line of JSON; before them {"place": jobs ahead of it}
        if it has to wait, at last 0.

        If the iteration ends early, because the visitor has left, a waiting job is dropped, and one
        in work ends with the next message that it sends.
        """
        messages, ticket, place, work = deque(), (address, object()), 0, None

        def send(message: dict) -> None:
            if self.closed() or ticket not in self._line:
                raise asyncio.CancelledError  # ends the job
            messages.append(message)

        def run_job() -> None:
            with contextlib.suppress(asyncio.CancelledError):
                job(send)

        def leave(_: object = None) -> None:
            with contextlib.suppress(ValueError):
                self._line.remove(ticket)

        self._line.insert(self._turn(address), ticket)
        try:
            while not (self.closed() or (work and work.done() and not messages)):
                ahead = self._line.index(ticket) if ticket in self._line else 0
                if ahead != place:
                    yield _json_line({"place": ahead})
                place = ahead
                while messages:
                    line = _json_line(messages.popleft())
                    for start in range(0, len(line), _PIECE):
                        yield line[start : start + _PIECE]
                if not ahead and work is None:
                    work = asyncio.get_running_loop().run_in_executor(self._thread, run_job)
                    work.add_done_callback(leave)  # the next one need not wait for a slow reader
                await (asyncio.wait([work], timeout=_TICK) if work else asyncio.sleep(_TICK))
            if not self.closed():
                await work  # raises the job's error
        finally:
            leave()
            if work:
                work.cancel()

    def _turn(self, address: str) -> int:
        """The place for a further job of an address: its n-th job comes before the others' jobs after their n-th."""
        seen: Counter[str] = Counter()
        own = sum(other == address for other, _ in self._line)
        for place, (other, _) in enumerate(self._line):
            if seen[other] > own:
                return place
            seen[other] += 1
        return len(self._line)


def _json_line(message: dict) -> bytes:
    return json.dumps(message).encode() + b"\n"


def application(models: dict[str, Model], host: str, jobs: JobQueue) -> Starlette:
    """The page for these models, by their displayed names, served under the name `host`."""
    kinds = dict.fromkeys(kind for model in models.values() for kind in model.categories)
    known = set(map(synset_of, kinds))
    pictures = {kind: example(kind) for kind in EXAMPLES if synset_of(kind) in known}

    def about(_: Request) -> Response:
        return JSONResponse({"kinds": list(kinds), "examples": list(pictures), "side": SIDE})

    def show_example(request: Request) -> Response:
        if (png := pictures.get(request.path_params["category"])) is None:
            raise HTTPException(404)
        return Response(png, media_type="image/png")

    async def mesh(request: Request) -> Response:
        category, smooth = map(request.query_params.get, ("category", "smooth"))
        try:
            picture = await asyncio.wait_for(_receive(request), PATIENCE)
        except (ValueError, KeyError) as error:
            raise HTTPException(400, f"this is no picture as the page sends it: {error}") from None
        except (asyncio.TimeoutError, ClientDisconnect):
            raise HTTPException(408, "the picture did not arrive in time") from None
        work = partial(make_meshes, models, picture, category=category or None, smooth=bool(smooth))
        address = request.client.host if request.client else ""
        return StreamingResponse(jobs.run(work, address), media_type="application/x-ndjson")

    routes = [
        Route("/about", about),
        Route("/examples/{category}.png", show_example),
        Route("/mesh", mesh, methods=["POST"]),
        Mount("/", StaticFiles(directory=Path(__file__).with_name("page"), html=True)),
    ]
    return Starlette(routes=routes, middleware=[Middleware(Gate, host=host)])


async def _receive(request: Request) -> Picture:
    """The picture in a request to /mesh?width=W&height=H (and &box=x,y,width,height), with its bytes in the body."""
    content = await _read(request)
    query = request.query_params
    box = tuple(map(_number, query["box"].split(","))) if "box" in query else None
    if box is not None and len(box) != 4:
        raise ValueError("a box has four numbers")
    return unpack(content, _number(query["width"]), _number(query["height"]), box)


async def _read(request: Request) -> bytes:
    content = bytearray()
    async for chunk in request.stream():
        content += chunk
        if len(content) > MOST_BYTES:
            raise HTTPException(413, f"a picture has at most {MOST_BYTES} bytes")
    return bytes(content)


def _number(text: str) -> int:
    if not re.fullmatch("-?[0-9]{1,6}", text):
        raise ValueError("numbers are written with the digits 0 to 9")
    return int(text)


async def _send_away(scope: Scope, receive: Receive, send: Send) -> None:
    """Ask to come again. The picture is read first, as browsers lose an answer that comes before its end."""
    with contextlib.suppress(asyncio.TimeoutError, ClientDisconnect):
        await asyncio.wait_for(_discard(Request(scope, receive)), PATIENCE)
    await PlainTextResponse("many visitors are here; try again later", 503)(scope, receive, send)


async def _discard(request: Request) -> None:
    left = MOST_BYTES
    async for chunk in request.stream():
        left -= len(chunk)
        if left < 0:
            break


class Gate:
    """ASGI middleware that refuses requests of other web pages, those to another host name, and too many pictures.

    An attacker's host name can point to this server (DNS rebinding). So the Host header must be
    an IP address, `host` or a name of this machine.
    """

    def __init__(self, app: ASGIApp, host: str) -> None:
        machine = socket.gethostname().lower()  # as browsers write it
        self._app, self._names = app, {host.lower(), "localhost", machine, f"{machine}.local"}
        self._pictures: Counter[str] = Counter()  # pictures in work or in the queue by address

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)

        headers = Headers(scope=scope)
        address, app = (scope["client"] or ("",))[0], self._app
        taken = Counter([address] if scope["method"] == "POST" else [])
        full = self._pictures.total() >= VISITORS or self._pictures[address] >= OF_ADDRESS
        if reason := self._refuse(headers.get("host", ""), headers.get("origin")):
            app = PlainTextResponse(reason, 403)
        elif taken and full:
            app, taken = _send_away, Counter()  # pictures that are not taken fill no place
        self._pictures += taken
        try:
            await app(scope, receive, send_with_headers)
        finally:
            self._pictures -= taken

    def _refuse(self, host: str, origin: str | None) -> str | None:
        """The reason to refuse a request with these headers, None for one of the page."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
            if name not in self._names:
                ipaddress.ip_address(name)
        except ValueError:
            return "open this page by the address of its machine"
        with contextlib.suppress(ValueError):
            if origin is None or urlsplit(origin).netloc == host:
                return None
        return "this request comes from another page"


def serve(runs: Sequence[Path], *, host: str, port: int, browser: bool) -> None:
    """Load the models of `runs` (if empty, the small model of the package) and serve the page until a signal comes.

    Raises ValueError or OSError if a model cannot be loaded or the address is in use.
    """
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        listening = socket.create_server((host, port), family=family, backlog=VISITORS)
    except (OSError, OverflowError) as error:
        raise OSError(
            f"cannot open a page at {host}:{port}; give another --port or --host"
        ) from error
    names = [Path(run).resolve().name for run in runs]
    names = [f"{name} {i + 1}" if names.count(name) > 1 else name for i, name in enumerate(names)]
    models = dict(zip(names, map(load_model, runs), strict=True)) or {
        "small model": load_model(None)
    }
    errors = logging.StreamHandler()
    # it may contain a visitor's text
    errors.format = lambda record: plain(logging.Handler.format(errors, record))
    logging.getLogger("uvicorn").addHandler(errors)
    logging.getLogger("asyncio").setLevel(
        logging.ERROR
    )  # it warns of each piece for a visitor who left
    jobs = JobQueue()
    config = uvicorn.Config(
        application(models, host, jobs),
        http=Connection,
        ws="none",
        lifespan="off",
        log_config=None,
        log_level="error",
        access_log=False,
        server_header=False,
        proxy_headers=False,
        timeout_graceful_shutdown=5,
        h11_max_incomplete_event_size=2**14,
    )
    server = uvicorn.Server(config)
    jobs.closed = lambda: server.should_exit
    name = "localhost" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    url = f"http://{name}:{listening.getsockname()[1]}/"
    say(f"the page is at {url} (Ctrl-C ends it)")
    if browser:
        threading.Thread(target=webbrowser.open, args=[url], daemon=True).start()
    server.run(sockets=[listening])
