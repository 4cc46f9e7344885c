"""Arrays out of npz files that hold pickles, read as data: nothing that a file names is ever imported or called.

NumPy stores an object array (images of different sizes, say) as a pickle, and unpickling runs whatever a pickle asks
for. `read_member` reads the one form that such an array has, with an interpreter of its own for the three dozen pickle
instructions that NumPy's arrays need (protocols 2 to 4, written by Python 2 or 3, NumPy 1 or 2). Four names have a
meaning: the array, its maker, its dtype, and the latin-1 encoding that stands for bytes in protocol 2. Every other
name, instruction, dtype or nesting is refused; and nothing is allocated before the file is known to be long enough.
"""

from __future__ import annotations

import math
import re
import struct
import warnings
import zipfile
from collections.abc import Callable
from typing import Any, BinaryIO

import numpy as np

from learn3d.files import limits, npz

_MAKERS = {
    ("numpy.core.multiarray", "_reconstruct"): "make",
    ("numpy._core.multiarray", "_reconstruct"): "make",
    ("numpy", "ndarray"): "ndarray",
    ("numpy", "dtype"): "dtype",
    ("_codecs", "encode"): "encode",
}
_STACK = 10_000  # things in hand; pickles append a thousand items at a time, and an array takes ten
_NUMERIC = re.compile(r"[|<>=]?([biu][1248]|f[248])|\?")


class _Name:
    """One of the admitted names, as a token."""

    def __init__(self, kind: str) -> None:
        self.kind = kind


class _Mark:
    """Where the items of a tuple or list begin on the stack."""


class _Dtype:
    """A dtype under construction: a kind and size such as 'u1', or 'O'; its byte order comes with BUILD."""

    def __init__(self, code: str) -> None:
        self.code, self.order = code, "|"


class _Array:
    """An array under construction; `value` is an ndarray, or a list of ndarrays for an object array."""

    def __init__(self) -> None:
        self.value: np.ndarray | list[np.ndarray] | None = None


def read_member(archive: zipfile.ZipFile, key: str, *, max_bytes: int | None = None) -> np.ndarray | list[np.ndarray]:
    """The array `key` of an archive (`npz.open_npz`): an ndarray, or the ndarrays of an object array [N].

    max_bytes: refuse arrays larger than that. None: it is not known how large they may be, and then an archive that
    unpacks to very many times its size is taken for a trap.

    Raises ValueError, naming file and key, where the key is missing, the file damaged, the array of another kind, or
    the pickle asks for anything but arrays; nothing in it has been executed then. Arrays may be read-only.
    """
    with npz.open_member(archive, key, max_bytes=max_bytes) as (file, size):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Reading `.npy`")  # Python 2's headers have numbers such as 12L
            head = npz.read_header(file)
        stream = _Stream(file, size - file.tell())
        if head.dtype != np.dtype(object):
            npz.check_size(head, stream.left)
            array = npz.from_bytes(stream.read(stream.left), head)
            stream.finish()
            return array
        if len(head.shape) != 1 or head.shape[0] > limits.PICKLED_ARRAYS:
            most = limits.PICKLED_ARRAYS
            raise ValueError(f"an object array must be one-dimensional with at most {most} items, got {head.shape}")
        items = _Interpreter(stream, head.shape[0]).run()
        if len(items) != head.shape[0]:
            raise ValueError(f"its header promises {head.shape[0]} items, it holds {len(items)}")
        stream.finish()
        return items


class _Stream:
    """So many bytes of a file, and never more."""

    def __init__(self, file: BinaryIO, left: int) -> None:
        self.file, self.left, self.total = file, left, left

    def read(self, count: int) -> bytes:
        if count > self.left:
            raise ValueError(f"it asks for {count} bytes where {self.left} are left")
        data = self.file.read(count)
        if len(data) != count:
            raise ValueError("it ends early")
        self.left -= count
        return data

    def unpack(self, form: str) -> int:
        return struct.unpack(form, self.read(struct.calcsize(form)))[0]

    def line(self) -> str:
        data = bytearray()
        while (byte := self.read(1)) != b"\n":
            data += byte
            if len(data) > 200:
                raise ValueError("a name is longer than 200 characters")
        return data.decode("ascii", "replace")

    def finish(self) -> None:
        """Reading to the end is what makes zipfile compare the checksum."""
        if self.left or self.file.read(1):
            raise ValueError(f"{self.left} bytes follow the array")


class _Interpreter:
    """Runs the instructions of a pickle of one object array of numeric arrays."""

    def __init__(self, stream: _Stream, arrays: int) -> None:
        self.stream, self.stack, self.memo, self.encoded = stream, [], {}, 0
        self.budget = 1000 + 64 * arrays  # instructions: an array takes about 30
        read, unpack = stream.read, stream.unpack
        self.instructions: dict[bytes, Callable[[], Any]] = {
            b"\x80": lambda: self._protocol(unpack("<B")),
            b"\x95": lambda: unpack("<Q"),  # frame: its length is of no interest
            b"(": lambda: self.stack.append(_Mark()),
            b"N": lambda: self.stack.append(None),
            b"\x88": lambda: self.stack.append(True),
            b"\x89": lambda: self.stack.append(False),
            b"K": lambda: self.stack.append(unpack("<B")),
            b"M": lambda: self.stack.append(unpack("<H")),
            b"J": lambda: self.stack.append(unpack("<i")),
            b"\x8a": lambda: self.stack.append(int.from_bytes(read(unpack("<B")), "little", signed=True)),
            # Python 2's strings are bytes, names and codes included
            b"U": lambda: self.stack.append(read(unpack("<B"))),
            b"T": lambda: self.stack.append(read(unpack("<I"))),
            b"C": lambda: self.stack.append(read(unpack("<B"))),
            b"B": lambda: self.stack.append(read(unpack("<I"))),
            b"\x8e": lambda: self.stack.append(read(unpack("<Q"))),
            b"\x8c": lambda: self.stack.append(read(unpack("<B")).decode()),
            b"X": lambda: self.stack.append(read(unpack("<I")).decode()),
            b"\x8d": lambda: self.stack.append(read(unpack("<Q")).decode()),
            b")": lambda: self.stack.append(()),
            b"\x85": lambda: self._tuple(1),
            b"\x86": lambda: self._tuple(2),
            b"\x87": lambda: self._tuple(3),
            b"t": lambda: self.stack.append(tuple(self._items())),
            b"]": lambda: self.stack.append([]),
            b"a": lambda: self._extend([self._pop()]),
            b"e": lambda: self._extend(self._items()),
            b"q": lambda: self._memoize(unpack("<B")),
            b"r": lambda: self._memoize(unpack("<I")),
            b"\x94": lambda: self._memoize(len(self.memo)),
            b"h": lambda: self._recall(unpack("<B")),
            b"j": lambda: self._recall(unpack("<I")),
            b"c": lambda: self._name(stream.line(), stream.line()),
            b"\x93": lambda: self._name(*reversed([self._pop(), self._pop()])),
            b"R": self._reduce,
            b"b": self._build,
        }

    def run(self) -> list[np.ndarray]:
        """The items of the object array."""
        while (code := self.stream.read(1)) != b".":
            self.budget -= 1
            if self.budget < 0:
                raise ValueError("its pickle has too many instructions")
            if code not in self.instructions:
                raise ValueError(f"its pickle has the instruction {code!r}, which no array needs; it is refused")
            self.instructions[code]()
            if len(self.stack) > _STACK:
                raise ValueError("its pickle piles up more than arrays need")
        result = self._pop()
        if self.stack or not isinstance(result, _Array) or not isinstance(result.value, list):
            raise ValueError("its pickle is not that of an object array")
        return result.value

    def _protocol(self, version: int) -> None:
        if version not in (2, 3, 4):
            raise ValueError(f"its pickle has protocol {version}; 2 to 4, which numpy writes, are read")

    def _pop(self) -> Any:
        if not self.stack or isinstance(self.stack[-1], _Mark):
            raise ValueError("its pickle takes from an empty stack")
        return self.stack.pop()

    def _items(self) -> list[Any]:
        """What is above the last mark, which goes too."""
        start = next((k for k in reversed(range(len(self.stack))) if isinstance(self.stack[k], _Mark)), None)
        if start is None:
            raise ValueError("its pickle has items without a mark")
        items = self.stack[start + 1 :]
        del self.stack[start:]
        return items

    def _tuple(self, size: int) -> None:
        self.stack.append(tuple(reversed([self._pop() for _ in range(size)])))

    def _extend(self, items: list[Any]) -> None:
        target = self._pop()
        if type(target) is not list:
            raise ValueError("its pickle appends to what is no list")
        target.extend(items)
        self.stack.append(target)

    def _memoize(self, index: int) -> None:
        value = self._pop()
        self.memo[index] = value
        self.stack.append(value)

    def _recall(self, index: int) -> None:
        if index not in self.memo:
            raise ValueError("its pickle recalls what it never stored")
        self.stack.append(self.memo[index])

    def _name(self, module: Any, name: Any) -> None:
        module, name = _text(module), _text(name)
        if (module, name) not in _MAKERS:
            raise ValueError(
                f"its pickle asks for {module}.{name}, which no array needs; it is refused, and nothing was executed"
            )
        self.stack.append(_Name(_MAKERS[module, name]))

    def _reduce(self) -> None:
        arguments, function = self._pop(), self._pop()
        if not isinstance(function, _Name) or type(arguments) is not tuple:
            raise ValueError("its pickle calls what is no function of arrays")
        result = _call(function.kind, arguments)
        if isinstance(result, bytes):
            self.encoded += len(result)
            if self.encoded > self.stream.total:
                raise ValueError("its pickle makes more bytes than the file has")  # of one string, many times
        self.stack.append(result)

    def _build(self) -> None:
        state, target = self._pop(), self._pop()
        if type(state) is tuple and isinstance(target, _Dtype) and len(state) == 8 and state[2:5] == (None,) * 3:
            target.order = _text(state[1])
        elif type(state) is tuple and isinstance(target, _Array) and len(state) == 5 and target.value is None:
            target.value = _array_value(*state[1:], limit=self.stream.total)
        else:
            raise ValueError("its pickle sets a state that no array of numbers has")
        self.stack.append(target)


def _call(kind: str, arguments: tuple[Any, ...]) -> Any:
    """What the four admitted functions come to."""
    if kind == "encode" and len(arguments) == 2 and type(arguments[0]) is str and _text(arguments[1]) == "latin1":
        return arguments[0].encode("latin-1")
    if kind == "make" and len(arguments) == 3 and getattr(arguments[0], "kind", None) == "ndarray":
        return _Array()  # numpy gives it the shape (0,) and a type that BUILD replaces
    if kind == "dtype" and len(arguments) == 3 and arguments[1] in (0, False) and arguments[2] in (1, True):
        code = _text(arguments[0])
        if code.lstrip("|<>=") in ("O", "O4", "O8"):
            return _Dtype("O")
        if not _NUMERIC.fullmatch(code):
            raise ValueError(f"its pickle has the dtype {code!r}; only numbers are read")
        return _Dtype(code.lstrip("|<>="))
    raise ValueError(f"its pickle calls {kind} with arguments that numpy does not write")


def _array_value(shape: Any, dtype: Any, fortran: Any, data: Any, *, limit: int) -> np.ndarray | list[np.ndarray]:
    sizes_fit = type(shape) is tuple and len(shape) <= 8 and all(type(n) is int and n >= 0 for n in shape)
    if not sizes_fit or not isinstance(dtype, _Dtype):
        raise ValueError("its pickle holds an array whose shape or dtype is none")
    count = math.prod(shape)
    if dtype.code == "O":
        if type(data) is not list or len(data) != count or len(shape) != 1 or count > limits.PICKLED_ARRAYS:
            raise ValueError(f"its pickle holds an object array {list(shape)} that does not fit its items")
        if not all(isinstance(item, _Array) and isinstance(item.value, np.ndarray) for item in data):
            raise ValueError("the items of an object array must be arrays of numbers")
        arrays = [item.value for item in data]
        if sum(array.nbytes for array in arrays) > limit:
            raise ValueError("its arrays take more bytes than the file has")  # one of them listed many times
        return arrays
    numbers = np.dtype((dtype.order if dtype.order in ("<", ">") else "") + dtype.code)
    if type(data) is not bytes or len(data) != count * numbers.itemsize:
        raise ValueError(f"its pickle declares an array {numbers} {list(shape)} that does not fit its data")
    return np.frombuffer(data, numbers).reshape(shape, order="F" if fortran else "C")


def _text(value: Any) -> str:
    """A short str; Python 2's are bytes here."""
    if type(value) is bytes and len(value) <= 200:
        return value.decode("latin-1")
    if type(value) is not str or len(value) > 200:
        raise ValueError("its pickle has something else where a name belongs")
    return value
