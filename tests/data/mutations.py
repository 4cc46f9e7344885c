"""Damage for fuzzing: bytes, text, JSON, and the formats whose checksums would keep plain damage on the surface."""

from __future__ import annotations

import io
import json
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

Mutation = Callable[[random.Random, bytes], bytes]

# fmt: off
WORDS = [b"nan", b"-inf", b"1e400", b"-1", b"0", b"99999999999999999999", b"1" * 400, b"9" * 5000, b"0x10", b"",
         b"1e-320", b"../../x", b"/etc/x", b"\0", b"\xff\xfe", b'"', b"{", b"[" * 3000, b"4294967296"]
VALUES: list[Any] = [None, True, -1, 0, 1, 2**31, 2**63, 10**200, 1.5, -1e308, "", "abc", "../..", "\0", [], {}, [1],
                     {"a": 1}, "F4", "F8_E8M0", "BOOL", "C64"]  # the last are types of tensors
SIZES = [0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**60, 2**63, 2**64 - 1]
HEADERS = {  # parts of an npy file's header, and replacements
    rb"'descr': '[^']*'": [b"'descr': " + kind for kind in (b"'|O'", b"'<f8'", b"'|b1'", b"'>i2'", b"'<U9'", b"'<f16'",
                                                            b"[('a','<f4')]", b"5")],
    rb"\([0-9, ]*\)": [b"()", b"(-1,)", b"(1000000000000,)", b"(0,)", b"(2**9,)", b"(1,1,1)", b"(((((",
                       b"(0,99999999999)", b"-" * 3000 + b"1"],
    rb"False": [b"True", b"5", b"None"],
}
# fmt: on


def damage(rng: random.Random, content: bytes) -> bytes:
    """A few changes of any kind to plain bytes."""
    data = bytearray(content)
    for _ in range(rng.choice([1, 1, 1, 2, 4])):
        at = (
            rng.randrange(len(data) + 1)
            if rng.random() < 0.6
            else rng.randrange(min(len(data), 200) + 1)
        )
        length, other = rng.choice([1, 2, 4, 8, 40, 1000]), rng.randrange(len(data) + 1)
        value = rng.choice(SIZES).to_bytes(8, rng.choice(["little", "big"]))
        end, new = rng.choice(
            [
                (len(data), b""),  # cut short
                (at + 1, bytes([byte ^ 1 << rng.randrange(8) for byte in data[at : at + 1]])),
                (at + 8, value if rng.random() < 0.5 else value.strip(b"\0")),
                (at, rng.randbytes(length)),
                (at + length, b""),
                (at, data[at : at + length]),
                (at + length, data[other : other + length]),
                (at + length, bytes([rng.choice([0, 255, 10, 32])]) * length),
            ]
        )
        data[at:end] = new
    return bytes(data)


def damage_text(rng: random.Random, content: bytes) -> bytes:
    """Words and lines replaced, repeated, dropped; or plain damage."""
    if rng.random() < 0.2:
        return damage(rng, content)
    lines = content.split(b"\n")
    for _ in range(rng.choice([1, 1, 2, 3])):
        at = rng.randrange(len(lines)) if lines else 0
        kind = rng.randrange(6)
        if kind <= 2 and lines:
            words = re.split(rb"([\s,;/=\"]+)", lines[at])
            words[2 * rng.randrange((len(words) + 1) // 2)] = rng.choice(WORDS)
            lines[at] = b"".join(words)
        elif kind == 3 and lines:
            del lines[at]
        else:
            lines.insert(at, rng.choice([*lines[at : at + 1], rng.randbytes(rng.randrange(20))]))
    return b"\n".join(lines)


def damage_json(rng: random.Random, content: bytes) -> bytes:
    """Values replaced by others of any kind, names dropped and added; or damaged text."""
    if rng.random() < 0.2:
        return damage_text(rng, content)
    text = json.dumps(_changed(rng, json.loads(content)))
    return text.replace("1e+308", rng.choice(["Infinity", "NaN", "1e999"])).encode()


def _changed(rng: random.Random, value: Any) -> Any:
    if not isinstance(value, (dict, list)) or not value or rng.random() < 0.1:
        return rng.choice(VALUES)
    changed, kind = value.copy(), rng.random()
    key = rng.choice(list(value)) if isinstance(value, dict) else rng.randrange(len(value))
    if kind < 0.15:
        del changed[key]
    elif kind < 0.25 and isinstance(value, dict):
        changed[rng.choice(["", "x", "../x", "method", "n" * 300])] = rng.choice(VALUES)
    elif kind < 0.25:
        changed.append(value[key])
    else:
        changed[key] = _changed(rng, value[key])
    return changed


def damage_zip(inner: Mutation = damage) -> Mutation:
    """A member damaged under a sound checksum, dropped, renamed or repeated; or plain damage to the archive."""

    def mutate(rng: random.Random, content: bytes) -> bytes:
        if rng.random() < 0.3:
            return damage(rng, content)
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = [(info.filename, archive.read(info)) for info in archive.infolist()]
        at, kind = rng.randrange(len(members)), rng.random()
        name, data = members[at]
        if kind < 0.75:
            members[at] = name, inner(rng, data)
        elif kind < 0.85:
            del members[at]
        else:
            others = ["../x.npy", "/x.npy", "a\\b.npy", "x\x00.npy", name[:-1]]
            members.append((name if kind < 0.9 else rng.choice(others), data))
        out = io.BytesIO()
        method = rng.choice(
            [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2]
        )
        with zipfile.ZipFile(out, "w", method) as archive:
            for name, data in members:
                archive.writestr(name, data)
        return out.getvalue()

    return mutate


def damage_npy(rng: random.Random, content: bytes) -> bytes:
    """The header's words changed in place, so that its length stays true; or plain damage."""
    if rng.random() < 0.4 or content[:6] != b"\x93NUMPY":
        return damage(rng, content)
    (length,) = struct.unpack_from("<H", content, 8)
    pattern = rng.choice(list(HEADERS))
    header = re.sub(
        pattern, lambda _: rng.choice(HEADERS[pattern]), content[10 : 10 + length]
    ).rstrip()
    header += b" " * max(0, 118 - len(header)) + b"\n"
    return content[:8] + struct.pack("<H", len(header)) + header + content[10 + length :]


def damage_png(rng: random.Random, content: bytes) -> bytes:
    """A chunk damaged under a sound checksum, sizes of all kinds among them; or plain damage."""
    if rng.random() < 0.3 or content[:4] != b"\x89PNG":
        return damage(rng, content)
    chunks, at = [], 8
    while at + 8 <= len(content):
        (length,) = struct.unpack_from(">I", content, at)
        chunks.append([content[at + 4 : at + 8], content[at + 8 : at + 8 + length]])
        at += 12 + length
    chosen = rng.choice(chunks)
    if chosen[0] == b"IHDR" and rng.random() < 0.7:
        sizes = [rng.choice([0, 1, 64, 80, 2049, 60_000, 2**31 - 1]) for _ in range(2)]
        chosen[1] = struct.pack(">II", *sizes) + bytes(
            rng.choice([0, 1, 2, 3, 4, 6, 8, 16, 255]) for _ in range(5)
        )
    elif chosen[0] == b"IDAT" and rng.random() < 0.5:
        chosen[1] = zlib.compress(rng.choice([b"", b"\0" * 10, b"\7" * 100_000, b"\0" * 3_000_000]))
    else:
        chosen[1] = damage(rng, chosen[1]) if rng.random() < 0.7 else chosen[1]
        chosen[0] = rng.choice(
            [chosen[0], chosen[0], b"tRNS", b"PLTE", b"zTXt", b"iCCP", b"eXIf", b"acTL", b"IEND"]
        )
    parts = [
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    ]
    return content[:8] + b"".join(parts)


def damage_safetensors(rng: random.Random, content: bytes) -> bytes:
    """The header's JSON, the metadata in it, or plain damage."""
    if rng.random() < 0.25:
        return damage(rng, content)
    (length,) = struct.unpack_from("<Q", content)
    header, rest = json.loads(content[8 : 8 + length]), content[8 + length :]
    text = damage_json(rng, json.dumps(header).encode())
    if rng.random() < 0.5 and (names := header.get("__metadata__")):
        name = rng.choice(list(names))
        names[name] = damage_json(rng, names[name].encode()).decode("utf-8", "replace")
        text = json.dumps(header).encode()
    stated = rng.choice([len(text)] * 6 + SIZES)
    return struct.pack("<Q", stated) + text + rest
