"""Packages: found, downloaded, read, refused."""

from __future__ import annotations

import io
import os
import subprocess
import tarfile
import zipfile
from pathlib import Path

import pytest
from memory_checks import at_most
from small_packages import CHAIR, catalogue, deb, deb_of, entry, fetch, tar_of

from learn3d.files import limits
from learn3d.make_data.debian import packages


def test_members_that_point_outside_write_nothing_there(debs: Path, tmp_path: Path):
    notice = "../../../../usr/share/doc/sweethome3d-furniture/copyright"
    sh3f = catalogue([entry("Chair", "chair")], {"m/chair.obj": CHAIR, "../../evil.obj": CHAIR})
    deb(debs, "sweethome3d-furniture", {notice: b"licence", "/usr/../../evil.sh3f": sh3f})
    report = fetch(tmp_path / "out", debs, category="chair")
    assert [model["source"] for model in report.models] == ["evil.sh3f!/m/chair.obj"]
    assert (tmp_path / "out/licences/sweethome3d-furniture.copyright").read_bytes() == b"licence"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["debs", "out"]


def test_oversized_models_are_left_out(debs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(limits, "CATALOGUE_MEMBER_BYTES", len(CHAIR) - 1)
    reasons = [drop["reason"] for drop in fetch(tmp_path / "out", debs, category="chair").dropped]
    assert len(reasons) == 3 and all("at most" in reason for reason in reasons)


def test_models_that_are_not_deflated_are_left_out(debs: Path, tmp_path: Path):
    content = io.BytesIO(catalogue([entry("Chair", "chair")], {}))
    with zipfile.ZipFile(content, "a", zipfile.ZIP_LZMA) as archive:
        archive.writestr("m/chair.obj", CHAIR)
    deb(debs, "sweethome3d-furniture", {"usr/Test.sh3f": content.getvalue()})
    (dropped,) = fetch(tmp_path / "out", debs, category="chair").dropped
    assert "only deflate is read" in dropped["reason"]


@pytest.mark.parametrize("content", [b"", b"!<arch>\n", None])
def test_damaged_packages(debs: Path, tmp_path: Path, content: bytes | None):
    file = next(debs.glob("flightgear*"))
    file.write_bytes(file.read_bytes()[:-200] if content is None else content)
    with pytest.raises(ValueError, match="cannot be read as a Debian package"):
        fetch(tmp_path / "out", debs, category="airplane")


def test_without_dpkg_deb(debs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(packages.shutil, "which", lambda name: None)
    with pytest.raises(ValueError, match="install dpkg"):
        fetch(tmp_path / "out", debs)


def test_missing_and_doubled_packages(debs: Path, tmp_path: Path):
    deb(debs, "flightgear-data-ai", {}, version="3")
    with pytest.raises(ValueError, match="several versions of flightgear-data-ai"):
        fetch(tmp_path / "out", debs)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="apt-get download sweethome3d-furniture"):
        fetch(tmp_path / "out", tmp_path / "empty")


def test_download_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(packages.shutil, "which", lambda name: None)
    with pytest.raises(ValueError, match="--packages-dir"):
        fetch(tmp_path / "out", None)
    monkeypatch.setattr(packages.shutil, "which", lambda name: name)
    answer = subprocess.CompletedProcess([], 100, "", "W: x\nE: Unable to locate package p\n")
    monkeypatch.setattr(packages.subprocess, "run", lambda *args, **kwargs: answer)
    with pytest.raises(ValueError, match=r"\(Unable to locate package p\); run `apt-get update` as root first"):
        fetch(tmp_path / "out", None)
    with pytest.raises(packages.PackageMissing, match="non-free"):
        packages.download_package("sweethome3d-furniture-nonfree", tmp_path)


def test_download_finds_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def run(command, cwd, **kwargs):
        deb(cwd, command[-1], {})
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(packages.shutil, "which", lambda name: name)
    monkeypatch.setattr(packages.subprocess, "run", run)
    assert packages.download_package("flightgear-data-ai", tmp_path).version == "1:2.0-1"


def test_archives_that_lead_astray_are_refused(debs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def refused(message: str) -> None:
        with pytest.raises(ValueError, match=message):
            fetch(tmp_path / "out", debs, category="chair")

    file = deb(debs, "sweethome3d-furniture", {"usr/x.sh3f": catalogue([], {})})
    monkeypatch.setattr(limits, "PACKAGE_MEMBERS", 0)
    refused("it has more than 0 members")
    monkeypatch.undo()
    monkeypatch.setattr(limits, "PACKAGE_BYTES", 5000)
    refused("unpacks to more than its headers say, or than 5000 bytes")
    monkeypatch.undo()
    monkeypatch.setattr(limits, "PACKAGE_WANTED_BYTES", 50)
    refused("sweethome3d-furniture is refused: its files .sh3f have more than 50 bytes")
    if hasattr(os, "mkfifo"):
        file.unlink()
        os.mkfifo(file)
        refused("it is no plain file; expected a Debian package")


def test_a_tar_header_that_unpacks_to_very_much_is_not_kept(debs: Path, tmp_path: Path):
    """A long name of 40 MB takes 6 kB in the package, and tarfile would hold all of it."""
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w:xz", format=tarfile.GNU_FORMAT) as tar:
        tar.addfile(tarfile.TarInfo("n" * 40_000_000))
    file = deb(debs, "sweethome3d-furniture", {})
    content = file.read_bytes()
    start, packed = content.index(b"data.tar"), data.getvalue()
    file.write_bytes(content[:start] + f"{'data.tar.xz':<48}{len(packed):<10}`\n".encode() + packed)
    assert len(packed) < 100_000
    with at_most(2**24), pytest.raises(ValueError, match="unpacks to more than its headers say"):
        fetch(tmp_path / "out", debs, category="chair")


@pytest.mark.parametrize("kind", ["gz", "bz2", "xz"])
def test_packages_of_every_compression_are_read(dpkg: None, tmp_path: Path, kind: str):
    content = tar_of({"usr/a.ac": b"1" * 30_000, "usr/b.ac": b"2"}, kind)
    (tmp_path / "p_1_all.deb").write_bytes(deb_of(content, kind))
    found = dict(packages.read_package(packages.find_package("p", tmp_path), (".ac",), tmp_path / "licences"))
    assert found == {"usr/a.ac": b"1" * 30_000, "usr/b.ac": b"2"}
