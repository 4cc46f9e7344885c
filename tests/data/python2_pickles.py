"""Object arrays in npy files, byte for byte as Python 2 and its numpy wrote them (nobody has these to run any more)."""

from __future__ import annotations

import struct

import numpy as np

HEADER = b"{'descr': '|O', 'fortran_order': False, 'shape': (%d,), }"


def npy(content: bytes, count: int = 2, header: bytes | None = None) -> bytes:
    """An npy file of an object array of `count` items, or with another header, around the content."""
    header = HEADER % count if header is None else header
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + content


def short_string(text: bytes) -> bytes:
    """A Python 2 string in a pickle."""
    return b"U" + bytes([len(text)]) + text


def python2_pickle(images: list[np.ndarray]) -> bytes:
    """Protocol 2 as Python 2 and its numpy wrote it: byte strings everywhere, module names of numpy 1."""

    def dtype(code: bytes, flags: int) -> bytes:
        state = (
            b"(K\x03"
            + short_string(b"|")
            + b"NNN"
            + b"J\xff\xff\xff\xff" * 2
            + b"K"
            + bytes([flags])
            + b"tb"
        )
        return b"cnumpy\ndtype\n" + short_string(code) + b"K\x00K\x01\x87R" + state

    def array(shape: tuple[int, ...], kind: bytes, data: bytes) -> bytes:
        # Python 2's longs
        sizes = b"(" + b"".join(b"\x8a" + bytes([2]) + struct.pack("<h", n) for n in shape) + b"t"
        make = (
            b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85"
            + short_string(b"b")
            + b"\x87R"
        )
        return make + b"(K\x01" + sizes + kind + b"\x89" + data + b"tb"

    def string(data: bytes) -> bytes:
        return b"T" + struct.pack("<i", len(data)) + data

    items = b"".join(
        array(image.shape, dtype(b"u1", 0), string(image.tobytes())) for image in images
    )
    return b"\x80\x02" + array((len(images),), dtype(b"O8", 63), b"](" + items + b"e") + b"."
