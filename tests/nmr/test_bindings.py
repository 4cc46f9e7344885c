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
import torch

from nmr import _C, ops

CALLS = {
    "rasterize": lambda a: _C.rasterize(
        a["vertices"], a["faces"], a["starts"], a["face_index"], True, 0.1, 100.0, True, 1
    ),
    "silhouette": lambda a: _C.silhouette_forward(a["face_index"], a["alpha"], True, 1),
    "silhouette_backward": lambda a: _C.silhouette_backward(
        a["vertices"], a["faces"], a["starts"], a["face_index"], a["alpha"], a["grad"], True, 1e-4, 1
    ),
    "local_gradient": lambda a: _C.local_gradient(
        a["vertices"], a["faces"], a["starts"], a["face_index"], a["alpha"], a["grad"], True, 1e-4, 1
    ),
    "smoothness": lambda a: _C.smoothness_forward(a["vertices"], a["edges"], a["loss"], 1),
    "smoothness_backward": lambda a: _C.smoothness_backward(a["vertices"], a["edges"], a["loss"], a["grad"], 1),
    "soft_iou": lambda a: _C.soft_iou_forward(a["prediction"], a["target"], a["areas"], a["loss"], 1),
    "soft_iou_backward": lambda a: _C.soft_iou_backward(
        a["prediction"], a["target"], a["areas"], a["loss"], a["grad_prediction"], a["grad_target"], 1
    ),
    "voxelize": lambda a: _C.voxelize(a["vertices"].astype(np.float32), a["faces"], a["voxels"], a["size"], True, 1),
}
RASTER, SMOOTHNESS = ("rasterize", "silhouette_backward", "local_gradient"), ("smoothness", "smoothness_backward")
IOU = ("soft_iou", "soft_iou_backward")
STARTS = np.array([[0, 0], [6, 2], [12, 4]])


@pytest.mark.parametrize(
    "calls, change, words",
    [
        (RASTER, dict(vertices=np.zeros((12, 3))), r"vertices must have shape \[B, V, 3\], got \[12, 3\]"),
        (RASTER, dict(starts=STARTS), r"vertices must have shape \[N, 3\], got \[2, 12, 3\]"),
        (RASTER, dict(faces=np.zeros((4, 2), int)), r"faces must have shape \[F, 3\], or .* got \[4, 2\]"),
        (RASTER, dict(faces=np.zeros((3, 4, 3), int)), r"with the B of vertices \[2, 12, 3\], got \[3, 4, 3\]"),
        (RASTER, dict(faces=np.full((4, 3), -1)), "faces refer to vertex -1, but a mesh has 12 vertices"),
        (("rasterize",), dict(face_index=np.zeros((2, 0, 0), np.int32)), r"H and W in 1\.\.16384, got \[2, 0, 0\]"),
        (
            ("rasterize",),
            dict(face_index=np.zeros((3, 8, 8), np.int32)),
            r"face_index must have shape \[2, H, W\] .*, got \[3, 8, 8\]",
        ),
        (("silhouette",), dict(alpha=np.zeros((2, 4))), r"alpha must have shape \[B, h, w\], got \[2, 4\]"),
        (("silhouette",), dict(alpha=np.zeros((2, 4, 5))), r"face_index must have shape \[2, 8, 10\], got \[2, 8, 8\]"),
        (("silhouette",), dict(face_index=np.zeros((2, 4, 4), np.int32)), r"face_index must have shape \[2, 8, 8\]"),
        (RASTER[1:], dict(face_index=np.zeros((2, 9, 9), np.int32)), r"has an even size, got \[2, 9, 9\]"),
        (
            RASTER[1:],
            dict(face_index=np.full((2, 8, 8), 9, np.int32)),
            "the face index map does not belong to these faces",
        ),
        (RASTER[1:], dict(alpha=np.zeros((2, 8, 8))), r"grad_alpha must have shape \[2, 4, 4\], got \[2, 8, 8\]"),
        (RASTER[1:], dict(grad=np.zeros((1, 12, 3))), r"grad_vertices must have shape \[2, 12, 3\], got \[1, 12, 3\]"),
        (SMOOTHNESS, dict(vertices=np.zeros((2, 12))), r"vertices must have shape \[B, V, 3\], got \[2, 12\]"),
        (SMOOTHNESS, dict(edges=np.zeros((1, 3), int)), r"edges must have shape \[E, 4\], got \[1, 3\]"),
        (SMOOTHNESS, dict(edges=np.full((1, 4), 12)), "edges refer to vertex 12, but a mesh has 12 vertices"),
        (SMOOTHNESS[:1], dict(loss=np.zeros(3)), r"loss must have shape \[2\], got \[3\]"),
        (SMOOTHNESS[1:], dict(loss=np.zeros(3)), r"grad_loss must have shape \[2\], got \[3\]"),
        (SMOOTHNESS[1:], dict(grad=np.zeros((2, 12))), r"grad_vertices must have shape \[2, 12, 3\], got \[2, 12\]"),
        (IOU, dict(prediction=np.zeros(9)), r"prediction must have shape \[B, N\], got \[9\]"),
        (IOU, dict(target=np.zeros((2, 8))), r"target must have shape \[2, 9\], got \[2, 8\]"),
        (IOU, dict(areas=np.zeros((3, 2))), r"areas must have shape \[2, 2\], got \[3, 2\]"),
        (IOU[:1], dict(loss=np.zeros(3)), r"iou must have shape \[2\], got \[3\]"),
        (IOU[1:], dict(loss=np.zeros(3)), r"grad_iou must have shape \[2\], got \[3\]"),
        (IOU[1:], dict(grad_prediction=np.zeros(9)), r"grad_prediction must have shape \[2, 9\], got \[9\]"),
        (IOU[1:], dict(grad_target=np.zeros((1, 9))), r"grad_target must have shape \[2, 9\], got \[1, 9\]"),
        (("voxelize",), dict(size=0), r"size must lie in 1\.\.1024, got 0"),
        (("voxelize",), dict(size=5), r"voxels must have shape \[2, 5, 5, 5\], got \[2, 4, 4, 4\]"),
    ],
)
def test_no_call_reads_or_writes_outside_an_array(calls, change, words):
    arguments = dict(
        vertices=np.random.default_rng(0).random((2, 12, 3)) + 0.5,
        faces=np.arange(12).reshape(4, 3),
        starts=None,
        face_index=np.zeros((2, 8, 8), np.int32),
        alpha=np.zeros((2, 4, 4)),
        grad=np.zeros((2, 12, 3)),
        edges=np.array([[0, 1, 2, 3]]),
        loss=np.zeros(2),
        prediction=np.ones((2, 9)),
        target=np.ones((2, 9)),
        areas=np.ones((2, 2)),
        grad_prediction=np.zeros((2, 9)),
        grad_target=np.zeros((2, 9)),
        voxels=np.zeros((2, 4, 4, 4), bool),
        size=4,
    )
    for call in calls:
        CALLS[call](arguments)
        with pytest.raises(ValueError, match=words):
            CALLS[call]({**arguments, **change})


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda v, wrong, face_index: _C.smoothness_forward(v, wrong.reshape(-1, 4), np.zeros(1), 1), "edges refer to"),
        (
            lambda v, wrong, face_index: _C.rasterize(v, wrong, None, face_index, True, 0.1, 100.0, True, 1),
            "faces refer to vertex",
        ),
        (
            lambda v, wrong, face_index: _C.interpolate_forward(
                v, wrong[None], face_index[:, :2], np.zeros((1, 2, 4096, 3)), None, np.zeros((1, 2, 4096, 3)), 1
            ),
            "corners refer to",
        ),
        (
            lambda v, wrong, face_index: _C.silhouette_backward(
                v, wrong[:1], None, face_index, np.zeros((1, 4096, 4096)), np.zeros((1, 3, 3)), False, 1e-4, 1
            ),
            "the face index map does not belong",
        ),
    ],
)
def test_other_python_threads_run_while_arrays_are_checked(call, words):
    vertices, wrong, face_index = (
        np.zeros((1, 3, 3)),
        np.zeros((4_000_000, 3), int),
        np.zeros((1, 4096, 4096), np.int32),
    )
    wrong[-1], face_index[0, -1, -1] = 3, 2
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
                call(vertices, wrong, face_index)
            if turns[0] > before:
                break
        assert turns[0] > before
    finally:
        stop[0] = True
        sys.setswitchinterval(interval)
        thread.join()


@pytest.mark.parametrize("points", [(2, 5, 3), (3, 4, 3)])
def test_projected_points_have_the_shape_of_the_vertices(points):
    camera = [np.zeros(shape) for shape in ((2, 3, 4), (2, 2, 3))]
    with pytest.raises(ValueError, match=rf"points must have shape \[2, 4, 3\], got \[{points[0]}, {points[1]}, 3\]"):
        _C.project_forward(np.zeros((2, 4, 3)), *camera, None, None, None, None, np.zeros(points), True, 1)


@pytest.mark.parametrize("change", [np.int32, np.asfortranarray, None])
def test_nothing_is_converted_silently(change):
    faces = None if change is None else np.arange(12).reshape(4, 3)
    faces = faces.astype(change) if change is np.int32 else faces if change is None else change(faces)
    with pytest.raises(TypeError, match="incompatible function arguments"):
        _C.rasterize(np.zeros((2, 12, 3)), faces, None, np.zeros((2, 8, 8), np.int32), True, 0.1, 100.0, True, 1)


def promised(gigabytes, dtype):
    """An array of memory that is promised and never touched."""
    no_reserve = getattr(mmap, "MAP_NORESERVE", 0x4000)  # in the module from Python 3.13
    block = mmap.mmap(-1, gigabytes << 30, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | no_reserve)
    return np.frombuffer(block, dtype)


@pytest.mark.skipif(sys.platform != "linux", reason="memory that is promised and never touched")
def test_more_faces_than_an_face_index_map_can_name():
    faces, face_index = promised(24, np.int64).reshape(-1, 3), np.zeros((1, 8, 8), np.int32)
    with pytest.raises(ValueError, match=r"at most 2\^30 faces per mesh"):
        _C.rasterize(np.zeros((1, 3, 3)), faces, None, face_index, True, 0.1, 100.0, True, 1)


@pytest.mark.skipif(sys.platform != "linux", reason="memory that is promised and never touched")
@pytest.mark.parametrize("packed", [False, True])
def test_more_vertices_than_the_set_up_of_faces_can_name(packed):
    vertices, faces = promised(6, np.float32).reshape(-1, 3), np.array([[0, 1, 2]])
    starts = np.array([[0, 0], [len(vertices), 1]]) if packed else None
    face_index = np.zeros((1, 8, 8), np.int32)
    with pytest.raises(ValueError, match=r"at most 2\^29 vertices per mesh"):
        _C.rasterize(vertices if packed else vertices[None], faces, starts, face_index, True, 0.1, 100.0, True, 1)


def test_gradients_of_gradients_are_refused():
    """Those of the public functions are in their own tests; this one no public function reaches."""
    grad = torch.rand(1, 4, 4, 1, requires_grad=True)
    with pytest.raises(RuntimeError, match=r"render has no second derivative.*without create_graph=True"):
        ops.edges.resolve_backward(grad, None, torch.zeros(1, 8, 8, dtype=torch.int32), True, True, False)[
            0
        ].sum().backward()


def test_without_its_compiled_part_the_package_says_so():
    code = "import sys; sys.modules['nmr._C'] = None; import nmr"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "ImportError: the compiled part of nmr is missing" in result.stderr


@pytest.mark.parametrize("name", ["vertices", "matrix", "intrinsics", "distortion", "origin", "extent"])
def test_project_backward_checks_the_shape_of_every_output(name):
    shapes = dict(
        vertices=(2, 4, 3), matrix=(2, 3, 4), intrinsics=(2, 2, 3), distortion=(2, 5), origin=(2, 3), extent=(2,)
    )
    inputs = [np.ones(shape) for shape in shapes.values()]
    grads = {key: np.ones(shape) for key, shape in shapes.items()}
    grads[name] = np.ones((7, *shapes[name]))
    order = ("vertices", "matrix", "intrinsics", "distortion", "origin", "extent")
    with pytest.raises(ValueError, match=f"grad_{name} must have shape"):
        _C.project_backward(*inputs, None, np.ones((2, 4, 3)), *(grads[key] for key in order), True, 1)
