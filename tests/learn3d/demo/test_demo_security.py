"""The server of `learn3d demo` by plain HTTP: strangers' requests, and many visitors at once."""

from __future__ import annotations

import json
import socket
import time
import uuid
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any
from urllib.parse import urlsplit

import httpx
import numpy as np
import pytest
from PIL import Image

pytest.importorskip("gradio", reason="needs the extra demo")


@pytest.fixture(scope="module")
def client(server) -> httpx.Client:
    with httpx.Client(base_url=server[1], timeout=120) as client:
        yield client


def event(client: httpx.Client, name: str) -> int:
    """Number of the page's first event with a function of this name."""
    events = client.get("config").json()["dependencies"]
    return next(event["id"] for event in events if str(event["api_name"]).startswith(name))


def call(client: httpx.Client, number: int, data: list[Any], session: str) -> tuple[bool, str]:
    """Queue an event as the page does; whether it succeeded, and its last message."""
    joined = client.post("gradio_api/queue/join", json={"data": data, "fn_index": number, "session_hash": session})
    if joined.status_code != 200:
        return False, joined.text
    with client.stream("GET", f"gradio_api/queue/data?session_hash={session}") as answers:
        for line in answers.iter_lines():
            message = json.loads(line.removeprefix("data: ")) if line.startswith("data: ") else {}
            if message.get("msg") == "process_completed":
                return message["success"], json.dumps(message["output"])
    return False, "the stream ended"


def upload(client: httpx.Client, name: str, content: bytes) -> httpx.Response:
    return client.post("gradio_api/upload", files={"files": (name, content)})


@pytest.mark.parametrize(
    "headers",
    [{"Host": "evil.example"}, {"Origin": "http://evil.example"}, {"Origin": "null"}, {"Host": ""}],
)
def test_other_sites_cannot_use_the_page(client, headers) -> None:
    assert client.get("", headers=headers).status_code == 403
    assert client.post("gradio_api/upload", files={"files": ("a.png", b"a")}, headers=headers).status_code == 403


def test_its_own_page_can(client, server) -> None:
    assert client.get("", headers={"Origin": server[1].rstrip("/")}).status_code == 200
    assert client.get("", headers={"Host": "localhost"}).status_code == 200


@pytest.mark.parametrize("name", ["page.html", "picture.svg", "page.xhtml"])
def test_uploads_are_never_shown_by_the_browser(client, name: str) -> None:
    (path,) = upload(client, name, b"<script>alert(1)</script>").json()
    answer = client.get(f"gradio_api/file={path}")
    assert answer.status_code == 200
    assert answer.headers["content-disposition"].startswith("attachment")
    assert answer.headers["content-type"] == "application/octet-stream"


def test_a_request_is_bounded(client) -> None:
    assert upload(client, "large.png", bytes(34 * 2**20)).status_code == 413
    unsaid = client.post("gradio_api/upload", content=iter([b"a"]))
    assert unsaid.status_code == 413, "its length must be stated"


def test_a_visitor_who_leaves_during_an_upload_is_no_error(client, server) -> None:
    process, address = server
    host = urlsplit(address).netloc
    headers = f"Host: {host}\r\nContent-Length: 1000\r\nContent-Type: multipart/form-data; boundary=b\r\n"
    with socket.create_connection(host.split(":")) as visitor:
        visitor.sendall(f"POST /gradio_api/upload HTTP/1.1\r\n{headers}\r\n--b\r\n".encode())
        time.sleep(0.5)
    time.sleep(0.5)
    assert client.get("").status_code == 200
    assert "ClientDisconnect" not in (process.folder / "errors.txt").read_text()


def test_nothing_is_fetched_from_elsewhere(client) -> None:
    assert client.get("gradio_api/file=http://example.com/a.png").status_code == 403
    given = {"path": "https://example.com/a.png", "meta": {"_type": "gradio.FileData"}}
    success, said = call(client, event(client, "clear"), [given], uuid.uuid4().hex)
    assert not success and "nothing is fetched from elsewhere" in said


def test_words_of_a_visitor_reach_the_terminal_written_out(client, server) -> None:
    given = {"path": "/etc/\x1b]0;title\x07", "meta": {"_type": "gradio.FileData"}}
    success, _ = call(client, event(client, "clear"), [given], uuid.uuid4().hex)
    assert not success
    errors = (server[0].folder / "errors.txt").read_text()
    assert "Traceback" in errors and r"\x1b]0;title\x07" in errors, "an unexpected error is not hidden"
    assert "\x1b" not in errors and "\x07" not in errors


def test_thirty_visitors_at_once_all_get_their_mesh(client, tmp_path) -> None:
    colors = np.full((64, 64, 3), 200, np.uint8)
    colors[16:48, 16:48] = (40, 60, 120)
    Image.fromarray(colors).save(tmp_path / "box.png")
    (path,) = upload(client, "box.png", (tmp_path / "box.png").read_bytes()).json()
    given = [{"path": path, "meta": {"_type": "gradio.FileData"}}]
    sessions = [uuid.uuid4().hex for _ in range(30)]
    with ThreadPoolExecutor(30) as visitors:
        for name, data in (("clear", given), ("open_upload", [None, 0.2]), ("make", [None])):
            found = list(visitors.map(partial(call, client, event(client, name), data), sessions))
            assert [said for success, said in found if not success] == []
