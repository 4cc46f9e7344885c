"""The page of `learn3d demo` in a browser: whole visits, each to the end of the server's answer."""

from __future__ import annotations

import base64
import functools
import io
import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image, ImageSequence

from learn3d.studio.demo.picture import EXAMPLES, example

AT_ONCE = 20_000  # milliseconds that the page has after the server's last word


def answered(tab: Any, act: Callable[[], object], error: str = "") -> list[dict]:
    """Do something that sends a picture, and wait for the end: the messages of the server.

    The page must then be at rest, with no error or with this one.
    """
    with tab.expect_response(lambda response: "/mesh?" in response.url) as answer:
        act()
    answer.value.finished()
    tab.locator("body:not(.busy)").wait_for(timeout=AT_ONCE)
    tab.locator("#progress").wait_for(state="hidden", timeout=AT_ONCE)
    said = tab.locator("#status.error")
    assert said.count() == bool(error) and (not error or error in said.inner_text())
    return [json.loads(line) for line in answer.value.text().splitlines()]


def press(tab: Any, name: str) -> Callable[[], None]:
    return tab.get_by_role("button", name=name, exact=True).click


def buttons(tab: Any) -> set[str]:
    """The names of all buttons that a finger can reach."""
    reached = tab.evaluate(
        """() => [...document.querySelectorAll("button")].filter(button => {
            if (!button.checkVisibility()) return false;
            button.scrollIntoView({ block: "center" });
            const { x, y, width, height } = button.getBoundingClientRect();
            return button.contains(document.elementFromPoint(x + width / 2, y + height / 2));
        }).map(button => button.ariaLabel || button.title || button.textContent)"""
    )
    seen = [name for name in reached if name]
    assert len(set(seen)) == len(reached), "each has a name of its own"
    return set(seen)


def paint(image: np.ndarray) -> np.ndarray:
    """The mean colour of all that is not grey: of the object, not of the page."""
    assert paint_share(image) > 0.01, "an object is shown"
    return image[np.ptp(image, axis=2) > 40].mean(axis=0)


def paint_share(image: np.ndarray) -> float:
    return float((np.ptp(image, axis=2) > 40).mean())


def download(tab: Any, name: str, folder: Path) -> Path:
    with tab.expect_download() as event:
        tab.get_by_role("button", name=name).first.click()
    event.value.save_as(folder / event.value.suggested_filename)
    return folder / event.value.suggested_filename


def drag(tab: Any, place: Any, *points: tuple[float, float]) -> None:
    """Drag over an element; points are parts of its width and height."""
    place.scroll_into_view_if_needed()
    area = place.bounding_box()
    for step, (x, y) in enumerate(points):
        tab.mouse.move(area["x"] + x * area["width"], area["y"] + y * area["height"], steps=6)
        if not step:
            tab.mouse.down()
    tab.mouse.up()


def pinch(tab: Any, place: Any) -> None:
    """Move two fingers apart on an element, to four times their distance."""
    place.scroll_into_view_if_needed()
    area, fingers = place.bounding_box(), tab.context.new_cdp_session(tab)
    x, y = area["x"] + area["width"] / 2, area["y"] + area["height"] / 2
    for kind, apart in (("touchStart", 20), ("touchMove", 50), ("touchMove", 80), ("touchEnd", 0)):
        points = [{"x": x + side * apart, "y": y, "id": side + 1} for side in (-1, 1)]
        message = {"type": kind, "touchPoints": points if apart else []}
        fingers.send("Input.dispatchTouchEvent", message)


def moves(tab: Any, pixels: Callable, place: Any, before: np.ndarray) -> bool:
    """Whether more than a hundredth of the pixels change, sooner or later."""
    for _ in range(AT_ONCE // 100):
        if (np.abs(pixels(place) - before).max(axis=2) > 20).mean() > 0.01:
            return True
        tab.wait_for_timeout(100)
    return False


def halves(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the two halves of a picture, beside or above each other, are no background."""
    height, width = image.shape[:2]
    shown = np.abs(image - image[-2, -2]).max(axis=2) > 25
    if width > height:
        return shown[:, : width // 2], shown[:, width - width // 2 :]
    return shown[: height // 2], shown[height - height // 2 :]


def iou(one: np.ndarray, other: np.ndarray) -> float:
    return float((one & other).sum() / (one | other).sum())


def boxes(
    path: Path, *placed: tuple[slice, tuple[int, int, int]], rows: slice = slice(60, 140)
) -> Path:
    """A picture 300 x 200 of boxes on grey, each with its columns and its colour."""
    image = np.full((200, 300, 3), 200, np.uint8)
    for columns, color in placed:
        image[rows, columns] = color
    Image.fromarray(image).save(path)
    return path


BLUE, GREEN = (40, 60, 160), (30, 140, 50)


@pytest.fixture
def blue(tmp_path) -> Path:
    return boxes(tmp_path / "blue.png", (slice(80, 220), BLUE))


def cut_out(tab: Any, folder: Path) -> np.ndarray:
    """The object as the page saves it: R, G, B, A."""
    with Image.open(download(tab, "Cut-out", folder)) as image:
        return np.asarray(image)


@pytest.mark.parametrize("width", [1280, 380])
def test_a_whole_visit(packaged, visit, fits, pixels, tmp_path, width) -> None:
    """A visitor presses every button, and takes every file home."""
    tab = visit(packaged.address, width, has_touch=width < 400)
    press(tab, "sofa")()
    press(tab, "Cancel")()
    assert tab.get_by_text("Cancelled.").is_visible() and tab.locator(".busy").count() == 0
    answered(tab, press(tab, "Start over"))
    said = answered(tab, press(tab, "chair"))
    canvas = tab.locator(".view > canvas")
    with Image.open(io.BytesIO(example("chair"))) as image:
        given = paint(np.asarray(image.convert("RGB")).astype(int))
    assert np.abs(paint(pixels(canvas)) - given).max() < 50, "the mesh has the picture's colours"
    (first,) = next(message["meshes"] for message in said if "meshes" in message)
    made = [first, *(message["guess"] for message in said if "guess" in message)]
    guesses = [f"Guess {number + 1}: {each['kind']}" for number, each in enumerate(made)]
    assert len(made) > 1
    tools = {"Box", "Add", "Remove", "Undo", "Start over", "Another picture"}
    views = {"Zoom in", "Zoom out", "Reset the view", "Clay", "Beside the picture"}
    kinds = {f"It is a{'n' * (kind == 'airplane')} {kind}" for kind in EXAMPLES}
    files = {f"↓ {kind}" for kind in ("GLB", "OBJ", "Turntable", "Cut-out")}
    reached = tools | views | kinds | files | {*EXAMPLES, *guesses, "Smooth shape instead"}
    photo = {"Take a photo"} if tab.evaluate("matchMedia('(pointer: coarse)').matches") else set()
    assert buttons(tab) == reached | photo

    for name, each in reversed(list(zip(guesses, made, strict=True))):
        press(tab, name)()
        small = pixels(tab.get_by_role("button", name=name).locator("canvas"))
        assert np.abs(paint(small) - paint(pixels(canvas))).max() < 50, "its small picture"
        saved = download(tab, "GLB", tmp_path).read_bytes()
        assert saved == base64.b64decode(each["glb"])
        mesh = trimesh.load(io.BytesIO(saved), "glb", force="mesh", process=False)
        assert len(mesh.faces) > 1000 and np.isfinite(mesh.vertices).all()
    saved = download(tab, "OBJ", tmp_path)
    assert saved.read_text().count("vn ") == len(mesh.vertices), "smooth normals"
    obj = trimesh.load(saved, force="mesh", process=False)
    assert np.allclose(obj.vertices, mesh.vertices, atol=1e-4)
    for _ in range(4):
        press(tab, "Zoom in")()
    with Image.open(download(tab, "Turntable", tmp_path)) as image:
        assert image.n_frames == 36
        frames = [
            np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(image)
        ]
    assert all(np.abs(paint(frame) - given).max() < 70 for frame in frames)
    assert np.abs(frames[9] - frames[0]).max() > 100, "it turns"
    ends = np.concatenate([frame[[0, -1]] for frame in frames])
    assert np.ptp(ends, axis=2).max() < 40, "all of it is shown, however near one looks"
    press(tab, "Reset the view")()
    assert 0.1 < (cut_out(tab, tmp_path)[..., 3] > 0).mean() < 0.9

    before = pixels(canvas)
    for name in ("Zoom in", "Zoom out", "Clay", "Clay", "Beside the picture", "Beside the picture"):
        press(tab, name)()
        assert moves(tab, pixels, canvas, before), name
        before = pixels(canvas)
    for turn in (
        lambda: drag(tab, canvas, (0.5, 0.5), (0.7, 0.6)),
        lambda: canvas.press("ArrowUp"),
    ):
        turn()
        assert moves(tab, pixels, canvas, before), "by hand and by keys"
        before = pixels(canvas)
    if width < 400:
        pinch(tab, canvas)
        assert moves(tab, pixels, canvas, before)
        assert paint_share(pixels(canvas)) > 1.5 * paint_share(before), "two fingers zoom"
    else:
        press(tab, "Zoom in")()
    press(tab, "Reset the view")()
    press(tab, "Clay")()
    assert moves(tab, pixels, canvas, before)
    assert paint_share(pixels(canvas)) < 0.005, "clay has no colours"
    press(tab, "Beside the picture")()
    assert moves(tab, pixels, canvas, before)
    left, right = halves(pixels(canvas))
    assert iou(left, right) > 0.7, "the mesh is seen as the picture shows it"

    for scheme in ("dark", "light"):
        for narrow in (320, width):
            fits(tab, narrow, scheme)
    for tool in ("Box", "Add", "Remove"):
        press(tab, tool)()
        assert tab.locator("[aria-pressed=true]", has_text=tool).count() == 1
    said = answered(tab, press(tab, "It is a sofa"))
    assert [message["meshes"][0]["kind"] for message in said if "meshes" in message] == ["sofa"]
    assert tab.get_by_role("button", name="Clay").get_attribute("aria-pressed") == "true"
    said = answered(tab, press(tab, "Smooth shape instead"))
    assert [message["meshes"][0]["kind"] for message in said if "meshes" in message] == [None]
    before = pixels(canvas)
    press(tab, "It is a car")()
    tab.evaluate("scrollTo(0, 0)")
    reached = """() => {
        document.querySelector(".view button").focus();
        return document.activeElement.matches(".view button");
    }"""
    assert not tab.evaluate(reached), "the previous mesh waits, also for keys"
    place = tab.locator("#cancel").bounding_box()
    assert place["y"] + place["height"] <= tab.viewport_size["height"], "in view beside the picture"
    press(tab, "Cancel")()
    assert tab.get_by_text("This is the previous mesh").is_visible()
    assert tab.evaluate(reached)
    assert np.abs(pixels(canvas) - before).max() < 20
    assert tab.get_by_role("button", name="Turntable").is_visible()
    assert tab.locator("#kinds [aria-pressed=true]").all_inner_texts() == ["Smooth shape instead"]
    if width < 400:
        tools, mesh = (tab.locator(name).bounding_box() for name in ("#tools", "#views"))
        assert tools["y"] < mesh["y"], "the tools are below the picture"
    with tab.expect_file_chooser():
        press(tab, "Another picture")()
    assert packaged.errors.read_text() == ""


def test_the_meshes_of_two_runs_turn_beside_the_outlined_picture(
    server, visit, pixels, blue
) -> None:
    tab = visit(server.address, reduced_motion="no-preference")
    answered(tab, lambda: tab.locator("#file").set_input_files(blue))
    seen = pixels(tab.locator("#picture"))
    assert (seen == BLUE).all(axis=2).mean() > 0.1, "the picture is not tinted"
    assert (seen == 255).all(axis=2).any(), "the outline"
    canvas = tab.locator(".view > canvas")
    assert canvas.count() == 2, "one for each run"
    assert moves(tab, pixels, canvas.last, pixels(canvas.last)), "it turns by itself"


def test_the_outline_is_corrected_by_brushes_and_a_box(single, visit, tmp_path) -> None:
    two = boxes(tmp_path / "two.png", (slice(40, 160), BLUE), (slice(190, 260), GREEN))
    tab = visit(single.address)
    answered(tab, lambda: tab.locator("#file").set_input_files(two))

    def part(columns: slice) -> float:
        """The share of these columns that belongs to the object, beside the other shares."""
        alpha = cut_out(tab, tmp_path)[..., 3] > 0
        scale = alpha.shape[1] / 300
        return float(alpha[:, int(columns.start * scale) : int(columns.stop * scale)].mean())

    def correct(tool: str, *points: tuple[float, float]) -> None:
        if tab.locator("[aria-pressed=true]", has_text=tool).count() == 0:
            press(tab, tool)()
        answered(tab, lambda: drag(tab, tab.locator("#picture"), *points))

    left, right, above = slice(40, 160), slice(190, 260), slice(60, 90)
    before = part(left), part(right)
    assert before[0] > 0.3 and before[1] == 0
    plain = part(above)
    correct("Add", (0.2, 0.2), (0.3, 0.2))
    assert part(above) > plain + 0.02
    correct("Remove", (0.15, 0.2), (0.35, 0.2))
    assert part(above) < plain + 0.01
    answered(tab, press(tab, "Undo"))
    assert part(above) > plain + 0.02, "as before the last stroke"
    press(tab, "Add")()
    # the second stroke does not wait for the answer to the first
    drag(tab, tab.locator("#picture"), (0.6, 0.2), (0.65, 0.2))
    correct("Add", (0.75, 0.2), (0.8, 0.2))
    assert part(slice(180, 195)) > 0.03 and part(slice(225, 240)) > 0.03, "both count"
    press(tab, "Undo")()
    correct("Remove", (0.15, 0.2), (0.35, 0.2))
    assert part(slice(180, 195)) > 0.03 and part(slice(225, 240)) < 0.01, (
        "the undone stroke stays undone"
    )
    correct("Box", (0.58, 0.2), (0.92, 0.8))
    assert part(left) == 0 and part(right) > 0.3
    correct("Box", (-0.02, 0.2), (0.57, 0.8))  # it begins beside the picture
    assert part(left) > 0.3 and part(right) == 0
    tab.get_by_role("button", name="Box", exact=True).press("Enter")  # it was on
    tab.get_by_role("button", name="Box", exact=True).press("Enter")
    assert "Arrow keys move the cross" in tab.locator("#hint").inner_text()
    for keys in (["ArrowRight"] * 3 + ["ArrowUp"] * 9, ["ArrowRight"] * 14 + ["ArrowDown"] * 18):
        for key in keys:
            tab.keyboard.press(key)
        if keys[-1] == "ArrowUp":
            tab.keyboard.press("Space")
    answered(tab, lambda: tab.keyboard.press("Space"))
    assert part(left) == 0 and part(right) > 0.3, "a box by keys"
    press(tab, "Add")()
    tab.locator("#picture").click(button="right")
    assert tab.locator(".busy").count() == 0, "the other button does not paint"
    answered(tab, press(tab, "Start over"))
    assert (part(left), part(right), part(above)) == (*before, plain)
    assert tab.get_by_role("button", name="Undo").is_disabled()


def test_what_is_no_picture_gets_a_sentence_and_a_drop_replaces_it(
    single, visit, pixels, blue, tmp_path
) -> None:
    tab = visit(single.address)
    (tmp_path / "broken.png").write_bytes(b"no picture")
    tab.locator("#file").set_input_files(blue)
    tab.get_by_text("Finding the").first.wait_for()
    tab.locator("#file").set_input_files(tmp_path / "broken.png")  # while the first is in work
    sentence = tab.get_by_text("not a picture that your browser can open")
    sentence.wait_for()
    tab.wait_for_timeout(1500)
    assert sentence.is_visible(), "it can be read"
    tab.locator(".view > canvas").wait_for()  # the work went on
    tab.locator("body:not(.busy)").wait_for()
    fails = json.dumps({"error": "It is no object."}) + "\n"
    tab.route("**/mesh?*", lambda route: route.fulfill(body=fails))
    press(tab, "Box")()
    drag(tab, tab.locator("#picture"), (0.1, 0.1), (0.9, 0.9))
    tab.get_by_text("It is no object. This is the previous mesh.").wait_for()
    assert paint_share(pixels(tab.locator(".view > canvas"))) > 0.01
    assert tab.get_by_role("button", name="GLB").is_visible()
    assert tab.get_by_role("button", name="Undo").is_disabled(), "the box is forgotten"
    tab.unroute("**/mesh?*")
    grey = boxes(tmp_path / "grey.png")
    answered(tab, lambda: tab.locator("#file").set_input_files(grey), "No object was found")
    assert tab.locator("[aria-pressed=true]", has_text="Box").count() == 1, "it can be dragged"
    sent: list[np.ndarray] = []

    def refuse(route: Any) -> None:
        body = np.frombuffer(route.request.post_data_buffer, np.uint8)
        sent.append(body[: len(body) // 5 * 4].reshape(-1, 4)[:, 3])  # the mask before the stroke
        route.fulfill(body=fails)

    tab.route("**/mesh?*", refuse)
    press(tab, "Add")()
    for y in (0.3, 0.6):
        stroke = functools.partial(drag, tab, tab.locator("#picture"), (0.3, y), (0.6, y))
        answered(tab, stroke, "It is no object.")
    assert len(sent) == 2 and not np.any(sent), "a refused stroke does not count"
    tab.unroute("**/mesh?*")
    both = boxes(tmp_path / "two.png", (slice(80, 220), BLUE), (slice(240, 290), (0, 0, 0)))
    answered(tab, lambda: tab.locator("#file").set_input_files(both))
    assert tab.get_by_text("away from the object").is_visible()
    wide = boxes(tmp_path / "wide.png", (slice(0, 300), BLUE), rows=slice(92, 108))
    answered(tab, lambda: tab.locator("#file").set_input_files(wide))
    assert "touches the border" in tab.locator("#doubt").inner_text(), "a doubt beside the mesh"
    green = boxes(tmp_path / "green.png", (slice(80, 220), GREEN))
    answered(
        tab,
        lambda: tab.evaluate(
            """text => {
                const data = new DataTransfer(), bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0));
                data.items.add(new File([bytes], "green.png"));
                window.dispatchEvent(new DragEvent("drop", { dataTransfer: data, cancelable: true }));
            }""",
            base64.b64encode(green.read_bytes()).decode(),
        ),
    )
    assert tab.locator("#doubt").is_hidden()
    for place in (tab.locator("#picture"), tab.locator(".view > canvas").first):
        red, high, low = paint(pixels(place))
        assert high > 1.5 * max(red, low), "the dropped picture and its mesh are green"


def test_an_interrupt_ends_it_while_the_page_is_open_and_busy(single, browser) -> None:
    tab = browser.new_page()
    tab.set_default_timeout(10 * AT_ONCE)
    tab.goto(single.address)
    airplane = tab.locator("#examples button")
    assert airplane.count() == 1, "the only picture of a kind that the run knows"
    airplane.click()
    tab.locator(".view > canvas").first.wait_for()
    airplane.click()
    assert airplane.get_attribute("aria-pressed") == "true"
    single.process.send_signal(signal.SIGINT)
    assert single.process.wait(timeout=60) in (0, 130), "a second or two on an idle machine"
    tab.close()
    errors = single.errors.read_text()
    assert "Traceback" not in errors and "ERROR" not in errors, errors
