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
    "local": f"{MESH} face_index grad_alpha=alpha grad_vertices anti_aliasing eps local=true",
    "smoothness": "vertices edges loss",
    "smoothness_backward": "vertices edges grad_loss=loss grad_vertices",
    "soft_iou_loss": "prediction target areas loss=value",
    "soft_iou_loss_backward": "prediction target areas grad_loss=value grad_prediction grad_target",
    "voxels": "vertices=single faces grid size touched",
}
NUMBERS = dict(near=0.1, far=100.0, eps=1e-4, fill_back=True, perspective=True, anti_aliasing=True)
NUMBERS |= dict(local=False, true=True, touched=True)
RASTER = ("rasterize", "silhouette_backward", "local")
SMOOTHNESS = ("smoothness", "smoothness_backward")
IOU = ("soft_iou_loss", "soft_iou_loss_backward")


def call(name, table):
    names = [pair.partition("=")[::2] for pair in CALLS[name].split()]
    function = getattr(_C, "silhouette_backward" if name == "local" else name)
    function(**{key: table[other or key] for key, other in names}, num_threads=1)


STARTS = np.array([[0, 0], [6, 2], [12, 4]])


@pytest.mark.parametrize(
    "calls, change, words",
    [
        (
            RASTER,
            dict(vertices=np.zeros((12, 3))),
            r"vertices must have shape \[B, V, 3\], got \[12, 3\]",
        ),
        (RASTER, dict(starts=STARTS), r"vertices must have shape \[N, 3\], got \[2, 12, 3\]"),
        (
            RASTER,
            dict(faces=np.zeros((4, 2), int)),
            r"faces must have shape \[F, 3\] or \[2, F, 3\], got \[4, 2\]",
        ),
        (
            RASTER,
            dict(faces=np.zeros((3, 4, 3), int)),
            r"faces .* \[F, 3\] or \[2, F, 3\], got \[3, 4, 3\]",
        ),
        (
            RASTER,
            dict(faces=np.full((4, 3), -1)),
            "faces refer to vertex -1, but a mesh has 12 vertices",
        ),
        (
            ("rasterize",),
            dict(face_index=np.zeros((2, 0, 0), np.int32)),
            "face_index must have H and W in 1..16384",
        ),
        (
            ("rasterize",),
            dict(face_index=np.zeros((3, 8, 8), np.int32)),
            r"face_index must have shape \[2, H, W\], got \[3, 8, 8\]",
        ),
        (
            ("silhouette",),
            dict(alpha=np.zeros((2, 4))),
            r"alpha must have shape \[2, 4, 4\], got \[2, 4\]",
        ),
        (
            ("silhouette",),
            dict(alpha=np.zeros((2, 4, 5))),
            r"alpha must have shape \[2, 4, 4\], got \[2, 4, 5\]",
        ),
        (
            RASTER[1:],
            dict(face_index=np.zeros((2, 9, 9), np.int32)),
            r"has an even size, got \[2, 9, 9\]",
        ),
        (
            RASTER[1:],
            dict(face_index=np.full((2, 8, 8), 9, np.int32)),
            "the face index map does not belong to these faces",
        ),
        (
            RASTER[1:],
            dict(alpha=np.zeros((2, 8, 8))),
            r"grad_alpha must have shape \[2, 4, 4\], got \[2, 8, 8\]",
        ),
        (
            RASTER[1:],
            dict(grad_vertices=np.zeros((1, 12, 3))),
            r"grad_vertices .* \[2, 12, 3\], got \[1, 12, 3\]",
        ),
        (
            SMOOTHNESS,
            dict(vertices=np.zeros((2, 12))),
            r"vertices must have shape \[B, V, 3\], got \[2, 12\]",
        ),
        (
            SMOOTHNESS,
            dict(edges=np.zeros((1, 3), int)),
            r"edges must have shape \[E, 4\], got \[1, 3\]",
        ),
        (
            SMOOTHNESS,
            dict(edges=np.full((1, 4), 12)),
            "edges refer to vertex 12, but a mesh has 12 vertices",
        ),
        (SMOOTHNESS[:1], dict(loss=np.zeros(3)), r"loss must have shape \[2\], got \[3\]"),
        (SMOOTHNESS[1:], dict(loss=np.zeros(3)), r"grad_loss must have shape \[2\], got \[3\]"),
        (
            SMOOTHNESS[1:],
            dict(grad_vertices=np.zeros((2, 12))),
            r"grad_vertices .* \[2, 12, 3\], got \[2, 12\]",
        ),
        (IOU, dict(prediction=np.zeros(9)), r"target must have shape \[9\], got \[2, 9\]"),
        (IOU, dict(target=np.zeros((2, 8))), r"target must have shape \[2, 9\], got \[2, 8\]"),
        (IOU, dict(areas=np.zeros((3, 2))), r"areas must have shape \[2, 2\], got \[3, 2\]"),
        (IOU[:1], dict(value=np.zeros(3)), r"loss must have shape \[\], got \[3\]"),
        (IOU[1:], dict(value=np.zeros(3)), r"grad_loss must have shape \[\], got \[3\]"),
        (
            IOU[1:],
            dict(grad_prediction=np.zeros(9)),
            r"grad_prediction must have shape \[2, 9\], got \[9\]",
        ),
        (
            IOU[1:],
            dict(grad_target=np.zeros((1, 9))),
            r"grad_target must have shape \[2, 9\], got \[1, 9\]",
        ),
        (("voxels",), dict(size=0), r"size must lie in 1\.\.1024, got 0"),
        (("voxels",), dict(size=5), r"grid must have shape \[2, 5, 5, 5\], got \[2, 4, 4, 4\]"),
    ],
)
def test_no_call_reads_or_writes_outside_an_array(calls, change, words):
    arguments = dict(
        vertices=np.random.default_rng(0).random((2, 12, 3)) + 0.5,
        faces=np.arange(12).reshape(4, 3),
        starts=None,
        face_index=np.zeros((2, 8, 8), np.int32),
        alpha=np.zeros((2, 4, 4)),
        grad_vertices=np.zeros((2, 12, 3)),
        single=np.ones((2, 12, 3), np.float32),
        edges=np.array([[0, 1, 2, 3]]),
        loss=np.zeros(2),
        value=np.zeros(()),
        prediction=np.ones((2, 9)),
        target=np.ones((2, 9)),
        areas=np.ones((2, 2)),
        grad_prediction=np.zeros((2, 9)),
        grad_target=np.zeros((2, 9)),
        grid=np.zeros((2, 4, 4, 4), bool),
        size=4,
        **NUMBERS,
    )
    for name in calls:
        call(name, arguments)
        with pytest.raises(ValueError, match=words):
            call(name, {**arguments, **change})


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
    wrong, face_index = np.zeros((4_000_000, 3), int), np.zeros((1, 4096, 4096), np.int32)
    wrong[-1], face_index[0, -1, -1] = 3, 2
    image = np.zeros((1, 4096, 4096))
    table = dict(
        vertices=np.zeros((1, 3, 3)),
        starts=None,
        face_index=face_index,
        alpha=image,
        loss=np.zeros(1),
    )
    table |= dict(
        prediction=image,
        areas=np.zeros((1, 2)),
        value=np.zeros(()),
        grad_vertices=np.zeros((1, 3, 3)),
    )
    table |= NUMBERS | dict(anti_aliasing=False) | change(wrong)
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
        (
            "faces",
            np.arange(12, dtype=np.int32).reshape(4, 3),
            "faces must be .* array of int64, got int32",
        ),
        (
            "faces",
            np.asfortranarray(np.arange(12).reshape(4, 3)),
            "faces must be .* of int64, got one with gaps",
        ),
        ("faces", None, "faces must not be None"),
        ("far", np.zeros(1), "far must be a number, got float64"),
        ("faces", [[0, 1, 2]], "faces must be .*, got another type"),
        ("normals", np.zeros(1), "there is no argument normals"),
    ],
)
def test_nothing_is_converted_silently(name, value, words):
    table = dict(vertices=np.zeros((2, 12, 3)), faces=np.arange(12).reshape(4, 3), starts=None)
    table |= dict(face_index=np.zeros((2, 8, 8), np.int32)) | NUMBERS
    arguments = {key: table[key] for key in CALLS["rasterize"].split()} | {name: value}
    with pytest.raises(TypeError, match=words):
        _C.rasterize(**arguments, num_threads=1)
    with pytest.raises(TypeError, match="the argument faces is missing"):
        _C.rasterize(vertices=table["vertices"], starts=None)


def promised(gigabytes, dtype):
    """An array of memory that is promised and never touched."""
    no_reserve = getattr(mmap, "MAP_NORESERVE", 0x4000)  # in the module from Python 3.13
    block = mmap.mmap(-1, gigabytes << 30, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | no_reserve)
    return np.frombuffer(block, dtype)


@pytest.mark.skipif(sys.platform != "linux", reason="memory that is promised and never touched")
def test_more_faces_than_an_face_index_map_can_name():
    faces, face_index = promised(24, np.int64).reshape(-1, 3), np.zeros((1, 8, 8), np.int32)
    with pytest.raises(ValueError, match=r"at most 2\^30 faces per mesh"):
        call(
            "rasterize",
            dict(vertices=np.zeros((1, 3, 3)), faces=faces, starts=None, face_index=face_index)
            | NUMBERS,
        )


@pytest.mark.skipif(sys.platform != "linux", reason="memory that is promised and never touched")
@pytest.mark.parametrize("packed", [False, True])
def test_more_vertices_than_the_set_up_of_faces_can_name(packed):
    vertices, faces = promised(6, np.float32).reshape(-1, 3), np.array([[0, 1, 2]])
    starts = np.array([[0, 0], [len(vertices), 1]]) if packed else None
    face_index = np.zeros((1, 8, 8), np.int32)
    with pytest.raises(ValueError, match=r"at most 2\^29 vertices per mesh"):
        vertices = vertices if packed else vertices[None]
        call(
            "rasterize",
            dict(vertices=vertices, faces=faces, starts=starts, face_index=face_index) | NUMBERS,
        )


def test_without_its_compiled_part_the_package_says_so():
    code = "import sys; sys.modules['nmr._C'] = None; import nmr"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert "ImportError: the compiled part of nmr is missing" in result.stderr


@pytest.mark.parametrize("name", ["points", "vertices", "camera", "distortion"])
def test_project_checks_the_shape_of_every_output(name):
    inputs = dict(
        vertices=np.ones((2, 4, 3)),
        camera=np.ones((2, 22)),
        distortion=np.ones((2, 5)),
        starts=None,
    )
    grads = {f"grad_{key}": np.ones_like(value) for key, value in inputs.items() if key != "starts"}
    grads["grad_points"] = np.ones((2, 4, 3))
    _C.project_backward(**inputs, **grads, perspective=True, num_threads=1)
    grads[f"grad_{name}"] = np.ones((7, *grads[f"grad_{name}"].shape))
    with pytest.raises(ValueError, match=f"grad_{name} must have shape"):
        _C.project_backward(**inputs, **grads, perspective=True, num_threads=1)
