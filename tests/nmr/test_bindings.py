"""The last check before the kernels: every array that does not fit is an error and no access outside an array.

Fragments, edges, colours and cameras have theirs beside the tests of their values.
"""

import mmap
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from nmr import _C

# The arguments of each kernel: names, or "name=key" if the array has another name in the table below.
MESH = "vertices faces starts"
DRAWN = "points camera cut eye matrix"
CALLS = {
    "rasterize": f"{MESH} face_index fill_back near far perspective",
    "silhouette": f"{MESH} {DRAWN} face_index alpha anti_aliasing fill_back near far perspective",
    "silhouette_backward": f"{MESH} {DRAWN} face_index grad_alpha=alpha grad_vertices anti_aliasing eps local",
    "smoothness": "vertices edges loss",
}
NUMBERS = dict(near=0.1, far=100.0, eps=1e-4, fill_back=True, perspective=True, anti_aliasing=True)
NUMBERS |= dict(local=False)


def integers(*shape, value=0):
    return np.full(shape, value, np.int32)


def call(name, table):
    names = [pair.partition("=")[::2] for pair in CALLS[name].split()]
    given = {key: table[other or key] for key, other in names}
    run(name, given | dict(num_threads=1))


def run(name, given):
    _C.bind(name, list(given))(*given.values())


ARRAYS = dict(
    vertices=np.random.default_rng(0).random((2, 12, 3)) + 0.5,
    faces=np.arange(12).reshape(4, 3),
    starts=None,
    points=np.zeros(0),
    camera=np.zeros(0),
    cut=np.zeros((), bool),
    eye=None,
    matrix=None,
    face_index=integers(2, 8, 8),
    alpha=np.zeros((2, 4, 4)),
    grad_vertices=np.zeros((2, 12, 3)),
    edges=np.array([[0, 1, 2, 3]]),
    loss=np.zeros(2),
)


# That every array of every kernel is checked says test_invariances.py.
@pytest.mark.parametrize(
    "name, key, value, words",
    [
        ("rasterize", "vertices", np.zeros((12, 3)), r"vertices .* \[B, V, 3\], got \[12, 3\]"),
        ("silhouette", "alpha", np.zeros((2, 4, 5)), r"alpha .* \[2, 4, 4\], got \[2, 4, 5\]"),
        ("silhouette_backward", "face_index", integers(2, 9, 9), r"even size, got \[2, 9, 9\]"),
    ],
)
def test_arrays_that_do_not_fit_are_named(name, key, value, words):
    call(name, ARRAYS | NUMBERS)
    with pytest.raises(ValueError, match=words):
        call(name, ARRAYS | NUMBERS | {key: value})


def test_other_python_threads_run_while_arrays_are_checked():
    edges = np.zeros((3_000_000, 4), int)
    edges[-1] = 12
    table = ARRAYS | NUMBERS | dict(edges=edges)
    turns, stop, interval = [0], [False], sys.getswitchinterval()

    def take_turns():
        while not stop[0]:
            turns[0] += 1
            time.sleep(0)

    thread = threading.Thread(target=take_turns)
    sys.setswitchinterval(100)  # no thread is asked to give way
    try:
        thread.start()
        time.sleep(0.01)
        before = turns[0]
        for _ in range(100):  # on a busy machine the thread may miss its turn
            with pytest.raises(ValueError, match="edges refer to"):
                call("smoothness", table)
            if turns[0] > before:
                break
        assert turns[0] > before
    finally:
        stop[0] = True
        sys.setswitchinterval(interval)
        thread.join()


@pytest.mark.parametrize(
    "name, value, words",
    [
        ("faces", integers(4, 3), "faces must be .* array of int64, got int32"),
        ("faces", np.asfortranarray(np.eye(4, 3, dtype=int)), "of int64, got one with gaps"),
        ("faces", None, "faces must not be None"),
        ("far", np.zeros(1), "far must be a number, got float64"),
        ("faces", [[0, 1, 2]], "faces must be .*, got another type"),
        ("normals", np.zeros(1), "there is no argument normals"),
    ],
)
def test_nothing_is_converted_silently(name, value, words):
    table = ARRAYS | NUMBERS
    arguments = {key: table[key] for key in CALLS["rasterize"].split()} | {name: value}
    with pytest.raises(TypeError, match=words):
        run("rasterize", arguments | dict(num_threads=1))


def test_arguments_that_are_missing_are_named():
    with pytest.raises(TypeError, match="the argument faces is missing"):
        run("rasterize", dict(vertices=ARRAYS["vertices"], starts=None))
    with pytest.raises(TypeError, match="rasterize takes 1 arguments, got 2"):
        _C.bind("rasterize", ["vertices"])(1, 2)
    with pytest.raises(AttributeError, match="no kernel rasterise"):
        _C.bind("rasterise", [])


def promised(gigabytes, dtype):
    """An array of memory that is promised and never touched."""
    no_reserve = getattr(mmap, "MAP_NORESERVE", 0x4000)  # in the module from Python 3.13
    block = mmap.mmap(-1, gigabytes << 30, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | no_reserve)
    return np.frombuffer(block, dtype)


@pytest.mark.skipif(sys.platform != "linux", reason="memory that is promised and never touched")
def test_more_faces_than_a_face_index_map_can_name():
    faces = promised(24, np.int64).reshape(-1, 3)
    table = ARRAYS | NUMBERS | dict(vertices=np.zeros((1, 3, 3)), face_index=integers(1, 8, 8))
    with pytest.raises(ValueError, match=r"at most 2\^30 faces per mesh"):
        call("rasterize", table | dict(faces=faces))


@pytest.mark.skipif(sys.platform != "linux", reason="memory that is promised and never touched")
def test_more_vertices_than_the_set_up_of_faces_can_name(packed):
    vertices = promised(6, np.float32).reshape(-1, 3)
    table = ARRAYS | NUMBERS | dict(faces=np.array([[0, 1, 2]]), face_index=integers(1, 8, 8))
    table |= dict(vertices=vertices[None])
    if packed:
        table |= dict(vertices=vertices, starts=np.array([[0, 0], [len(vertices), 1]]))
    with pytest.raises(ValueError, match=r"at most 2\^29 vertices per mesh"):
        call("rasterize", table)


def test_without_its_compiled_part_the_package_says_so():
    code = "import sys; sys.modules['nmr._C'] = None; import nmr"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert "ImportError: the compiled part of nmr is missing" in result.stderr
