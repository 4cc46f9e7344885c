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
CALLS = {
    "rasterize": f"{MESH} face_index fill_back near far perspective",
    "silhouette": f"{MESH} face_index alpha anti_aliasing fill_back near far perspective",
    "silhouette_backward": f"{MESH} face_index grad_alpha=alpha grad_vertices anti_aliasing eps local",
    "smoothness": "vertices edges loss",
    "soft_iou_loss": "prediction target areas loss=value",
    "voxels": "vertices=single faces grid size touched",
}
NUMBERS = dict(near=0.1, far=100.0, eps=1e-4, fill_back=True, perspective=True, anti_aliasing=True)
NUMBERS |= dict(local=False, touched=True, size=4)


def integers(*shape, value=0):
    return np.full(shape, value, np.int32)


NUMBERS |= dict(local=False, true=True, touched=True)


def call(name, table):
    names = [pair.partition("=")[::2] for pair in CALLS[name].split()]
    given = {key: table[other or key] for key, other in names}
    getattr(_C, name)(**given, num_threads=1)


ARRAYS = dict(
    vertices=np.random.default_rng(0).random((2, 12, 3)) + 0.5,
    faces=np.arange(12).reshape(4, 3),
    starts=None,
    face_index=integers(2, 8, 8),
    alpha=np.zeros((2, 4, 4)),
    grad_vertices=np.zeros((2, 12, 3)),
    single=np.ones((2, 12, 3), np.float32),
    edges=np.array([[0, 1, 2, 3]]),
    loss=np.zeros(2),
    value=np.zeros(()),
    prediction=np.ones((2, 9)),
    target=np.ones((2, 9)),
    areas=np.ones((2, 2)),
    grid=np.zeros((2, 4, 4, 4), bool),
)
FACES_SHAPE = r"faces must have shape \[F, 3\] or \[2, F, 3\], got "


# Every sentence once; that every array of every kernel is checked says test_invariances.py.
@pytest.mark.parametrize(
    "name, key, value, words",
    [
        ("rasterize", "vertices", np.zeros((12, 3)), r"vertices .* \[B, V, 3\], got \[12, 3\]"),
        (
            "rasterize",
            "starts",
            np.array([[0, 0], [6, 2], [12, 4]]),
            r"vertices must have shape \[N, 3\], got \[2, 12, 3\]",
        ),
        ("rasterize", "faces", np.zeros((4, 2), int), FACES_SHAPE + r"\[4, 2\]"),
        ("rasterize", "faces", np.zeros((3, 4, 3), int), FACES_SHAPE + r"\[3, 4, 3\]"),
        ("rasterize", "faces", np.full((4, 3), -1), "vertex -1, but a mesh has 12 vertices"),
        ("rasterize", "face_index", integers(2, 0, 0), "face_index must have H and W in 1..16384"),
        ("rasterize", "face_index", integers(3, 8, 8), r"face_index .* \[2, H, W\], got \[3, 8, 8"),
        ("silhouette", "alpha", np.zeros((2, 4, 5)), r"alpha .* \[2, 4, 4\], got \[2, 4, 5\]"),
        ("silhouette_backward", "face_index", integers(2, 9, 9), r"even size, got \[2, 9, 9\]"),
        (
            "silhouette_backward",
            "face_index",
            integers(2, 8, 8, value=9),
            "the face index map does not belong to these faces",
        ),
        ("silhouette_backward", "alpha", np.zeros((2, 8, 8)), r"grad_alpha .* \[2, 4, 4\], got"),
        ("smoothness", "edges", np.full((1, 4), 12), "edges refer to vertex 12, but a mesh has 12"),
        ("smoothness", "loss", np.zeros(3), r"loss must have shape \[2\], got \[3\]"),
        ("soft_iou_loss", "value", np.zeros(3), r"loss must have shape \[\], got \[3\]"),
        ("voxels", "size", 0, r"size must lie in 1\.\.1024, got 0"),
        ("voxels", "size", 5, r"grid must have shape \[2, 5, 5, 5\], got \[2, 4, 4, 4\]"),
    ],
)
def test_arrays_that_do_not_fit_are_named(name, key, value, words):
    call(name, ARRAYS | NUMBERS)
    with pytest.raises(ValueError, match=words):
        call(name, ARRAYS | NUMBERS | {key: value})


@pytest.mark.parametrize(
    "name, change, words",
    [
        ("smoothness", lambda wrong: dict(edges=wrong.reshape(-1, 4)), "edges refer to"),
        ("rasterize", lambda wrong: dict(faces=wrong), "faces refer to vertex"),
        (
            "silhouette_backward",
            lambda wrong: dict(faces=wrong[:1]),
            "the face index map does not belong",
        ),
        (
            "soft_iou_loss",
            lambda wrong: dict(target=np.full((1, 4096, 4096), 255.0)),
            "divide a mask of 0..255",
        ),
    ],
)
def test_other_python_threads_run_while_arrays_are_checked(name, change, words):
    wrong, face_index = np.zeros((4_000_000, 3), int), integers(1, 4096, 4096)
    wrong[-1], face_index[0, -1, -1] = 3, 2
    image, points = np.zeros((1, 4096, 4096)), np.zeros((1, 3, 3))
    table = ARRAYS | NUMBERS | dict(anti_aliasing=False, face_index=face_index, alpha=image)
    table |= dict(vertices=points, grad_vertices=points, loss=np.zeros(1))
    table |= dict(prediction=image, areas=np.zeros((1, 2))) | change(wrong)
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
            with pytest.raises(ValueError, match=words):
                call(name, table)
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
        _C.rasterize(**arguments, num_threads=1)


def test_arguments_that_are_missing_are_named():
    with pytest.raises(TypeError, match="the argument faces is missing"):
        _C.rasterize(vertices=ARRAYS["vertices"], starts=None)


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
