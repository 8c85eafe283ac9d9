"""Models of a hub: what is fetched, what is refused, and what is said where nothing can be."""

from __future__ import annotations

import fnmatch
import hashlib
import json
import re
import shutil
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import magnet
from magnet import checkpoints
from magnet.extras import installing

COMMIT = "0123456789abcdef0123456789abcdef01234567"
OTHERS = ("scenes", "README.md")


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """A hub in a folder, which holds the shipped model beside code; what it was asked for."""
    asked: list[dict[str, Any]] = []
    remote = tmp_path / "hub" / "somebody" / "duet"
    shutil.copytree(checkpoints.FOLDER / "duet", remote)
    (remote / "model.py").write_text("raise SystemExit")
    (tmp_path / "hub" / "somebody" / "else").mkdir()

    def snapshot_download(repo_id: str, *, revision: str | None, allow_patterns: list[str]) -> str:
        asked.append({"repo_id": repo_id, "revision": revision})
        source, target = tmp_path / "hub" / repo_id, tmp_path / "cache" / repo_id
        if not source.is_dir():
            raise RuntimeError(f"404 Client Error.\n\nRepository Not Found: {repo_id}")
        target.mkdir(parents=True, exist_ok=True)
        for file in source.iterdir():
            if any(fnmatch.fnmatch(file.name, pattern) for pattern in allow_patterns):
                shutil.copy(file, target)
        return str(target)

    monkeypatch.setitem(sys.modules, "huggingface_hub", SimpleNamespace(snapshot_download=snapshot_download))
    return asked


def test_a_model_of_a_hub_is_the_model_that_lies_there(hub: list[dict[str, Any]], tmp_path: Path) -> None:
    far = magnet.load("hub:somebody/duet@v1", steps=1).generate(people=2, frames=12, seed=3)
    near = magnet.load("duet", steps=1).generate(people=2, frames=12, seed=3)
    assert far.T_world_root.equal(near.T_world_root) and far.body_rot.equal(near.body_rot)
    assert hub == [{"repo_id": "somebody/duet", "revision": "v1"}]
    assert not (tmp_path / "cache" / "somebody" / "duet" / "model.py").exists()


@pytest.mark.parametrize("name", ["hub:duet", "hub:a/b/c", "hub:", "hub:../..", "hub:a/b@", "hub:a/b c"])
def test_a_name_of_another_form_is_refused(hub: list[dict[str, Any]], name: str) -> None:
    with pytest.raises(ValueError, match="expected hub:owner/name"):
        checkpoints.resolve(name)
    assert not hub


@pytest.mark.parametrize(
    ("name", "said"),
    [("nobody/duet", r"cannot be fetched \(RuntimeError: 404 Client Error\.\)"), ("somebody/else", "no config.json")],
)
def test_what_cannot_be_had_is_said_in_a_line(hub: list[dict[str, Any]], name: str, said: str) -> None:
    with pytest.raises(ValueError, match=said) as caught:
        magnet.load(f"hub:{name}")
    assert "\n" not in str(caught.value)


def test_without_the_package_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(ImportError, match=re.escape(installing("hub"))):
        magnet.load("hub:somebody/duet")


class Hub(BaseHTTPRequestHandler):
    """As much of the hub's protocol as fetching a model takes, for one repository with the shipped model."""

    def log_message(self, *_: object) -> None:
        pass

    def _answer(self, body: bool) -> None:
        path = self.path.partition("?")[0]
        folder = checkpoints.FOLDER / "duet"
        names = sorted(file.name for file in folder.iterdir() if file.is_file())
        if path.startswith("/api/models/somebody/duet"):
            if "/tree/" in path:
                tree = [
                    {"type": "file", "path": n, "size": (folder / n).stat().st_size, "oid": digest(n)} for n in names
                ]
                content = json.dumps(tree).encode()
            else:
                siblings = [{"rfilename": name} for name in names]
                content = json.dumps({"id": "somebody/duet", "sha": COMMIT, "siblings": siblings}).encode()
        elif path.startswith("/somebody/duet/resolve/") and (name := path.rpartition("/")[2]) in names:
            content = (folder / name).read_bytes()
        else:
            return self.send_error(404)
        self.send_response(200)
        name = path.rpartition("/")[2]
        for header, value in (
            ("X-Repo-Commit", COMMIT),
            ("ETag", f'"{digest(name)}"'),
            ("Content-Length", len(content)),
        ):
            self.send_header(header, str(value))
        self.end_headers()
        if body:
            self.wfile.write(content)

    def do_GET(self) -> None:
        self._answer(True)

    def do_HEAD(self) -> None:
        self._answer(False)


def digest(name: str) -> str:
    return hashlib.sha1(name.encode()).hexdigest()


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    pytest.importorskip("huggingface_hub")
    from huggingface_hub import constants

    with ThreadingHTTPServer(("127.0.0.1", 0), Hub) as http:
        threading.Thread(target=http.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{http.server_port}"
        monkeypatch.setattr(constants, "ENDPOINT", address)
        monkeypatch.setattr(
            constants, "HUGGINGFACE_CO_URL_TEMPLATE", address + "/{repo_id}/resolve/{revision}/{filename}"
        )
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
        yield
        http.shutdown()


def test_the_package_itself_fetches_what_lies_on_a_server(server: None, monkeypatch: pytest.MonkeyPatch) -> None:
    from huggingface_hub import snapshot_download

    monkeypatch.setattr("huggingface_hub.snapshot_download", snapshot_download)
    model = magnet.load("hub:somebody/duet", steps=1)
    assert model.most_people == magnet.load("duet").most_people
