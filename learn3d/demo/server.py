"""The server of the page: its files, and one address that turns pixels into meshes. It keeps nothing of a visitor."""

from __future__ import annotations

import asyncio
import contextlib
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

import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from learn3d.demo.gate import Gate
from learn3d.demo.picture import EXAMPLES, SIDE, Picture, Tell, example, make_meshes, unpack
from learn3d.reconstruction import Model, load_model
from learn3d.terminal import plain, say

MOST_BYTES = 5 * SIDE**2  # of a request
VISITORS = 200  # requests at once, so 260 MB in all; a browser that comes later tries again
PATIENCE = 30  # seconds in which a picture must have arrived
_TICK = 0.05  # seconds


class _Closed(Exception):
    """The page ends, and nobody waits for the rest of a job."""


class Desk:
    """Does one job at a time, in the order of arrival."""

    def __init__(self) -> None:
        self.closed: Callable[[], bool] = lambda: False
        self._thread, self._line = ThreadPoolExecutor(1), deque()

    async def messages(self, job: Callable[[Tell], None]) -> AsyncIterator[bytes]:
        """Wait for the job's turn, do it, and give what it tells, one JSON object a line; first its place in the line.

        A visitor who leaves gives up the place.
        """
        ticket, told, place = object(), deque(), 0

        def tell(message: dict) -> None:
            if self.closed():
                raise _Closed
            told.append(message)

        def work_on() -> None:
            with contextlib.suppress(_Closed):
                job(tell)

        self._line.append(ticket)
        try:
            while (ahead := self._line.index(ticket)) and not self.closed():
                if ahead != place:
                    yield _line({"place": ahead})
                place = ahead
                await asyncio.sleep(_TICK)
            work = asyncio.get_running_loop().run_in_executor(self._thread, work_on)
            while not (self.closed() or (work.done() and not told)):
                while told:
                    yield _line(told.popleft())
                await asyncio.wait([work], timeout=_TICK)
            if not self.closed():
                await work  # raises the job's error
        finally:
            self._line.remove(ticket)


def _line(message: dict) -> bytes:
    return json.dumps(message).encode() + b"\n"


def application(models: dict[str, Model], host: str, desk: Desk) -> Starlette:
    """The page for these models, by the names under which they are shown, behind the gate of `host`."""
    pictures = {category: example(category) for category in EXAMPLES}
    kinds = [kind.strip() for model in models.values() for kind in model.config.category.split(",")]

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
        job = partial(make_meshes, models, picture)
        return StreamingResponse(desk.messages(job), media_type="application/x-ndjson")

    routes = [
        Route("/about", about),
        Route("/examples/{category}.png", show_example),
        Route("/mesh", mesh, methods=["POST"]),
        Mount("/", StaticFiles(directory=Path(__file__).with_name("page"), html=True)),
    ]
    return Starlette(routes=routes, middleware=[Middleware(Gate, host=host)])


async def _receive(request: Request) -> Picture:
    """The picture of a request: /mesh?width=W&height=H and perhaps &box=x,y,width,height, its bytes in the body."""
    given = request.query_params
    width, height = int(given["width"]), int(given["height"])
    box = tuple(map(int, given["box"].split(","))) if "box" in given else None
    if box is not None and len(box) != 4:
        raise ValueError("a box has four numbers")
    content = bytearray()
    async for chunk in request.stream():
        content += chunk
        if len(content) > MOST_BYTES:
            raise HTTPException(413, f"a picture has at most {MOST_BYTES} bytes")
    return unpack(bytes(content), width, height, box)


class _PlainFormatter(logging.Formatter):
    """A visitor's words in an error give the terminal no commands."""

    def format(self, record: logging.LogRecord) -> str:
        return plain(super().format(record))


def labels(runs: Sequence[Path]) -> list[str]:
    """A name for each run: that of its folder or file; numbered if several have the same."""
    names = [Path(run).resolve().name for run in runs]
    return [f"{name} {i + 1}" if names.count(name) > 1 else name for i, name in enumerate(names)]


def serve(runs: Sequence[Path], *, host: str, port: int, browser: bool) -> None:
    """Load the models of `runs` (none: the package's small one) and serve the page until a signal asks for the end.

    Raises ValueError and OSError for models that cannot be loaded and an address that is taken.
    """
    models = dict(zip(labels(runs), map(load_model, runs), strict=True)) if runs else {"small model": load_model(None)}
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        listening = socket.create_server((host, port), family=family, backlog=VISITORS)
    except (OSError, OverflowError) as error:
        raise OSError(f"cannot open a page at {host}:{port}; give another --port or --host") from error
    errors = logging.StreamHandler()
    errors.setFormatter(_PlainFormatter("%(message)s"))
    logging.getLogger("uvicorn").addHandler(errors)
    desk = Desk()
    bounds = {"limit_concurrency": VISITORS, "timeout_graceful_shutdown": 5, "h11_max_incomplete_event_size": 2**14}
    quiet = {
        "log_config": None,
        "log_level": "error",
        "access_log": False,
        "server_header": False,
        "proxy_headers": False,
    }
    app = application(models, host, desk)
    server = uvicorn.Server(uvicorn.Config(app, http="h11", ws="none", lifespan="off", **bounds, **quiet))
    desk.closed = lambda: server.should_exit
    name = "localhost" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    url = f"http://{name}:{listening.getsockname()[1]}/"
    say(f"the page is at {url} (Ctrl-C ends it)")
    if browser:
        threading.Thread(target=webbrowser.open, args=[url], daemon=True).start()
    server.run(sockets=[listening])
