"""The zip of a bug report holds texts, and no name of a folder, a user or a machine."""

from __future__ import annotations

import getpass
import json
import socket
import zipfile
from pathlib import Path

from hoigs.studies.doctor import without_names


def test_a_report_of_a_run_that_failed(hoigs, tmp_path, monkeypatch):
    run = tmp_path / "someone" / "run"
    (run / "checkpoints").mkdir(parents=True)
    (run / "spec.yaml").write_text(f"path: {tmp_path}/someone/private.ply\n")
    (run / "provenance.json").write_text('{"clip": {"path": "/home/jane/clips/x"')
    (run / "renders").mkdir()
    (run / "renders" / "playback.mp4").write_bytes(b"picture")
    outcome = hoigs("bug-report", run, "--out", tmp_path / "x.zip")
    assert outcome.code == 0, outcome.err
    with zipfile.ZipFile(tmp_path / "x.zip") as archive:
        texts = {name: archive.read(name).decode() for name in archive.namelist()}
    assert set(texts) == {"doctor.json", "plugins.txt", "run/spec.yaml", "run/provenance.json",
                          "run/checkpoints.txt"}  # fmt: skip
    assert json.loads(texts["doctor.json"])["rows"]
    whole = "\n".join(texts.values())
    for private in (str(tmp_path), str(Path.home()) + "/", "/home/jane", "someone/"):
        assert private not in whole
    assert hoigs("bug-report", "--out", tmp_path / "x.zip").code == 2


def test_names_are_replaced(monkeypatch):
    monkeypatch.setattr(getpass, "getuser", lambda: "janedoe")
    monkeypatch.setattr(socket, "gethostname", lambda: "janes-laptop")
    text = (
        'in "/home/janedoe/my clips/a.png" on janes-laptop by janedoe; C:\\Users\\jane\\x, 3/4, a/b'
    )
    assert without_names(text).count("jane") == 0
    assert without_names('"path": "../../secret/clips/x"') == '"path": "FOLDER/x"'
    assert "3/4, a/b" in without_names(text)
