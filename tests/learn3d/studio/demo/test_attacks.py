"""Attacks on the page of `learn3d demo`: each is refused or ended, and the next visitor gets a mesh."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import httpx
import pytest
from children import wait_until

pytest.importorskip("uvicorn", reason="needs the extra demo")

from learn3d.studio.demo import server as serving
from learn3d.studio.demo.picture import make_meshes

SILENCE, PATIENCE = 1.5, 3  # seconds; the page has 10 and 30
QUICK = "&smooth=1"


class Page(NamedTuple):
    """The page of a tiny model, and the pictures that were started and finished."""

    url: str
    box: Any  # a picture as the page sends it
    held: list[int]  # connections of the server whenever one was made
    started: list[bool]  # whether it asks for the quick mesh
    finished: list[int]
    connections: Callable[[], int]  # how many are open
    goes_on: threading.Event  # while it is not set, work waits after its first message

    def most(self) -> int:
        """The largest number of connections."""
        return max(self.held)

    @property
    def host(self) -> str:
        return self.url.split("/")[2]

    def connect(self, source: str = "127.0.0.1") -> socket.socket:
        name, port = self.host.split(":")
        return socket.create_connection((name, int(port)), source_address=(source, 0), timeout=30)

    def head(self, length: str | None = None, options: str = "") -> bytes:
        length = length or f"Content-Length: {len(self.box.content)}"
        address = self.box.address + options
        return f"POST /{address} HTTP/1.1\r\nHost: {self.host}\r\n{length}\r\n\r\n".encode()

    def get(self, path: str = "about") -> bytes:
        return f"GET /{path} HTTP/1.1\r\nHost: {self.host}\r\n\r\n".encode()

    @property
    def quick(self) -> str:
        """The address of a mesh that takes a tenth of the time."""
        return f"{self.url}{self.box.address}{QUICK}"

    def visit(self, source: str = "127.0.0.1") -> list[dict]:
        """The messages to a visitor with a picture."""
        transport = httpx.HTTPTransport(local_address=source)
        with httpx.Client(transport=transport, timeout=300) as client:
            answer = client.post(self.quick, content=self.box.content)
        assert answer.status_code == 200, answer.text
        return [json.loads(line) for line in answer.text.splitlines()]


@pytest.fixture(scope="module")
def page(finished_run, box) -> Iterator[Page]:
    """The page in this process, with short limits."""
    held: list[int] = []
    started: list[bool] = []
    finished: list[int] = []
    ready = threading.Event()
    goes_on = threading.Event()
    goes_on.set()
    servers, addresses = [], []

    class Server(serving.uvicorn.Server):
        def run(self, sockets: list[socket.socket]) -> None:
            servers.append(self)
            addresses.append("http://{}:{}/".format(*sockets[0].getsockname()))
            ready.set()
            super().run(sockets)

    class Connection(serving.Connection):
        def connection_made(self, transport: asyncio.Transport) -> None:
            # answers are larger than the buffers
            transport.get_extra_info("socket").setsockopt(
                socket.SOL_SOCKET, socket.SO_SNDBUF, 2**12
            )
            transport.set_write_buffer_limits(2**12)
            super().connection_made(transport)
            held.append(sum(not each.transport.is_closing() for each in self.connections))

    def count(models: object, pictures: object, send: Callable, **options: object) -> None:
        def tell(message: object) -> None:
            send(message)
            goes_on.wait(60)

        started.append(bool(options.get("smooth")))
        make_meshes(models, pictures, tell, **options)
        finished.append(1)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(serving, "SILENCE", SILENCE)
        patch.setattr(serving, "PATIENCE", PATIENCE)
        patch.setattr(serving, "make_meshes", count)
        patch.setattr(serving, "Connection", Connection)
        patch.setattr(serving.uvicorn, "Server", Server)
        options = {"host": "127.0.0.1", "port": 0, "browser": False}
        thread = threading.Thread(target=serving.serve, args=[[finished_run]], kwargs=options)
        thread.start()
        assert ready.wait(60)

        def connections() -> int:
            return len(servers[0].server_state.connections)

        yield Page(addresses[0], box, held, started, finished, connections, goes_on)
        servers[0].should_exit = True
        thread.join()


def read_to_end(visitor: socket.socket, within: float) -> bytes:
    """All that the server sends until it closes the connection, which it must do in time."""
    content, end = b"", time.monotonic() + within
    with contextlib.suppress(ConnectionError):
        while True:
            visitor.settimeout(max(0.01, end - time.monotonic()))
            if not (part := visitor.recv(2**16)):
                break
            content += part
    return content


def flood(visitor: socket.socket, piece: bytes, most: int) -> int:
    """The bytes that the server takes before it closes the connection, at most `most`."""
    sent = 0
    with contextlib.suppress(ConnectionError, TimeoutError):
        while sent < most:
            visitor.sendall(piece)
            sent += len(piece)
    return sent


def silent_crowd(page: Page) -> None:
    """Six visitors come beside 250 silent connections: all get a place, and in the end their mesh."""

    def visit(_: int) -> list[dict]:
        with httpx.stream("POST", page.quick, content=page.box.content, timeout=300) as answer:
            assert answer.status_code == 200
            lines = answer.iter_lines()
            first = next(lines)
            together.wait(60)  # all are there at once
            return [json.loads(line) for line in (first, *lines)]

    together = threading.Barrier(6, page.goes_on.set)
    page.goes_on.clear()
    with contextlib.ExitStack() as crowd, ThreadPoolExecutor(6) as visitors:
        crowd.callback(page.goes_on.set)
        for number in range(250):
            silent = crowd.enter_context(page.connect())
            silent.sendall(page.get()[:20] if number % 2 else b"")
        said = list(visitors.map(visit, range(6)))
    places = [[message["place"] for message in each if "place" in message] for each in said]
    assert sorted(each[0] for each in places if each) == list(range(1, 6))
    assert all(each == sorted(each, reverse=True) for each in places)
    assert all("meshes" in each[-1] for each in said)


def crowd_of_one_address(page: Page) -> None:
    """A visitor comes after five pictures of another address: one of them is made before."""
    before = len(page.started)
    page.goes_on.clear()
    with contextlib.ExitStack() as crowd:
        crowd.callback(page.goes_on.set)
        for number in range(5):
            sender = crowd.enter_context(page.connect("127.0.0.2"))
            sender.sendall(page.head() + page.box.content)
            assert b" 200 " in sender.recv(2**12), number
        visitor = crowd.enter_context(page.connect())
        visitor.sendall(page.head(options=QUICK) + page.box.content)
        while b'{"place"' not in (said := visitor.recv(2**12)):
            pass
        assert b'{"place": 1}' in said
        page.goes_on.set()
        assert b'"meshes"' in read_to_end(visitor, 120)
        assert page.started[before:].index(True) == 1


def too_many_connections(page: Page) -> None:
    with contextlib.ExitStack() as crowd:
        for _ in range(serving.CONNECTIONS + 50):
            crowd.enter_context(page.connect("127.0.0.2"))
        assert "meshes" in page.visit()[-1]
        assert page.most() <= serving.CONNECTIONS + 1, "the visitor has another address"


def dripping_header(page: Page) -> None:
    with page.connect() as visitor:
        assert flood_slowly(visitor, page.get() * 9) < 3 * SILENCE


def flood_slowly(visitor: socket.socket, content: bytes) -> float:
    """The seconds for which the server takes a byte every twentieth of a second."""
    start = time.monotonic()
    with contextlib.suppress(ConnectionError):
        for byte in content:
            visitor.sendall(bytes([byte]))
            time.sleep(0.05)
    return time.monotonic() - start


def byte_after_an_answer(page: Page) -> None:
    with page.connect() as visitor:
        visitor.sendall(page.get() + b"G")
        assert b" 200 " in read_to_end(visitor, 3 * SILENCE)


def slow_body(page: Page) -> None:
    with page.connect() as visitor:
        visitor.sendall(page.head() + page.box.content[:100])
        assert b" 408 " in read_to_end(visitor, PATIENCE + 3 * SILENCE)


def body_without_end(page: Page) -> None:
    piece = b"10000\r\n" + bytes(2**16) + b"\r\n"
    with page.connect() as visitor:
        visitor.sendall(page.head("Transfer-Encoding: chunked"))
        assert flood(visitor, piece, 2**28) < 2**24
    content = bytes(serving.MOST_BYTES + 1)
    assert httpx.post(page.url + page.box.address, content=content).status_code == 413


def body_for_a_small_answer(page: Page) -> None:
    with page.connect() as visitor:
        visitor.sendall(page.get().replace(b"\r\n\r\n", b"\r\nContent-Length: 10000000000\r\n\r\n"))
        assert flood(visitor, bytes(2**16), 2**28) < 2**24


def unread_answers(page: Page) -> None:
    with page.connect() as visitor:
        visitor.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**12)
        visitor.sendall(page.head() + page.box.content)
        wait_until(lambda: page.connections())
        wait_until(lambda: not page.connections())


def nonsense_behind_a_picture(page: Page) -> None:
    page.goes_on.clear()
    with page.connect() as visitor:
        visitor.sendall(page.head() + page.box.content)
        assert b" 200 " in visitor.recv(2**12)
        visitor.sendall(b"x\n" * 99)
        read_to_end(visitor, 3 * SILENCE)
    page.goes_on.set()


def visitors_who_leave(page: Page) -> None:
    """Thirty come and leave while a picture is in work: theirs are not started."""
    before, made = len(page.started), len(page.held)
    page.goes_on.clear()
    with contextlib.ExitStack() as crowd:
        crowd.callback(page.goes_on.set)
        crowd.enter_context(page.connect()).sendall(page.head() + page.box.content)
        wait_until(lambda: len(page.started) > before)
        for _ in range(30):
            with page.connect() as visitor:
                visitor.sendall(page.head() + page.box.content)
        wait_until(lambda: len(page.held) - made > 30)  # the page has seen all of them
        wait_until(lambda: page.connections() == 1)
    page.visit()
    assert len(page.started) - before == 2


def visitor_who_leaves_at_work(page: Page) -> None:
    started, finished = len(page.started), len(page.finished)
    with page.connect() as visitor:
        visitor.sendall(page.head() + page.box.content)
        said = b""
        while b"progress" not in said:
            said += visitor.recv(2**12)
    page.visit()
    assert (len(page.started) - started, len(page.finished) - finished) == (2, 1)


def pictures_of_one_address(page: Page) -> None:
    with contextlib.ExitStack() as crowd:
        for _ in range(serving.VISITORS + 10):
            crowd.enter_context(page.connect("127.0.0.2")).sendall(
                page.head() + page.box.content[:100]
            )
        time.sleep(0.5)
        with crowd.enter_context(page.connect("127.0.0.2")) as one_more:
            one_more.sendall(page.head() + page.box.content)
            assert b" 503 " in one_more.recv(2**12)
        assert "meshes" in page.visit()[-1]


def large_header(page: Page) -> None:
    with page.connect() as visitor:
        assert flood(visitor, page.get()[:-2] + b"X-Padding: " + b"x" * 2**16, 2**26) < 2**22


def two_requests_in_one(page: Page) -> None:
    """A body that a proxy would take for a second request."""
    hidden = page.get()
    before = len(page.started)
    both = f"Content-Length: {len(hidden) + 5}\r\nTransfer-Encoding: chunked"
    twice = f"Content-Length: 0\r\nContent-Length: {len(hidden)}"
    for length in (both, twice):
        with page.connect() as visitor:
            visitor.sendall(page.head(length) + (b"0\r\n\r\n" if length == both else b"") + hidden)
            said = read_to_end(visitor, PATIENCE + 3 * SILENCE)
        assert re.findall(rb"HTTP/1.1 (\d+)", said)[0] == b"400"
    assert len(page.started) == before


ATTACKS: list[Callable[[Page], None]] = [
    silent_crowd,
    crowd_of_one_address,
    too_many_connections,
    dripping_header,
    byte_after_an_answer,
    slow_body,
    body_without_end,
    body_for_a_small_answer,
    unread_answers,
    nonsense_behind_a_picture,
    visitors_who_leave,
    visitor_who_leaves_at_work,
    pictures_of_one_address,
    large_header,
    two_requests_in_one,
]


@pytest.mark.parametrize("attack", ATTACKS, ids=lambda attack: attack.__name__)
def test_the_page_stands_and_the_next_visitor_gets_a_mesh(page, attack, caplog) -> None:
    attack(page)
    assert "meshes" in page.visit()[-1]
    assert not [record for record in caplog.records if record.levelname == "ERROR"], caplog.text
