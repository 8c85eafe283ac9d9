"""Downloads of a viewer."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from magnet.body import Body
from magnet.export.page.takes import take
from magnet.testing import random_scene


@pytest.mark.parametrize(("which", "name"), [("spin", "spin.npz"), ("../etc", None)])
def test_a_take_that_there_is_not_is_refused_as_a_format_is(
    which: str, name: str | None, body: Body, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A client may send any name."""
    pytest.importorskip("viser")
    from magnet.viewer.watch import Viewer

    scene = random_scene(1, 8, 2, torch.Generator().manual_seed(1))
    viewer = Viewer([take("dance", scene), take("spin", scene)], body, port=0)
    files: list[str] = []
    said: list[str] = []
    client = SimpleNamespace(
        send_file_download=lambda name, *_, **__: files.append(name),
        add_notification=lambda title, text, **_: said.append(f"{title}: {text}"),
    )
    made: list[Any] = []
    for kind in ("add_dropdown", "add_button"):
        add = getattr(viewer.server.gui, kind)
        monkeypatch.setattr(
            viewer.server.gui, kind, lambda *words, add=add, **more: made.append(add(*words, **more)) or made[-1]
        )
    try:
        viewer.add_saving()
        takes, _, button = made
        takes._impl.value = which  # as viser has it from the browser
        for pressed in button._impl.update_cb:
            pressed(SimpleNamespace(client=client))
        assert not button.disabled
    finally:
        viewer.stop()
    assert (files, said) == ([name], []) if name else ([], ["Not saved: take: got '../etc', expected dance, spin"])
