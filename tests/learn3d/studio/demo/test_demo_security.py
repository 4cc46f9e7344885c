"""The server of `learn3d demo` by plain HTTP: strangers' requests, and many visitors at once."""

from __future__ import annotations

import asyncio
import base64
import json
import socket
import threading
from types import SimpleNamespace
from urllib.parse import urlsplit

import httpx
import numpy as np
import pytest
import trimesh

pytest.importorskip("uvicorn", reason="needs the extra demo")

from learn3d.studio.demo import server as serving


@pytest.fixture(scope="module")
def client(server) -> httpx.Client:
    with httpx.Client(base_url=server.address, timeout=120) as client:
        yield client


def messages(answer: httpx.Response) -> list[dict]:
    assert answer.status_code == 200, answer.text
    return [json.loads(line) for line in answer.text.splitlines()]


@pytest.mark.parametrize("name", ["localhost", "127.0.0.1", "[::1]"])
def test_its_own_page_can(client, name) -> None:
    assert (
        client.get("", headers={"Host": f"{name}:1", "Origin": f"http://{name}:1"}).status_code
        == 200
    )


def test_names_with_capitals_are_its_own_in_lower_case(monkeypatch) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "DESKTOP-AB12")
    gate = serving.Gate(None, "Server.example")
    for host in ("desktop-ab12:7860", "desktop-ab12.local:7860", "server.example"):
        assert gate._refuse(host, f"http://{host}") is None


@pytest.mark.parametrize(
    "header",
    [
        *(("Origin", odd) for odd in ("http://[", "http://[::1", "null", "http://evil.example")),
        *(("Origin", odd) for odd in ("http://127.0.0.1:1@evil.example", "\x80")),
        *(("Host", odd) for odd in ("evil.example", "", "[", "[::1", "localhost.evil.example")),
        ("Host", "127.0.0.1.evil.example"),
    ],
)
def test_other_pages_cannot(client, server, box, header) -> None:
    headers = {header[0]: header[1].encode("latin-1")}
    for method in ("GET", "POST"):
        assert client.request(method, box.address, headers=headers).status_code == 403
    assert server.errors.read_text() == ""


@pytest.mark.parametrize(
    "path", ["", "page.js", "about", "examples/airplane.png", "none", "../server.py"]
)
def test_browsers_are_told_to_run_and_fetch_nothing_else(client, path) -> None:
    headers = client.get(path).headers
    assert headers["content-security-policy"].startswith(
        "default-src 'self'; img-src 'self' blob:;"
    )
    assert "frame-ancestors 'none'" in headers["content-security-policy"]
    assert headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize("path", ["%2e%2e/server.py", "..%2fserver.py", "/etc/passwd", "page.py"])
def test_only_files_of_the_page_are_served(server, path) -> None:
    host, _, port = urlsplit(server.address).netloc.partition(":")
    with socket.create_connection((host, int(port))) as visitor:  # httpx would tidy the path up
        visitor.sendall(
            f"GET /{path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n".encode()
        )
        assert b" 404 " in visitor.recv(100)


def test_a_picture_becomes_meshes_and_nothing_of_it_comes_back(client, box) -> None:
    answer = client.post(box.address, content=box.content)
    assert answer.headers["content-type"] == "application/x-ndjson"
    mask, *_, last = messages(answer)
    found = np.unpackbits(np.frombuffer(base64.b64decode(mask["mask"]), np.uint8)).reshape(
        box.size, box.size
    )
    assert found.sum() == 32 * 32 and found[16:48, 16:48].all()
    assert len(last["meshes"]) == 2 and last["meshes"][1]["label"] == "other"
    for made in last["meshes"]:
        glb = trimesh.load(
            trimesh.util.wrap_as_stream(base64.b64decode(made["glb"])), "glb", force="mesh"
        )
        assert len(glb.faces) > 100 and b"COLOR_0" in base64.b64decode(made["glb"])


@pytest.mark.parametrize(
    "change",
    [
        {"params": {"width": 64, "height": 63}},
        {"params": {"width": 64}},
        {"params": {"width": 0, "height": 0}, "content": b""},
        {"params": {"width": 600, "height": 1}, "content": bytes(2400)},
        {"params": {"width": "\x1b]0;title\x07", "height": 64}},
        {"params": {"width": 64, "height": 64, "box": "1,2,3"}},
        *(
            {"params": {"width": 64, "height": 64} | odd}
            for text in ("٦٤", "６４", "6_4", "+64", " 64", "64.0", "6e1", "9" * 5000, "")
            for odd in ({"width": text}, {"box": f"8,8,{text},40"})
        ),
        {"content": b"<script>alert(1)</script>"},
    ],
)
def test_what_is_no_picture_is_refused_in_a_sentence(client, server, box, change) -> None:
    size = {"width": box.size, "height": box.size}
    request = {"params": size, "content": box.content} | change
    answer = client.post("mesh", **request)
    assert answer.status_code == 400 and "this is no picture" in answer.text
    assert answer.headers["content-type"].startswith("text/plain")
    assert server.errors.read_text() == ""


@pytest.mark.parametrize("where", ["1,1,200,200", "-5,0,20,20", "0,0,64,64", "3,3,1,1"])
def test_a_box_that_cannot_be_is_an_error_of_the_picture(client, box, where) -> None:
    (said,) = messages(client.post(f"{box.address}&box={where}", content=box.content))
    assert "box" in said["error"]


def test_a_slow_reader_holds_nobody_up() -> None:
    async def visit() -> list[bytes]:
        jobs = serving.JobQueue()
        slow = jobs.run(lambda send: [send({"step": step}) for step in range(3)], "slow")
        assert await anext(slow) == b'{"step": 0}\n'  # and reads no further
        return [line async for line in jobs.run(lambda send: send({"step": 0}), "next")]

    assert asyncio.run(asyncio.wait_for(visit(), 60))[-1] == b'{"step": 0}\n'


def test_words_of_a_visitor_reach_the_terminal_written_out(monkeypatch, capsys) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("\x1b]0;title\x07")

    class Server(serving.uvicorn.Server):
        def run(self, sockets: list[socket.socket]) -> None:
            thread = threading.Thread(target=super().run, args=[sockets])
            thread.start()
            address = "http://{}:{}/".format(*sockets[0].getsockname())
            try:
                with pytest.raises(httpx.TransportError):  # broken off, as the answer had begun
                    httpx.post(address + "mesh?width=1&height=1", content=bytes(4))
            finally:
                self.should_exit = True
                thread.join()

    monkeypatch.setattr(serving, "make_meshes", fail)
    monkeypatch.setattr(serving.uvicorn, "Server", Server)
    monkeypatch.setattr(serving, "load_model", lambda run: SimpleNamespace(categories=["cup"]))
    serving.serve([], host="127.0.0.1", port=0, browser=False)
    said = capsys.readouterr().err
    assert "Traceback" in said and r"\x1b]0;title\x07" in said, "an unexpected error is not hidden"
    assert "\x1b" not in said and "\x07" not in said
