"""Files that are read are regular ones: nothing waits for the writer of a FIFO."""

from __future__ import annotations

import os
import socket

import pytest

from hoigs.core.files.regular_file import NotRegularError, regular_file


def test_what_is_no_file_of_bytes_is_named(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "link").symlink_to("fifo")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "socket"))
    for name, kind in (("fifo", "FIFO"), ("link", "FIFO"), ("socket", "socket")):
        with pytest.raises(NotRegularError, match=kind) as caught:
            regular_file(tmp_path / name)
        assert caught.value.filename == str(tmp_path / name)
    with pytest.raises(NotRegularError, match="device"):
        regular_file("/dev/zero")


def test_files_and_folders_pass_and_absence_is_said(tmp_path):
    (tmp_path / "a").touch()
    assert regular_file(tmp_path / "a") == tmp_path / "a"
    assert regular_file(str(tmp_path)) == str(tmp_path)
    with pytest.raises(FileNotFoundError):
        regular_file(tmp_path / "b")
